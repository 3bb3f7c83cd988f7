"""The parameter tree, the files written from it, and the ROS parameter files read into it."""

from __future__ import annotations

import dataclasses
import math
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from eskf_ros.parameters.docs import to_markdown, to_yaml
from eskf_ros.parameters.mapping import Leaf, from_mapping, leaves, to_mapping
from eskf_ros.parameters.ros_yaml import load
from eskf_ros.parameters.schema import ParameterError, Value
from eskf_ros.parameters.tree import Parameters

CHECKOUT = Path(__file__).resolve().parents[2]
LEAVES = {leaf.name: leaf for leaf in leaves()}


def write(folder: Path, text: str) -> Path:
    path = folder / "config.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def problems_of(mapping: dict[str, object]) -> tuple[str, ...]:
    with pytest.raises(ParameterError) as caught:
        from_mapping(mapping)
    return caught.value.problems


# ------------------------------------------------------------------------------------------- the tree and its files


def test_config_file_is_written_from_the_tree() -> None:
    assert (CHECKOUT / "config" / "eskf.yaml").read_text(encoding="utf-8") == to_yaml(), (
        "run python -m eskf_ros.parameters"
    )


def test_reference_is_written_from_the_tree() -> None:
    assert (CHECKOUT / "docs" / "parameters.md").read_text(encoding="utf-8") == to_markdown(), (
        "run python -m eskf_ros.parameters"
    )


def test_config_file_holds_the_defaults() -> None:
    assert to_mapping(load(CHECKOUT / "config" / "eskf.yaml")) == to_mapping(Parameters())


@pytest.mark.parametrize("path", sorted((CHECKOUT / "config").glob("*.yaml")), ids=lambda path: path.name)
def test_every_shipped_config_can_be_read(path: Path) -> None:
    load(path)


@pytest.mark.parametrize("leaf", leaves(), ids=lambda leaf: leaf.name)
def test_every_parameter_is_explained_and_its_default_is_allowed(leaf: Leaf) -> None:
    assert leaf.convert(leaf.default) == leaf.default or math.isnan(leaf.default)  # type: ignore[arg-type]
    assert leaf.rule.description.endswith((".", ")"))
    for words, unit in (("_deg", "deg"), ("_m_s", "m/s")):
        if leaf.name.endswith(words):
            assert leaf.rule.unit == unit
    shown = to_yaml() + to_markdown()
    assert leaf.name in to_markdown()
    assert leaf.rule.unit in shown


def test_gate_explanation_gives_the_right_quantile() -> None:
    from scipy.stats import chi2

    assert f"above {chi2.ppf(0.999, 3):.2f}" in LEAVES["gnss.gate_probability"].rule.description


def test_noise_explanations_are_the_defaults_in_other_units() -> None:
    imu, minute, gravity = Parameters().imu, math.sqrt(60.0), 9.80665
    said = {name: LEAVES[f"imu.{name}"].rule.description for name in vars(imu)}
    assert f"{math.degrees(imu.gyro_noise_density):.4f} deg/s/rtHz" in said["gyro_noise_density"]
    assert f"{math.degrees(imu.gyro_noise_density) * 60.0:.2f} deg/rt h" in said["gyro_noise_density"]
    assert f"{round(imu.accel_noise_density / gravity * 1e6, -1):.0f} ug/rtHz" in said["accel_noise_density"]
    assert f"{math.degrees(imu.gyro_bias_random_walk * minute):.4f} deg/s in one" in said["gyro_bias_random_walk"]
    assert f"{imu.accel_bias_random_walk * minute / gravity * 1e3:.2f} mg in one" in said["accel_bias_random_walk"]
    assert f"{math.degrees(imu.gyro_bias_std):.2f} deg/s" in said["gyro_bias_std"]
    assert f"{imu.accel_bias_std / gravity * 1e3:.0f} mg" in said["accel_bias_std"]


