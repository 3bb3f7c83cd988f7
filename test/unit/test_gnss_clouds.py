"""Ranges and ephemerides as point clouds: any sender's layout is read, what we write others read, faults are named."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_typestore

from eskf_ros.bags import POINT_CLOUD, BagWriter, StringTable, cloud_messages, decode, encode, open_bag
from eskf_ros.gnss import cloud
from eskf_ros.gnss.cloud import (
    MAX_SIGNALS,
    CloudError,
    PointField,
    fields_of,
    points,
    points_of,
    read_epoch,
    write_epoch,
)
from eskf_ros.gnss.ephemeris import Broadcast, Ephemerides, Message
from eskf_ros.gnss.ephemeris_cloud import (
    KLOBUCHAR_FIELDS,
    NO_MESSAGE,
    NO_SATELLITE,
    NO_TIME,
    PARAMETERS,
    read_ephemerides,
    write_ephemerides,
)
from eskf_ros.gnss.measurements import measured_epoch
from eskf_ros.gnss.ranges import (
    ALREADY_TURNED,
    CLOCK_APPLIED,
    CODE_VALID,
    DOPPLER_VALID,
    IONOSPHERE_APPLIED,
    RANGE,
    SATELLITE_KNOWN,
    TROPOSPHERE_APPLIED,
    Status,
    locate,
    status_counts,
)
from eskf_ros.gnss.rinex_nav import LAYOUTS, read_navigation
from eskf_ros.gnss.signals import SIGNAL_BY_CODE, SIGNALS, UNKNOWN_SIGNAL, Gnss
from support import gnss_texts as texts
from support.gnss_sky import SECONDS, WEEK, all_constellations, measure, receiver_at

STORE = get_typestore(Stores.ROS2_JAZZY)
SKY = all_constellations()
SYSTEMS = (Gnss.GPS, Gnss.GALILEO, Gnss.BEIDOU, Gnss.GLONASS)
STAMP = 1_748_764_800_123_456_789


def sky(located: bool = True) -> NDArray[np.void]:
    """Ranges of all constellations, as the receiver gives them or with their satellites."""
    ranges = measure(receiver_at(48.1, 11.6, 565.0, clock_bias=1e5, clock_drift=64.0), SKY, SYSTEMS)
    ranges["pseudorange_std"][::2], ranges["doppler_std"][::3] = 2.5, 0.25
    if not located:
        ranges["flags"] = CODE_VALID | DOPPLER_VALID
        for name in ("satellite", "satellite_velocity", "satellite_clock"):
            ranges[name] = math.nan
        ranges["satellite_clock_drift"] = 0.0
    return ranges


def assert_same(found: NDArray[np.void], expected: NDArray[np.void]) -> None:
    """All that a cloud carries is equal; what it carries in single precision is so to seven digits."""
    single = ("pseudorange_std", "doppler_std", "cn0")
    for name in RANGE.names or ():
        if name in ("status", "issue", "noise_factor"):
            continue
        np.testing.assert_allclose(
            found[name], expected[name], rtol=1e-7 if name in single else 0.0, atol=0.0, err_msg=name
        )


@pytest.mark.parametrize("satellites", [True, False])
def test_ranges_survive_the_way_through_a_cloud(satellites: bool) -> None:
    ranges = sky(located=satellites)
    epoch = read_epoch(write_epoch(ranges, WEEK, SECONDS + 0.2, satellites))
    assert (epoch.week, epoch.seconds, epoch.left_out) == (WEEK, SECONDS + 0.2, 0)
    assert status_counts(epoch.ranges) == {Status.NOT_LOCATED: len(ranges)}
    assert_same(epoch.ranges, ranges)


FIELD_TYPES = {"u1": ["u1", "i2", "u2", "i4", "u4", "f4", "f8"], "u2": ["u2", "i4", "u4", "f4", "f8"]}


@st.composite
def layouts(draw: st.DrawFn) -> np.dtype[Any]:
    """A dtype with all fields of the topic and some of its own, in any order, with gaps, in one byte order."""
    order = draw(st.sampled_from("<>"))
    plain = cloud.SATELLITE_POINT
    wanted = [(name, plain[name].str[1:]) for name in plain.names or ()]
    wanted = [(name, draw(st.sampled_from(FIELD_TYPES.get(kind, [kind])))) for name, kind in wanted]
    own = [
        (f"own_{number}", draw(st.sampled_from(["u1", "f4", "(3,)f8"]))) for number in range(draw(st.integers(0, 3)))
    ]
    names, formats, offsets, end = [], [], [], 0
    for name, kind in draw(st.permutations(wanted + own)):
        end += draw(st.integers(0, 5))
        names.append(name)
        formats.append(kind.replace(")", f"){order}") if "(" in kind else order + kind)
        offsets.append(end)
        end += np.dtype(formats[-1]).itemsize
    layout: Any = {"names": names, "formats": formats, "offsets": offsets}
    return np.dtype({**layout, "itemsize": end + draw(st.integers(0, 9))})


@given(layouts(), st.integers(1, 3), st.integers(0, 7), st.booleans())
@settings(max_examples=60, deadline=None)
def test_any_layout_is_read(dtype: np.dtype[Any], height: int, gap: int, message_big_endian: bool) -> None:
    """Through the message of another library: fields in any order, of any type, padding, byte orders, rows."""
    ranges = sky()[:30]
    plain = write_epoch(ranges, WEEK, SECONDS, satellites=True)
    rows = np.frombuffer(np.random.default_rng(1).bytes(len(plain) * dtype.itemsize), dtype).copy()
    for name in plain.dtype.names or ():
        rows[name] = plain[name]
    width = len(rows) // height
    row_step = width * dtype.itemsize + gap
    data = b"".join(rows[row * width :][:width].tobytes() + b"\xaa" * gap for row in range(height))
    types = STORE.types
    big = any(dtype[name].base.str[0] == ">" for name in dtype.names or ())
    message = types[POINT_CLOUD](
        header=types["std_msgs/msg/Header"](
            stamp=types["builtin_interfaces/msg/Time"](*divmod(STAMP, 1_000_000_000)), frame_id="gnss"
        ),
        height=height,
        width=width,
        fields=[
            types["sensor_msgs/msg/PointField"](name=name, offset=offset, datatype=datatype, count=length)
            for name, offset, datatype, length in fields_of(dtype)
        ],
        is_bigendian=big,
        point_step=dtype.itemsize,
        row_step=row_step,
        data=np.frombuffer(data, np.uint8),
        is_dense=True,
    )
    wire = STORE.serialize_cdr(message, POINT_CLOUD, little_endian=not message_big_endian)
    strings = StringTable()
    decoded, faulty = decode(POINT_CLOUD, np.frombuffer(bytes(wire), np.uint8)[None, :], strings)
    assert faulty is None
    assert decoded["stamp"][0] == STAMP
    assert strings.values[decoded["frame_id"][0]] == "gnss"
    for found in (decoded["points"][0], points_of(message)):
        epoch = read_epoch(found)
        assert (epoch.week, epoch.seconds) == (WEEK, SECONDS)
        assert_same(epoch.ranges, ranges[: height * width])


def test_encoding_is_that_of_rosbags() -> None:
    ranges = sky()
    clouds = [write_epoch(ranges[:count], WEEK, SECONDS, bool(count % 2)) for count in (0, 1, 2, 20)]
    messages = cloud_messages(STAMP + 10 * np.arange(4), clouds, frame_id=1)
    for row, written, found in zip(encode(POINT_CLOUD, messages, ["", "antenne_größer"]), messages, clouds):
        message = STORE.deserialize_cdr(bytes(row), POINT_CLOUD)
        assert bytes(STORE.serialize_cdr(message, POINT_CLOUD)) == bytes(row)
        assert message.header.frame_id == "antenne_größer"
        assert message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec == written["stamp"]
        assert (message.height, message.width) == (1, len(found))
        assert bytes(message.data) == found.tobytes()
        assert [(field.name, field.offset) for field in message.fields] == [
            (field.name, field.offset) for field in fields_of(found.dtype)
        ]


@pytest.mark.parametrize("compression", ["zstd", "none"])
def test_recordings_hold_clouds_of_any_length(tmp_path: Path, compression: str) -> None:
    """Also messages with another frame and with nothing in them; a damaged one is left out and counted."""
    ranges = sky()
    clouds = [write_epoch(ranges[: k % 12], WEEK, SECONDS + k) for k in range(300)]
    stamps = STAMP + 200_000_000 * np.arange(300)
    messages = cloud_messages(stamps, clouds)
    messages["frame_id"][::7] = 1
    rows = [bytes(row) for row in encode(POINT_CLOUD, messages, ["gnss", "another_frame"])]
    rows[33] = rows[33][:-1]
    rows[34] = rows[34][:28] + b"\xff\xff\xff\xff" + rows[34][32:]  # more points than there is data
    with BagWriter(tmp_path / "bag.mcap", compression) as writer:
        handle = writer.add_topic("gnss/ranges", POINT_CLOUD)
        writer.write(handle, stamps[:100] + 5, rows[:100])
        writer.write(handle, stamps[100:] + 5, messages[100:], ["gnss", "another_frame"])
    kept = np.setdiff1d(np.arange(300), [33, 34])
    with open_bag([tmp_path / "bag.mcap"]) as reader:
        found = list(reader.batches({"gnss/ranges": POINT_CLOUD}))
        assert (
            np.concatenate([batch["gnss/ranges"].log_time for batch in found]).tolist() == (stamps[kept] + 5).tolist()
        )
        read = np.concatenate([batch["gnss/ranges"].messages for batch in found])
        assert "2 messages of topic gnss/ranges cannot be decoded" in "".join(reader.warnings)
        assert [reader.strings[index] for index in read["frame_id"]] == [
            "another_frame" if k % 7 == 0 else "gnss" for k in kept
        ]
    assert read["stamp"].tolist() == stamps[kept].tolist()
    for k, row in zip(kept, read):
        assert row["points"].dtype == clouds[k].dtype
        assert row["points"].tobytes() == clouds[k].tobytes()


@given(st.binary(max_size=300))
@settings(max_examples=200, deadline=None)
def test_no_bytes_are_fatal(noise: bytes) -> None:
    messages = cloud_messages(np.array([STAMP]), [write_epoch(sky()[:2], WEEK, SECONDS)])
    whole = bytearray(bytes(encode(POINT_CLOUD, messages, ["gnss"])[0]))
    whole[4 : 4 + len(noise)] = noise
    for payload in (bytes(whole), b"\x00\x01\x00\x00" + noise):
        decode(POINT_CLOUD, np.frombuffer(payload, np.uint8)[None, :], StringTable())


def without(found: NDArray[Any], *names: str) -> NDArray[Any]:
    kept = [name for name in found.dtype.names or () if name not in names]
    less = np.zeros(len(found), [(name, found.dtype[name].str) for name in kept])
    for name in kept:
        less[name] = found[name]
    return less


def test_missing_fields_are_named() -> None:
    whole = write_epoch(sky(), WEEK, SECONDS)
    with pytest.raises(CloudError, match=r"no field gps_week, pseudorange \(fields: gnss_id, sv_id"):
        read_epoch(without(whole, "pseudorange", "gps_week"))
    with pytest.raises(CloudError, match="field pseudorange holds 2 numbers"):
        read_epoch(
            whole.astype([(n, "<f8", 2) if n == "pseudorange" else (n, whole.dtype[n].str) for n in whole.dtype.names])
        )


def test_optional_fields_may_be_missing() -> None:
    ranges = sky(located=False)
    least = write_epoch(ranges, WEEK, SECONDS)[["gnss_id", "sv_id", "gps_week", "gps_tow", "pseudorange"]]
    found = read_epoch(least).ranges
    assert (found["flags"] == CODE_VALID).all()
    assert np.isnan(found["doppler"]).all()
    assert np.isnan(found["cn0"]).all()
    # Each of these satellites sent the first signal of its constellation.
    np.testing.assert_array_equal(found["signal"], ranges["signal"])
    locate(found, WEEK, SECONDS, SKY)
    assert (found["status"] == Status.USABLE).all()


def test_without_flags_finite_numbers_hold() -> None:
    ranges = sky()
    ranges["pseudorange"][0] = math.nan
    ranges["doppler"][1] = math.nan
    ranges["satellite"][2, 1] = math.nan
    everything = CODE_VALID | DOPPLER_VALID | SATELLITE_KNOWN
    found = without(write_epoch(ranges, WEEK, SECONDS, True), "flags")
    flags = read_epoch(found).ranges["flags"]
    assert flags[:4].tolist() == [
        DOPPLER_VALID | SATELLITE_KNOWN,
        CODE_VALID | SATELLITE_KNOWN,
        CODE_VALID | DOPPLER_VALID,
        everything,
    ]
    clockless = read_epoch(without(found, "sat_clk")).ranges
    locate(clockless, WEEK, SECONDS, Ephemerides())
    assert (clockless["status"] == [Status.BAD_VALUE] + [Status.NO_EPHEMERIS] * (len(ranges) - 1)).all()
    # Flags do not make numbers of what is none.
    given_flags = write_epoch(ranges, WEEK, SECONDS, True)
    given_flags["flags"] = 0xFF
    assert read_epoch(given_flags).ranges["flags"][0] & CODE_VALID == 0
    kept = CLOCK_APPLIED | IONOSPHERE_APPLIED | TROPOSPHERE_APPLIED | ALREADY_TURNED
    assert read_epoch(given_flags).ranges["flags"][3] & kept == kept


def test_the_carrier_tells_the_signal_where_no_number_does() -> None:
    ranges = np.concatenate([sky(located=False)[:1]] * len(SIGNALS))
    for index, signal in enumerate(SIGNALS):
        ranges["signal"][index], ranges["gnss_id"][index] = index, signal.gnss
        ranges["carrier_hz"][index] = signal.carrier_hz + (3e6 if signal.gnss == Gnss.GLONASS else 0.0)
    found = without(write_epoch(ranges, WEEK, SECONDS), "sig_id")
    for row in read_epoch(found).ranges:
        first = next(
            k for k, s in enumerate(SIGNALS) if s.gnss == row["gnss_id"] and abs(s.carrier_hz - row["carrier_hz"]) < 4e6
        )
        assert row["signal"] == first


def test_numbers_of_signals_are_those_of_ublox() -> None:
    ranges = np.concatenate([sky(located=False)[:1]] * len(SIGNALS))
    ranges["gnss_id"] = [signal.gnss for signal in SIGNALS]
    ranges["signal"] = np.arange(len(SIGNALS))
    written = write_epoch(ranges, WEEK, SECONDS)
    for gnss, number, code in (
        (Gnss.GPS, 0, "1C"),
        (Gnss.GPS, 3, "2L"),
        (Gnss.GALILEO, 6, "7Q"),
        (Gnss.BEIDOU, 2, "7I"),
        (Gnss.GLONASS, 2, "2C"),
        (Gnss.QZSS, 5, "2L"),
    ):
        point = written[:1].copy()
        point["gnss_id"], point["sig_id"] = gnss, number
        assert read_epoch(point).ranges["signal"][0] == SIGNAL_BY_CODE[gnss, code]
    # P(Y) codes have none and are not written; the others come back as themselves or as their equal.
    back = read_epoch(written).ranges["signal"]
    kept = [index for index in range(len(SIGNALS)) if cloud.UBLOX_NUMBER[index] >= 0]
    assert SIGNAL_BY_CODE[Gnss.GPS, "2W"] not in kept
    for index, found in zip(kept, back):
        assert (SIGNALS[index].carrier_hz, SIGNALS[index].slot) == (SIGNALS[found].carrier_hz, SIGNALS[found].slot)
    written["sig_id"] = 200
    assert (read_epoch(written).ranges["signal"] == UNKNOWN_SIGNAL).all()


def test_bad_points_are_named_and_the_others_used() -> None:
    """Wrong weeks, another epoch, doubles, impossible numbers, unknown constellations: none disturbs its neighbours."""
    ranges = sky(located=False)
    found = write_epoch(ranges, WEEK, SECONDS)
    found["gps_tow"][0] += 0.2
    found["gps_week"][1] -= 1
    found["gps_tow"][2] = math.nan
    found["pseudorange"][3] = math.inf
    found["gnss_id"][4] = 4
    found["gnss_id"][5] = 250
    epoch = read_epoch(found)
    assert (epoch.week, epoch.seconds) == (WEEK, SECONDS)
    measured = measured_epoch(epoch.ranges, epoch.week, epoch.seconds, SKY)
    assert [Status(value).name for value in measured["status"][:7]] == [
        *["WRONG_TIME"] * 3,
        "BAD_VALUE",
        *["UNKNOWN_SIGNAL"] * 2,
        "USABLE",
    ]
    assert (measured["status"][6:] == Status.USABLE).all()
    assert (measured["system"] >= 0).all()
    assert (measured["system"] < 8).all()


def test_no_time_tag_at_all() -> None:
    found = write_epoch(sky(located=False), WEEK, SECONDS)
    found["gps_tow"] = 700000.0
    epoch = read_epoch(found)
    assert math.isnan(epoch.seconds)
    assert (epoch.ranges["status"] == Status.WRONG_TIME).all()
    empty = read_epoch(found[:0])
    assert len(empty.ranges) == 0
    assert math.isnan(empty.seconds)


def test_two_hundred_signals_are_read_and_no_more() -> None:
    many = np.concatenate([write_epoch(sky(located=False), WEEK, SECONDS)] * 9)
    for count in (MAX_SIGNALS, MAX_SIGNALS + 5):
        epoch = read_epoch(many[:count])
        assert len(epoch.ranges) == MAX_SIGNALS == 200
        assert epoch.left_out == count - MAX_SIGNALS


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"point_step": 20}, "field carrier_hz ends at byte 22 of points of 20 bytes"),
        ({"width": 9}, "bytes of data for 1 x 9 points"),
        ({"height": 2, "row_step": 3}, "rows of 3 bytes are too short"),
    ],
)
def test_layouts_that_cannot_be(change: dict[str, int], message: str) -> None:
    found = write_epoch(sky(located=False)[:4], WEEK, SECONDS)
    whole = {"height": 1, "width": 4, "point_step": found.itemsize, "row_step": found.nbytes, **change}
    with pytest.raises(CloudError, match=message):
        points(fields_of(found.dtype), found.tobytes(), big_endian=False, **whole)
    fields = [SimpleNamespace(name="x", offset=0, datatype=8, count=0)] * 2
    twice = SimpleNamespace(fields=fields, height=1, width=0, point_step=8, row_step=8, is_bigendian=False, data=b"")
    with pytest.raises(CloudError, match="field x is there twice"):
        points_of(twice)


def test_fields_without_name_or_of_unknown_type_are_ignored() -> None:
    found = points(
        [PointField("", 0, 8), PointField("a", 0, 8, 0), PointField("b", 8, 99)], bytes(16), 1, 1, 16, 16, False
    )
    assert found.dtype.names == ("a",)
    assert found["a"].shape == (1,)


# Ephemerides.


def broadcasts(folder: Path) -> list[Broadcast]:
    path = folder / "made.nav"
    path.write_text(texts.EVERYTHING, encoding="ascii")
    return read_navigation(path).broadcasts


@pytest.mark.parametrize("big_endian", [False, True])
def test_ephemerides_survive_the_way_through_a_cloud(tmp_path: Path, big_endian: bool) -> None:
    """The records are equal to the bit, whatever the order of points and fields."""
    sent = broadcasts(tmp_path)
    assert {broadcast.gnss for broadcast in sent} >= {Gnss.GPS, Gnss.GALILEO, Gnss.BEIDOU, Gnss.QZSS, Gnss.GLONASS}
    klobuchar = {Gnss.GPS: np.arange(8.0)}
    found = write_ephemerides(sent, klobuchar)
    names = np.random.default_rng(3).permutation(found.dtype.names)
    shuffled = np.zeros(len(found), [(str(name), ">f8" if big_endian else "<f8") for name in names])
    for name in names:
        shuffled[name] = found[name][::-1]
    read = read_ephemerides(shuffled)
    assert not read.refused
    assert read.records[::-1].tobytes() == np.array([broadcast.record() for broadcast in sent]).tobytes()
    assert list(read.klobuchar) == [Gnss.GPS]
    np.testing.assert_array_equal(read.klobuchar[Gnss.GPS], klobuchar[Gnss.GPS])


def test_every_number_of_every_message_has_a_field() -> None:
    for layout in LAYOUTS.values():
        assert set(layout) - {None, "week"} <= set(PARAMETERS)
    assert len(set(PARAMETERS) | set(KLOBUCHAR_FIELDS)) == len(PARAMETERS) + 8


def test_bad_ephemerides_are_counted_by_reason(tmp_path: Path) -> None:
    sent = broadcasts(tmp_path)
    found = write_ephemerides(sent)
    found = np.concatenate([found[:1]] * 8)
    found["gnss_id"][0] = 1
    found["sv_id"][1] = 0
    found["message"][2] = 77
    found["message"][3] = Message.FDMA
    found["toc"][4] = math.nan
    found["toc_week"][5] = -3
    found["sqrt_a"][6] = math.nan
    read = read_ephemerides(found)
    assert read.refused == {NO_SATELLITE: 2, NO_MESSAGE: 2, NO_TIME: 2}
    store = Ephemerides(read.records)
    assert len(store) == 1
    with pytest.raises(CloudError, match="no field toc, af1"):
        read_ephemerides(without(found, "toc", "af1"))


@given(st.dictionaries(st.sampled_from(PARAMETERS), st.floats(width=64), min_size=1))
@settings(max_examples=100, deadline=None)
def test_no_ephemeris_is_fatal(values: dict[str, float]) -> None:
    names = ["gnss_id", "sv_id", "toc_week", "toc", *PARAMETERS]
    found = np.zeros(6, [(name, "<f8") for name in names])
    found["gnss_id"], found["sv_id"], found["toc_week"], found["toc"] = [0, 2, 3, 5, 6, 1], 5, WEEK, SECONDS
    for name, value in values.items():
        found[name] = value
    Ephemerides(read_ephemerides(found).records)


def test_the_manual_names_every_field() -> None:
    manual = (Path(__file__).resolve().parents[2] / "docs" / "ranges.md").read_text("utf-8")
    names = {*(cloud.SATELLITE_POINT.names or ()), *PARAMETERS, "toc_week", "toc", "message", "leap_seconds"}
    assert not {name for name in names if f"`{name}`" not in manual}
