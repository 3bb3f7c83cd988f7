"""The profiles of config/profiles: valid, found by name, and each good for the robot it is made for.

Each is replayed by the command on a simulated recording of its kind of robot, with nothing set but the places of the
sensors. The bars are half above the worst of three seeds, as docs/profiles.md has them.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from eskf_ros.parameters.mapping import to_mapping
from eskf_ros.parameters.profiles import profile_path, profiles
from eskf_ros.parameters.ros_yaml import load, read_sections
from eskf_ros.parameters.schema import ParameterError
from eskf_ros.parameters.tree import Parameters
from eskf_ros.replay.main import main as replay
from eskf_ros.ros_node.main import main as node
from eskf_ros.simulate.main import main as simulate

CHECKOUT = Path(__file__).resolve().parents[2]
SEED = 2


@dataclass(frozen=True)
class Case:
    """Arguments of `eskf_simulate` besides seed and antenna; where the antenna is; the bars (rms, m and deg)."""

    simulated: str
    lever_arm: tuple[float, float, float]
    horizontal: float
    vertical: float
    heading_deg: float
    usable: float
    """Share of the time in which the robot may navigate, at least: until the heading is known it may not."""


CAR = "tunnel_drive --grade consumer --set vibration=1/0.05 --set stop=185"
FIELD = "--grade consumer --set vibration=0.5/0.02 --set stop=150 --sensor wheel:scale_error=0.02"
RTK = "--set position_std=0.015/0.025"
BOAT = "boat --grade industrial --set stop=200 --sensor dual_antenna:baseline=1/0/0"

CASES = {
    "car": Case(CAR, (0.8, -0.2, 1.4), 1.8, 0.5, 0.4, 0.65),
    "car_with_wheels": Case(
        f"{CAR} --sensor wheel:scale_error=0.02,speed_quantum=0.05", (0.8, -0.2, 1.4), 0.85, 0.5, 0.4, 0.65
    ),
    "field_robot": Case(f"field_robot {FIELD}", (0.8, -0.2, 1.4), 0.33, 0.37, 1.5, 0.78),
    "skid_steer": Case(f"skid_steer:1 {FIELD}", (0.8, -0.2, 1.4), 0.43, 0.4, 2.4, 0.6),
    "tractor": Case(
        f"tractor:2 --set vibration=1/0.05 --set stop=150 {RTK} --sensor dual_antenna:baseline=0/1/0 "
        "--episode outage:start=110,length=10",
        (0.5, -0.5, 2.8),
        0.14,
        0.05,
        0.6,
        0.9,
    ),
    "mower": Case(f"field_robot {FIELD} {RTK}", (0.3, 0.0, 0.4), 0.05, 0.03, 1.1, 0.8),
    "multirotor": Case("multirotor --grade consumer --sensor barometer", (0.0, 0.0, 0.1), 0.33, 0.4, 0.7, 0.62),
    "fixed_wing": Case(
        "aeroplane --grade consumer --set stop=150 --sensor barometer --episode outage:start=110,length=10",
        (0.3, 0.0, 0.1),
        0.56,
        0.43,
        0.53,
        0.8,
    ),
    "hand_held": Case("walk --grade consumer", (0.0, 0.0, 0.2), 0.45, 0.42, 5.5, 0.55),
    "vessel": Case(BOAT, (0.0, 0.0, 3.0), 0.36, 0.32, 0.4, 0.95),
    "dp_vessel_dvl": Case(
        f"{BOAT} --sensor body_velocity:std=0.02/0.02/0.02 --episode outage:start=120,length=60",
        (0.0, 0.0, 3.0),
        0.3,
        0.26,
        0.3,
        0.95,
    ),
}


def result_of(name: str, folder: Path, seed: int = SEED, profile: bool = True) -> dict[str, Any]:
    """summary.json of the case's recording, replayed with the profile or, for comparison, with the defaults."""
    case = CASES[name]
    bag, site = folder / f"{name}.mcap", folder / "site.yaml"
    arm = ", ".join(str(value) for value in case.lever_arm)
    antenna = "/".join(str(value) for value in case.lever_arm)
    words = [
        *case.simulated.split(),
        "--set",
        f"lever_arm={antenna}",
        "--seed",
        str(seed),
        "--out",
        str(bag),
        "--quiet",
    ]
    assert simulate(words) == 0
    site.write_text(f"/**:\n  ros__parameters:\n    gnss.lever_arm: [{arm}]\n", encoding="utf-8")
    chosen = ["--profile", name] if profile else []
    options = ["--config", str(site), "--truth", "truth", "--quiet", "--json", str(folder / "summary.json")]
    assert replay([str(bag), *chosen, *options]) == 0
    summary: dict[str, Any] = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    return summary