def test_import_is_light() -> None:
    heavy = "{'rclpy', 'rosbags', 'mcap', 'rich'}"
    code = f"import sys, eskf_ros.parameters.ros_yaml; sys.exit(', '.join({heavy} & set(sys.modules)) or 0)"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_parameters_are_frozen() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        Parameters().gnss.lever_arm = (1.0, 2.0, 3.0)  # type: ignore[misc]


# ------------------------------------------------------------------------------------------------------ round trips


def values_of(leaf: Leaf) -> st.SearchStrategy[Value]:
    rule = leaf.rule
    if leaf.kind == "bool":
        return st.booleans()
    if leaf.kind == "string":
        return st.from_regex(rule.pattern, fullmatch=True).filter(str.isprintable)

    def number(index: int) -> st.SearchStrategy[float]:
        low = rule.minimum[index] if isinstance(rule.minimum, tuple) else rule.minimum
        high = rule.maximum[index] if isinstance(rule.maximum, tuple) else rule.maximum
        return st.floats(
            min_value=rule.above if rule.above is not None else low,
            max_value=rule.below if rule.below is not None else high,
            exclude_min=rule.above is not None,
            exclude_max=rule.below is not None,
        )

    if leaf.kind == "integer":
        return st.integers(rule.minimum, rule.maximum)
    if leaf.kind == "float":
        return number(0) | st.just(math.nan) if rule.nan_allowed else number(0)
    return st.sampled_from(rule.lengths).flatmap(lambda count: st.tuples(*(number(i) for i in range(count))))


@st.composite
def parameter_sets(draw: st.DrawFn) -> Parameters:
    changed = draw(st.lists(st.sampled_from(leaves()), unique_by=lambda leaf: leaf.name, max_size=12))
    return from_mapping({leaf.name: draw(values_of(leaf)) for leaf in changed})


@settings(max_examples=40)
@given(parameter_sets())
def test_written_file_reads_back_the_same(tmp_path_factory: pytest.TempPathFactory, parameters: Parameters) -> None:
    path = write(tmp_path_factory.getbasetemp(), to_yaml(parameters))
    assert to_mapping(load(path)) == to_mapping(parameters)


@given(parameter_sets())
def test_mapping_reads_back_the_same(parameters: Parameters) -> None:
    mapping = to_mapping(parameters)
    assert list(mapping) == list(LEAVES)
    assert to_mapping(from_mapping(mapping)) == mapping


