"""The structure of the estimator, read from its sources: rooms point down, writers are listed, rows are complete."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import eskf_ros
from eskf_ros.filter.layout import STATE

PACKAGE = Path(eskf_ros.__file__).parent
FILTER = PACKAGE / "filter"

FLOORS = (
    ("compiled", "parameters.schema"),
    ("geodesy",),
    ("gnss",),
    ("bags", "fleet"),
    ("filter.state",),
    ("filter.history",),
    ("filter.inertial",),
    ("filter.stationarity",),
    ("filter.measurements",),
    ("filter.alignment",),
    ("filter.integrity",),
    ("filter.output",),
    ("filter.tight", "filter.predict"),
    ("filter.fuse",),
    ("filter.rows",),
    ("parameters.tree", "filter.layout"),
    ("parameters", "filter.settings"),
    ("filter.loop",),
    ("filter.readout",),
    ("filter.navigator",),
    ("filter.warm_up", "inputs", "smooth"),
    ("report",),
    ("replay", "simulate", "migrate"),
    ("tables", "doctor", "watch"),
    ("api",),
    ("calibration",),
    ("ros_node",),
)
"""From the lowest floor to the highest: a room imports from floors below it, and from itself."""

WRITERS = {
    "alignment/first_fix.py": {"reset_position_to_fix", "reset_pose"},
    "alignment/heading.py": {"inflate_position", "reset_heading", "reset_to_search"},
    "alignment/heading_sensors.py": {"reset_given_heading", "reset_to_unknown_heading"},
    "alignment/levelling.py": {"reset_tilt", "update_gyro_bias_at_rest", "reset_level_to_moving"},
    "inertial/covariance.py": {"propagate_noise", "propagate_axis_noise", "propagate_covariance", "update_error_axes"},
    "inertial/navigation_frame.py": {"reset_attitude", "reset_datum"},
    "inertial/strapdown.py": {"propagate_nominal_state"},
    "integrity/humble_lane.py": {"reset_block", "reset_to_lane", "reset_to_message"},
    "integrity/restart.py": {"inflate_level", "reset_alignment"},
    "integrity/fix_errors.py": {"inflate_lasting_error", "propagate_walk", "reset_scatter"},
    "measurements/kalman_update.py": {"update_covariance", "update_nominal_state"},
    "measurements/mag.py": {"propagate_mag_error"},
    "state/augmented_states.py": {
        "reset_augmented",
        "propagate_augmented",
        "propagate_clock",
        "propagate_scale",
        "inflate_tilt_by_scale",
    },
    "tight/epoch.py": {"inflate_or_reset_by_majority"},
    "tight/receiver_clock.py": {"reset_clock", "reset_or_jump_clock"},
}
"""All functions that assign to position, velocity, attitude, biases, augmented states or their covariance."""

LANES = ("state", "lane", "humble")
"""Names by which functions call the record that holds an estimate."""

ESTIMATE = {"position_map", "velocity_map", "attitude", "accel_bias", "gyro_bias", "optional", "covariance"}


def floor_of(module: str) -> int:
    """The floor of a module (name below ``eskf_ros``): that of the longest name it belongs to."""
    found = [
        (len(room), floor)
        for floor, rooms in enumerate(FLOORS)
        for room in rooms
        if module == room or module.startswith(room + ".")
    ]
    assert found, f"{module} is in no room: add it to FLOORS"
    return max(found)[1]


def room_of(module: str) -> str:
    rooms = [room for rooms in FLOORS for room in rooms if module == room or module.startswith(room + ".")]
    return max(rooms, key=len)


def imports_of(source: Path) -> Iterator[str]:
    """Modules of the package that a file imports, but for those that only the type checker reads."""
    for node in ast.parse(source.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("eskf_ros"):
            for alias in node.names:
                name = f"{node.module}.{alias.name}"
                is_module = (PACKAGE.parent / name.replace(".", "/")).with_suffix(".py").exists()
                yield (name if is_module else node.module).removeprefix("eskf_ros").removeprefix(".")


def module_of(source: Path) -> str:
    parts = source.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


SOURCES = [source for source in sorted(PACKAGE.rglob("*.py")) if module_of(source) not in ("", "filter")]


@pytest.mark.parametrize("source", SOURCES, ids=module_of)
def test_rooms_point_down(source: Path) -> None:
    module = module_of(source)
    upwards = [
        other
        for other in imports_of(source)
        if other and floor_of(other) >= floor_of(module) and room_of(other) != room_of(module)
    ]
    assert not upwards, f"{module} imports {upwards}, which is on its floor or above it"


def test_only_the_node_imports_ros() -> None:
    importers = {
        source.relative_to(PACKAGE).parts[0]
        for source in SOURCES
        for node in ast.walk(ast.parse(source.read_text(encoding="utf-8")))
        if isinstance(node, ast.Import | ast.ImportFrom)
        for name in ([node.module] if isinstance(node, ast.ImportFrom) else [alias.name for alias in node.names])
        if name and name.split(".")[0] == "rclpy"
    }
    assert importers == {"ros_node"}


def test_only_the_replay_asks_for_a_report() -> None:
    """The robot needs neither the page nor what draws it: not even the replay imports it before it is asked for."""
    asking = {
        module_of(source)
        for source in SOURCES
        for node in ast.walk(ast.parse(source.read_text(encoding="utf-8")))
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("eskf_ros.report")
        if not source.is_relative_to(PACKAGE / "report")
    }
    assert asking == {"replay.main"}
    assert "report" not in {room_of(name) for name in imports_of(PACKAGE / "replay" / "main.py")}


def root_of(node: ast.expr) -> ast.expr:
    while isinstance(node, ast.Subscript):
        node = node.value
    return node


def field_of(node: ast.expr) -> str:
    """The field of the estimate that an expression is, or is a part of; empty for all else."""
    root = root_of(node)
    if (
        isinstance(root, ast.Attribute)
        and isinstance(root.value, ast.Name)
        and root.value.id in ("state", "lane", "humble")
    ):
        return root.attr if root.attr in ESTIMATE else ""
    return ""


def pairs(node: ast.Assign) -> Iterator[tuple[ast.expr, ast.expr]]:
    """Targets and values of an assignment, element by element where both are tuples."""
    for target in node.targets:
        if isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple):
            yield from zip(target.elts, node.value.elts)
        elif isinstance(target, ast.Tuple):
            yield from ((element, node.value) for element in target.elts)
        else:
            yield target, node.value


def writes_estimate(function: ast.FunctionDef) -> bool:
    """Whether a function assigns to elements of the estimate: by name, by another name for an array, by argument."""
    aliases = {argument.arg for argument in function.args.args if argument.arg == "covariance"}
    for node in ast.walk(function):
        if isinstance(node, ast.Assign):
            for target, value in pairs(node):
                is_element = isinstance(value, ast.Subscript) and not isinstance(value.slice, ast.Slice | ast.Tuple)
                if isinstance(target, ast.Name) and field_of(value) and not is_element:
                    aliases.add(target.id)
    targets: list[ast.expr] = []
    for node in ast.walk(function):
        if isinstance(node, ast.Assign):
            targets += [target for target, _ in pairs(node)]
        elif isinstance(node, ast.AugAssign):
            targets.append(node.target)
    for target in targets:
        root = root_of(target)
        is_alias = isinstance(root, ast.Name) and root.id in aliases
        if isinstance(target, ast.Subscript) and (field_of(target) or is_alias):
            return True
    return False


def functions_of(source: Path) -> Iterator[ast.FunctionDef]:
    for node in ast.walk(ast.parse(source.read_text(encoding="utf-8"))):
        if isinstance(node, ast.FunctionDef):
            yield node


def test_the_writers_of_the_estimate_are_these() -> None:
    found: dict[str, set[str]] = {}
    for source in sorted(FILTER.rglob("*.py")):
        names = {function.name for function in functions_of(source) if writes_estimate(function)}
        if names:
            found[source.relative_to(FILTER).as_posix()] = names
    assert found == WRITERS


def test_writers_are_named_for_it() -> None:
    names = {name for names in WRITERS.values() for name in names}
    assert all(name.startswith(("reset_", "inflate_", "propagate_", "update_")) for name in names)


def test_functions_that_promise_to_look_do_not_write_the_state() -> None:
    """``is_`` and ``has_`` in the filter: a reader may call them in any order."""
    writers = []
    for source in sorted(FILTER.rglob("*.py")):
        for function in functions_of(source):
            if not function.name.startswith(("is_", "has_")):
                continue
            for node in ast.walk(function):
                targets = [*node.targets] if isinstance(node, ast.Assign) else []
                targets += [node.target] if isinstance(node, ast.AugAssign) else []
                if any(ast.unparse(target).startswith("state.") for target in targets):
                    writers.append(f"{source.name}: {function.name}")
    assert not writers


@pytest.mark.parametrize("source", SOURCES, ids=module_of)
def test_long_files_and_functions_give_their_reason(source: Path) -> None:
    text = source.read_text(encoding="utf-8")
    tree = ast.parse(text)
    if len(text.splitlines()) > 400:
        assert "Over 400 lines: " in (ast.get_docstring(tree) or "")
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef) and (node.end_lineno or 0) - node.lineno + 1 > 60:
            assert "Over 60 lines: " in (ast.get_docstring(node) or ""), node.name


def test_no_field_of_the_state_has_the_name_of_an_attribute_of_records() -> None:
    """Uncompiled, ``state.room.sum`` would be a method of numpy."""

    def names(kind: np.dtype) -> set[str]:
        kind = kind.base
        return set().union(*({name} | names(kind[name]) for name in kind.names or ()))

    assert not names(STATE) & set(dir(np.record))
