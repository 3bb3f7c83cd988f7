"""`eskf_migrate`: what robot_localization and FusionCore were told arrives here, and nothing is lost without a word."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest

from eskf_ros.geodesy.map_frame import MapFrame
from eskf_ros.migrate import fusioncore, robot_localization
from eskf_ros.migrate.conversion import CONVERTED, Conversion, markdown_table
from eskf_ros.migrate.main import main, migrate
from eskf_ros.parameters.mapping import leaves
from eskf_ros.parameters.ros_yaml import load
from eskf_ros.parameters.tree import Parameters

DOCUMENT = Path(__file__).resolve().parents[2] / "docs" / "migrate.md"

NOTHING = "[false, false, false, false, false, false"
WHEELS = NOTHING + ", true, true, false, false, false, true, false, false, false]"
FIXES = "[true, true, true, false, false, false, false, false, false, false, false, false, false, false, false]"
YAW = "[false, false, false, false, false, true, false, false, false, false, false, true, true, false, false]"

LOCAL = f"""
ekf_local:
  ros__parameters:
    two_d_mode: true
    odom_frame: odom_of_it
    base_link_frame: base_footprint
    world_frame: odom_of_it
    odom0: wheels
    odom0_config: {WHEELS}
    odom0_queue_size: 10
    imu0: imu
    imu0_config: {YAW}
    process_noise_covariance: [0.5]
"""
GLOBAL = f"""
ekf_global:
  ros__parameters:
    two_d_mode: true
    map_frame: world
    odom_frame: odom_of_it
    base_link_frame: base_footprint
    world_frame: world
    history_length: 3
    odom0: wheels
    odom0_config: {WHEELS}
    odom1: odometry/gps
    odom1_config: {FIXES}
    odom1_pose_rejection_threshold: 4.0
    imu0: imu
    imu0_config: {YAW}
"""


def navsat(**values: object) -> str:
    lines = "".join(f"    {name}: {str(value).lower()}\n" for name, value in values.items())
    return f"\nnavsat_transform:\n  ros__parameters:\n    delay: 3.0\n{lines}"


def migrated(folder: Path, *texts: str) -> tuple[Parameters, Conversion, str]:
    """Our parameters, as our own reader reads the written file; the conversion, and the report."""
    files = []
    for number, text in enumerate(texts):
        files.append(folder / f"part{number}.yaml")
        files[-1].write_text(text, encoding="utf-8")
    found = migrate(files)
    (folder / "ours.yaml").write_text(found.parameter_file(), encoding="utf-8")
    return load(folder / "ours.yaml"), found, "\n".join(found.report())


def test_two_filters_and_navsat_transform_become_one_node(tmp_path: Path) -> None:
    ours, _, report = migrated(tmp_path, LOCAL + GLOBAL, navsat(use_odometry_yaw=True))
    assert (ours.frames.map, ours.frames.odom, ours.frames.base_link) == ("world", "odom_of_it", "base_footprint")
    assert (ours.topics.imu, ours.topics.wheel, ours.topics.wheel_type) == ("imu", "wheels", "nav_msgs/msg/Odometry")
    assert ours.topics.body_velocity == Parameters().topics.body_velocity, "odometry/gps is no velocity"
    assert ours.output.two_d
    assert ours.output.tf == "full"
    assert ours.history.window == 3.0
    assert ours.alignment.imu_orientation == "true_north"
    assert "set nhc.enabled" in report


@pytest.mark.parametrize(
    ("filters", "tf"),
    [
        (GLOBAL, "map_to_odom"),
        (LOCAL, "full"),
        (GLOBAL + "    publish_tf: false\n", "none"),
        (LOCAL + "    publish_tf: false\n" + GLOBAL, "map_to_odom"),
    ],
)
def test_the_transforms_that_were_published_are_those_that_are(tmp_path: Path, filters: str, tf: str) -> None:
    assert migrated(tmp_path, filters)[0].output.tf == tf


def test_a_yaw_that_is_not_zero_in_the_east_is_not_used(tmp_path: Path) -> None:
    """A wrong heading is worse than none, which the filter finds."""
    ours, _, report = migrated(tmp_path, GLOBAL, navsat(yaw_offset=1.5707963, magnetic_declination_radians=0.04))
    assert ours.alignment.imu_orientation == "unused"
    assert "yaw_offset" in report


def test_a_declination_makes_the_yaw_a_magnetic_one_and_its_sign_is_not_guessed(tmp_path: Path) -> None:
    ours, _, report = migrated(tmp_path, GLOBAL, navsat(magnetic_declination_radians=0.04))
    assert ours.alignment.imu_orientation == "magnetic_north"
    assert math.isnan(ours.mag.declination_deg)
    assert "either sign" in report


def test_a_yaw_that_only_navsat_transform_took_is_taken_at_the_start(tmp_path: Path) -> None:
    without = GLOBAL.replace(YAW, WHEELS)
    assert migrated(tmp_path, without, navsat(zero_altitude=True))[0].alignment.imu_orientation == "true_north"
    assert migrated(tmp_path, without, navsat(use_odometry_yaw=True))[0].alignment.imu_orientation == "unused"


def test_the_datum_is_used_only_where_it_was(tmp_path: Path) -> None:
    datum = "[55.944904, -3.186693, 0.7]"
    ours, _, report = migrated(tmp_path, GLOBAL, navsat(wait_for_datum=True, datum=datum))
    assert ours.datum == (55.944904, -3.186693, 0.0)
    assert "0.7 rad turned the map" in report
    assert migrated(tmp_path, GLOBAL, navsat(wait_for_datum=False, datum=datum))[0].datum == ()


def test_the_initial_yaw_comes_with_its_variance(tmp_path: Path) -> None:
    state = "    initial_state: [0.0, 0.0, 0.0, 0.0, 0.0, 1.5, 0, 0, 0, 0, 0, 0, 0, 0, 0]\n"
    spread = "    initial_estimate_covariance: [1.0, 1.0, 1.0, 1.0, 1.0, 0.04, 1, 1, 1, 1, 1, 1, 1, 1, 1]\n"
    ours, _, _ = migrated(tmp_path, GLOBAL + state + spread)
    assert ours.alignment.initial_heading_deg == pytest.approx(math.degrees(1.5))
    assert ours.alignment.initial_heading_std_deg == pytest.approx(math.degrees(0.2))


def test_velocities_upwards_are_those_of_a_body_velocity(tmp_path: Path) -> None:
    twist = "    twist0: dvl\n    twist0_config: " + NOTHING + ", false, false, true]\n"
    ours, _, _ = migrated(tmp_path, GLOBAL + twist)
    assert ours.topics.body_velocity == "dvl"
    assert ours.topics.body_velocity_type == "geometry_msgs/msg/TwistWithCovarianceStamped"


def test_every_parameter_that_was_given_is_accounted_for(tmp_path: Path) -> None:
    given = GLOBAL + "    made_up_by_somebody: 1\n    imu1: another\n    pose0: camera\n"
    _, found, report = migrated(tmp_path, given, navsat(zero_altitude=True))
    names = set(re.findall(r"^    (\w+):", given, re.MULTILINE)) | {"delay", "zero_altitude"}
    assert {name for fate in found.fates.values() for name in fate} == names
    assert "made_up_by_somebody: not known here" in report
    assert "imu1 (another) is not used" in report
    assert "pose0" in report


def test_fusioncore_with_its_own_defaults(tmp_path: Path) -> None:
    place = (47.5, 8.5, 430.0)
    x, y, z = MapFrame(place).to_ecef(np.zeros((1, 3)))[0].tolist()
    text = f"""