# ------------------------------------------------------------------------------------------------------------ errors


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("gnss.gate_probability", 1.0, "1.0 is not allowed here, it takes a number above 0 and below 1"),
        ("gnss.covariance_scale", 0, "0 is not allowed here, it takes a number above 0, at most 1e+06"),
        ("imu.accel_bias_std", -0.1, "-0.1 is not allowed here, it takes a number 0 to 10 [m/s2]"),
        ("imu.gyro_bias_std", "small", "'small' is not allowed here, it takes a number 0 to 1 [rad/s]"),
        ("history.window", True, "True is not allowed here, it takes a number above 0, at most 60 [s]"),
        ("history.window", math.nan, "nan is not allowed here, it takes a number above 0, at most 60 [s]"),
        pytest.param("history.window", 10**400, f"{10**400} is not allowed here", id="beyond the range of floats"),
        ("history.window", None, "an empty value is not allowed here"),
        ("alignment.initial_heading_deg", math.inf, "inf is not allowed here, it takes a number -360 to 360 or .nan"),
        ("gnss.use_velocity", 1, "1 is not allowed here, it takes true or false"),
        ("gnss.lever_arm", [1.0, 2.0], "[1.0, 2.0] is not allowed here, it takes 3 numbers, each -1000 to 1000 [m]"),
        ("gnss.lever_arm", 1.0, "1.0 is not allowed here, it takes 3 numbers"),
        ("gnss.lever_arm", "abc", "'abc' is not allowed here, it takes 3 numbers"),
        ("gnss.lever_arm", [1.0, 2.0, "3"], "[1.0, 2.0, '3'] is not allowed here, it takes 3 numbers"),
        ("datum", [0.0, 181.0, 0.0], "[0.0, 181.0, 0.0] is not allowed here, it takes no or 3 numbers, in turn -90 to"),
        ("topics.imu", "imu data", "'imu data' is not allowed here, it takes a ROS topic name like imu/data"),
        ("topics.imu", 7, "7 is not allowed here"),
        (
            "frames.map",
            "/map",
            "'/map' is not allowed here, it takes a frame name without blanks and without a leading",
        ),
        ("output.rate_divisor", 2.0, "2.0 is not allowed here, it takes a whole number 1 to 1000"),
        ("output.rate_divisor", 0, "0 is not allowed here, it takes a whole number 1 to 1000"),
        ("output.rate_divisor", True, "True is not allowed here, it takes a whole number 1 to 1000"),
        ("output.tf", "map", "'map' is not allowed here, it takes full or map_to_odom or none"),
        ("gnss.lever_am", [0, 0, 0], "unknown parameter (value [0, 0, 0]); did you mean gnss.lever_arm?"),
        ("lever_arm", [0, 0, 0], "unknown parameter (value [0, 0, 0]); did you mean gnss.lever_arm?"),
        ("history.lever_arm", 1, "unknown parameter (value 1); did you mean gnss.lever_arm?"),
        ("frequency", 30.0, "unknown parameter (value 30.0); docs/parameters.md lists all parameters"),
        ("history", 3.0, "3.0 given, but history is a group; its parameters are history.window"),
        ("history", None, "None given, but history is a group; its parameters are history.window"),
        ("history.window", {"size": 1}, "unknown parameter (value 1); did you mean history.window?"),
    ],
)
def test_error_names_key_value_and_what_is_allowed(key: str, value: object, said: str) -> None:
    (problem,) = problems_of({key: value})
    assert problem.startswith(key)
    assert said in problem


def test_all_mistakes_are_reported_together_each_with_the_file(tmp_path: Path) -> None:
    path = write(
        tmp_path, "/**:\n  ros__parameters:\n    gnss: {gate_probability: 2.0, lever: 1}\n    histroy.window: 3\n"
    )
    with pytest.raises(ParameterError) as caught:
        load(path)
    lines = str(caught.value).splitlines()
    assert len(lines) == len(caught.value.problems) == 3
    assert all(line.startswith(f"{path}: ") for line in lines)
    for line, key in zip(lines, ("gnss.gate_probability", "gnss.lever", "histroy.window")):
        assert f": {key}: " in line


def test_bounds_themselves() -> None:
    values = from_mapping({"imu.accel_bias_std": 0, "history.window": 60, "alignment.initial_heading_deg": -360})
    assert (values.imu.accel_bias_std, values.history.window) == (0.0, 60.0)
    assert isinstance(values.imu.accel_bias_std, float)


def test_numpy_lists_are_accepted() -> None:
    import numpy as np

    values = from_mapping({"gnss.lever_arm": np.array([0.5, 0.0, 1.0])})
    assert values.gnss.lever_arm == (0.5, 0.0, 1.0)
    assert all(type(number) is float for number in values.gnss.lever_arm)


# ------------------------------------------------------------------------------------------------ ROS parameter files

LEVER_ARM = (0.8, -0.2, 1.4)


