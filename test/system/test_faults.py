"""The campaign of faults: a clean drive shows none, and what is broken on purpose is seen to be."""

from __future__ import annotations

import numpy as np
import pytest

from faults import BEGIN, END, FAULTS, Fault, Samples, row_of, run_one

BY_NAME = {fault.name: fault for fault in FAULTS}


def still(count: int = 20_000) -> Samples:
    seconds = 0.01 * np.arange(count)
    readings = np.zeros((count, 3))
    return Samples(
        np.round(seconds * 1e9).astype(np.int64), readings.copy(), readings.copy(), np.ones(count, bool), seconds
    )


@pytest.mark.parametrize("fault", [fault for fault in FAULTS if fault.imu is not None], ids=lambda fault: fault.name)
def test_a_fault_of_the_imu_changes_samples_and_not_their_order(fault: Fault) -> None:
    samples, before = still(), still()
    samples.force[:], samples.rate[:] = (0.1, 0.2, 9.8), (0.3, 0.0, 0.01)
    samples.force[:, 0] += np.sin(samples.seconds)
    samples.rate[:, 2] += np.sin(samples.seconds)
    original = samples.force.copy(), samples.rate.copy()
    assert fault.imu is not None
    fault.imu(samples, np.random.default_rng(0))
    assert (np.diff(samples.stamps) > 0).all()
    is_same = np.array_equal(samples.force, original[0]) and np.array_equal(samples.rate, original[1])
    assert not (is_same and samples.kept.all() and np.array_equal(samples.stamps, before.stamps))
    if fault.end == END:
        late = samples.during(END)
        assert samples.kept[late].all()
        np.testing.assert_array_equal(samples.force[late], original[0][late])


def test_holes_have_the_length_that_they_are_said_to_have() -> None:
    samples = still()
    imu = BY_NAME["holes of 1.6 s, dropped"].imu
    assert imu is not None
    imu(samples, np.random.default_rng(0))
    assert np.count_nonzero(~samples.kept) == 4 * 160
    assert samples.seconds[~samples.kept].min() == pytest.approx(BEGIN)


def test_a_clean_drive_is_neither_lost_nor_a_lie() -> None:
    outcome = run_one(BY_NAME["clean"], 3, True, True, True)
    assert outcome.error[outcome.seconds > BEGIN].max() < 1.0
    assert outcome.position_ratio[outcome.seconds > BEGIN].max() < 5.0
    assert not outcome.complaints
    assert (outcome.restarts, outcome.resets) == (0, 0)
    assert row_of(BY_NAME["clean"], [outcome])[1:4] == ["0.0", "0.0 / 0.0", "0 / 0"]


def test_velocities_stamped_late_are_harmless_once_their_offset_is_given() -> None:
    """The remedy of a fault, followed."""
    fault = BY_NAME["velocities stamped 0.13 s late"]
    clean = run_one(BY_NAME["clean"], 3, True, True, True)
    late = run_one(fault, 3, True, True, True)
    remedied = run_one(
        Fault("remedied", gnss=fault.gnss, parameters={"gnss.velocity_time_offset": -0.13}), 3, True, True, True
    )
    assert np.sqrt(np.mean(late.error[60:] ** 2)) > 1.5 * np.sqrt(np.mean(clean.error[60:] ** 2))
    assert np.sqrt(np.mean(remedied.error[60:] ** 2)) < 1.1 * np.sqrt(np.mean(clean.error[60:] ** 2))