def test_a_parked_tractor_is_not_thought_late(tmp_path: Path) -> None:
    """Fixes of centimetres, the heading known at rest: what the errors of the fixes make of the velocity is no motion.

    This drive was usable for a third of the time: a time offset of 0.6 s and a lever arm 2 m off were allowed for.
    """
    assert result_of("tractor", tmp_path, seed=1)["quality"]["usable"] > CASES["tractor"].usable


def test_every_profile_is_replayed_here() -> None:
    assert set(CASES) == set(profiles())


@pytest.mark.parametrize("name", CASES)
def test_a_profile_is_good_for_its_robot(name: str, tmp_path: Path) -> None:
    case, summary = CASES[name], result_of(name, tmp_path)
    assert summary["final"]["status"] == "GOOD"
    for axis in ("horizontal", "vertical", "heading_deg"):
        assert summary["error"][axis]["rms"] < getattr(case, axis), axis
    assert summary["nees"]["position"]["mean"] < 6.0, "errors as large as said: 3 is ideal, one drive scatters"
    assert summary["quality"]["usable"] > case.usable
    assert not summary["warnings"], "nothing is complained of where nothing is wrong"


@pytest.mark.parametrize("name", CASES)
def test_a_profile_says_why_and_leaves_the_places_of_the_sensors_alone(name: str) -> None:
    """A place of zero is looked up on /tf_static; one that a profile made up would not be."""
    text = profile_path(name).read_text(encoding="utf-8")
    changed = {
        key for key, value in to_mapping(load(None, profile=name)).items() if value != to_mapping(Parameters())[key]
    }
    assert changed
    # Angles of a baseline are a way of mounting that the text names; a position is never known.
    assert not [key for key in changed if key.endswith(("lever_arm", "position", "imu.mount_rpy_deg"))]
    assert text.startswith("# ")
    (content,) = [values for _, values in read_sections(profile_path(name))]
    assert content
    lines = text.splitlines()
    groups = [number for number, line in enumerate(lines) if line.startswith("    ") and line[4] not in " #"]
    for first, last in zip(groups, [*groups[1:], len(lines)], strict=True):
        assert any(line.strip().startswith("#") for line in lines[first:last]), f"{name}: {lines[first]}"


def test_a_file_of_parameters_goes_before_the_profile(tmp_path: Path) -> None:
    path = tmp_path / "own.yaml"
    path.write_text("/**:\n  ros__parameters:\n    nhc:\n      lateral_std: 0.5\n", encoding="utf-8")
    both = load(path, profile="field_robot")
    assert both.nhc.lateral_std == 0.5
    assert both.nhc.vertical_std == load(None, profile="field_robot").nhc.vertical_std


def test_a_name_that_is_no_profile_is_a_mistake_that_names_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(ParameterError, match="there is no such profile; there are car, car_with_wheels"):
        profile_path("bicycle")
    assert replay([str(tmp_path / "bag.mcap"), "--profile", "bicycle"]) == 2
    assert "there is no such profile" in capsys.readouterr().err
    pytest.importorskip("rclpy")
    assert node(["--profile", "bicycle"]) == 2
    assert "there is no such profile" in capsys.readouterr().err


def test_the_document_lists_every_profile() -> None:
    text = (CHECKOUT / "docs" / "profiles.md").read_text(encoding="utf-8")
    assert all(f"[{name}](../config/profiles/{name}.yaml)" in text for name in profiles())