@pytest.mark.parametrize(
    "text",
    [
        "/**:\n  ros__parameters:\n    gnss:\n      lever_arm: [0.8, -0.2, 1.4]\n",
        "/**:\n  ros__parameters:\n    gnss.lever_arm: [0.8, -0.2, 1.4]\n",
        "eskf_node:\n  ros__parameters:\n    gnss.lever_arm: [0.8, -0.2, 1.4]\n",
        "/eskf_node:\n  ros__parameters:\n    gnss.lever_arm: [0.8, -0.2, 1.4]\n",
        "/*:\n  ros__parameters:\n    gnss.lever_arm: [0.8, -0.2, 1.4]\n",
        "/robot/eskf_node:\n  ros__parameters:\n    gnss.lever_arm: [0.8, -0.2, 1.4]\n",
        "/robot/*:\n  ros__parameters:\n    gnss.lever_arm: [0.8, -0.2, 1.4]\n",
        "/**/eskf_node:\n  ros__parameters:\n    gnss.lever_arm: [0.8, -0.2, 1.4]\n",
        "/*/eskf_node:\n  ros__parameters:\n    gnss.lever_arm: [0.8, -0.2, 1.4]\n",
        "robot:\n  eskf_node:\n    ros__parameters:\n      gnss.lever_arm: [0.8, -0.2, 1.4]\n",
        "/robot:\n  /eskf_node:\n    ros__parameters:\n      gnss.lever_arm: [0.8, -0.2, 1.4]\n",
        "/**:\n  ros__parameters:\n    gnss.lever_arm: [8e-1, -2.0E-01, 14e-1]\n    use_sim_time: true\n"
        "    qos_overrides:\n      /tf:\n        publisher:\n          depth: 100\n",
        "eskf_node:\n  ros__parameters:\n    gnss.lever_arm: [0.8, -0.2, 1.4]\n"
        "controller:\n  ros__parameters:\n    frequency: 20.0\n    gnss.lever_arm: none\n",
    ],
)
def test_dialects_of_ros(tmp_path: Path, text: str) -> None:
    assert load(write(tmp_path, text)).gnss.lever_arm == LEVER_ARM


@pytest.mark.parametrize("text", ["1e-3", "1.0e-3", "1E-03", ".1e-2", "1.e-3", "0.001", "+1e-3"])
def test_numbers_with_exponents(tmp_path: Path, text: str) -> None:
    path = write(tmp_path, f"/**:\n  ros__parameters:\n    imu.gyro_noise_density: {text}\n")
    assert load(path).imu.gyro_noise_density == 1e-3


def test_quoted_number_is_a_string(tmp_path: Path) -> None:
    path = write(tmp_path, "/**:\n  ros__parameters:\n    imu.gyro_noise_density: '1e-3'\n")
    with pytest.raises(ParameterError, match=r"imu.gyro_noise_density: '1e-3' is not allowed here"):
        load(path)


def test_later_section_wins_and_the_rest_stays(tmp_path: Path) -> None:
    path = write(
        tmp_path,
        "/**:\n  ros__parameters:\n    history.window: 1.0\n    gnss.time_offset: -0.1\n"
        "eskf_node:\n  ros__parameters:\n    history:\n      window: 3.0\n",
    )
    values = load(path)
    assert (values.history.window, values.gnss.time_offset) == (3.0, -0.1)


def test_full_node_name_takes_exactly_its_sections(tmp_path: Path) -> None:
    path = write(
        tmp_path,
        "".join(
            f"{section}:\n  ros__parameters:\n    history.window: {window}\n"
            for section, window in (("/**", 1), ("/left/eskf_node", 2), ("/right/*", 3), ("/*", 4), ("/a/**", 5))
        ),
    )
    windows = {
        name: load(path, name).history.window
        for name in ("/left/eskf_node", "/right/eskf_node", "/eskf_node", "/a/b/c/eskf_node", "/b/c/eskf_node")
    }
    assert list(windows.values()) == [2.0, 3.0, 4.0, 5.0, 1.0]


def read_by_ros(path: Path, namespace: str) -> dict[str, object]:
    """What a ROS node called eskf_node in `namespace` gets from the parameter file."""
    rclpy = pytest.importorskip("rclpy", reason="rclpy is not installed here")
    context = rclpy.Context()
    rclpy.init(context=context, args=["--ros-args", "--params-file", str(path)])
    try:
        node = rclpy.create_node(
            "eskf_node",
            namespace=namespace,
            context=context,
            automatically_declare_parameters_from_overrides=True,
            start_parameter_services=False,
            enable_rosout=False,
        )
        values = {name: parameter.value for name, parameter in node.get_parameters_by_prefix("").items()}
        node.destroy_node()
    finally:
        rclpy.shutdown(context=context)
    return values