fusioncore:
  ros__parameters:
    encoder.topic: /wheels
    encoder:
      nhc_vy_sigma: 0.05
    gnss.lever_arm_x: 0.4
    gnss.lever_arm_z: 1.1
    gnss.heading_topic: /gnss/yaw
    gnss.heading_noise: 0.01
    gnss.coast_n: 5
    reference: {{use_first_fix: false, x: {x}, y: {y}, z: {z}}}
    ukf.q_position: 0.01
"""
    ours, _, report = migrated(tmp_path, text)
    assert (ours.topics.imu, ours.topics.gnss_fix) == ("/imu/data", "/gnss/fix"), "its defaults, which are not ours"
    assert (ours.topics.wheel, ours.topics.heading) == ("/wheels", "/gnss/yaw")
    assert ours.gnss.lever_arm == (0.4, 0.0, 1.1)
    assert ours.nhc.enabled
    assert ours.nhc.lateral_std == 0.05
    assert ours.heading.unknown_std_deg == pytest.approx(math.degrees(0.01))
    assert ours.datum == pytest.approx(place, abs=1e-6)
    assert "ukf.q_position" in report


@pytest.mark.parametrize(
    "table", [robot_localization.TABLE, fusioncore.TABLE], ids=["robot_localization", "fusioncore"]
)
def test_the_tables_name_parameters_that_exist_and_are_in_the_document(table: tuple) -> None:
    ours = {leaf.name for leaf in leaves()}
    groups = {name.split(".")[0] for name in ours}
    for entry in table:
        assert [other.name for other in table if other.name == entry.name] == [entry.name]
        named = re.findall(r"\b(?:" + "|".join(groups) + r")\.\w+", entry.ours)
        assert set(named) <= ours, f"{entry.name}: {entry.ours}"
        assert entry.fate != CONVERTED or "`" in entry.ours
    assert markdown_table(table) in DOCUMENT.read_text(encoding="utf-8")


def test_a_file_of_another_package_is_a_mistake_of_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "other.yaml"
    path.write_text("amcl:\n  ros__parameters:\n    alpha1: 0.2\n", encoding="utf-8")
    assert main([str(path)]) == 2
    assert "no section of robot_localization" in capsys.readouterr().err
    assert main([str(tmp_path / "missing.yaml")]) == 2


def test_the_command_writes_a_file_and_says_what_is_lost(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, out = tmp_path / "ekf.yaml", tmp_path / "ours.yaml"
    path.write_text(GLOBAL, encoding="utf-8")
    assert main([str(path), "--out", str(out)]) == 0
    assert load(out).topics.wheel == "wheels"
    assert "odom1_pose_rejection_threshold" in capsys.readouterr().err
    assert main([str(path)]) == 0
    assert capsys.readouterr().out == out.read_text(encoding="utf-8")