def test_ros_reads_the_written_file_as_we_do() -> None:
    values = read_by_ros(CHECKOUT / "config" / "eskf.yaml", "/")
    # Empty lists stay out of the file: ROS cannot declare a list without elements.
    assert set(LEAVES) - set(values) == {"datum", "mag.mount_rpy_deg"}
    assert to_mapping(from_mapping(values)) == to_mapping(Parameters())


@pytest.mark.parametrize("namespace", ["/", "/robot", "/robot/front"])
@pytest.mark.parametrize(
    "sections",
    [
        ("/**", "eskf_node"),
        ("eskf_node", "/**"),
        ("/*", "/**/eskf_node"),
        ("/*/eskf_node", "/robot/*"),
        ("/robot/eskf_node", "/robot/**"),
        ("/robot/front/eskf_node", "/eskf_node"),
    ],
    ids=" then ".join,
)
def test_sections_apply_as_in_ros(tmp_path: Path, sections: tuple[str, str], namespace: str) -> None:
    text = "".join(
        f"{section}:\n  ros__parameters:\n    history.window: {window}e-1\n"
        for window, section in enumerate(sections, 1)
    )
    path = write(tmp_path, text)
    from_ros = read_by_ros(path, namespace).get("history.window")
    node_name = f"{namespace.rstrip('/')}/eskf_node"
    if from_ros is None:
        # ROS silently takes the defaults here; whoever names a file wants it used, so for us this is an error.
        with pytest.raises(ParameterError, match=f"no section applies to node {node_name}"):
            load(path, node_name)
    else:
        assert load(path, node_name).history.window == from_ros


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "no parameters found"),
        ("- 1\n- 2\n", "no parameters found"),
        ("gnss:\n  lever_arm: [0.0, 0.0, 0.0]\n", "no 'ros__parameters:' found; a ROS parameter file has '/**:'"),
        ("/**:\n  ros__parameters:\n", "nothing below 'ros__parameters:'"),
        (
            "controller:\n  ros__parameters:\n    a: 1\n",
            "no section applies to node eskf_node; the sections are /contr",
        ),
        ("/**:\n  ros__parameters: {gnss: [\n", "not valid YAML"),
        ("/**:\n  ros__parameters:\n\tgnss: 1\n", "line 3"),
        (
            "/**:\n  ros__parameters:\n    history.window: 1.0\n    history:\n      window: 3.0\n",
            "history.window: given twice, as 1.0 and as 3.0; keep one of them",
        ),
        (
            "/**:\n  ros__parameters:\n    history.window: 1.0\n    history.window: 2.0\n",
            "history.window is given twice",
        ),
        (
            "/left/eskf_node:\n  ros__parameters: {datum: []}\n/right/eskf_node:\n  ros__parameters: {datum: []}\n",
            "sections for several nodes called eskf_node: /left/eskf_node, /right/eskf_node",
        ),
    ],
)
def test_file_that_cannot_be_used(tmp_path: Path, text: str, said: str) -> None:
    path = write(tmp_path, text)
    with pytest.raises(ParameterError) as caught:
        load(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def test_missing_binary_and_folder(tmp_path: Path) -> None:
    with pytest.raises(ParameterError, match=r"absent\.yaml: cannot read the parameter file: No such file"):
        load(tmp_path / "absent.yaml")
    with pytest.raises(ParameterError, match="cannot read the parameter file: Is a directory"):
        load(tmp_path)
    binary = tmp_path / "bag.mcap"
    binary.write_bytes(b"\x89MCAP0\r\n\xff\xfe")
    with pytest.raises(ParameterError, match=r"bag\.mcap: not a text file"):
        load(binary)
