"""Parameter files of ROS 2: sections by node names, wildcards, typed values."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from os import PathLike
from pathlib import Path
from typing import Any

import yaml

from eskf_ros.parameters.mapping import flat, from_mapping
from eskf_ros.parameters.profiles import profile_path
from eskf_ros.parameters.schema import ParameterError
from eskf_ros.parameters.tree import Parameters


class _RosLoader(yaml.SafeLoader):
    """Reads `1e-3` as a number, as ROS and people do (in YAML 1.1 it is a string), and refuses repeated keys."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key_node, _ in node.value:
            if key_node.value in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"{key_node.value} is given twice", key_node.start_mark
                )
            seen.add(key_node.value)
        mapping: dict[Any, Any] = super().construct_mapping(node, deep)
        return mapping


_RosLoader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)[eE][-+]?[0-9]+$"), list("-+.0123456789")
)


def load(path: str | PathLike[str] | None, node_name: str = "eskf_node", profile: str = "") -> Parameters:
    """Return the parameters of a ROS 2 parameter file, over those of a profile if one is named.

    Sections apply as in ROS: `/**`, `/*`, `eskf_node`, `/robot/eskf_node`, or nested namespaces; sections of other
    nodes are ignored; if several apply, the later one in the file wins. A `node_name` without a leading slash stands
    for the node in any single namespace that the file uses.

    Raises ParameterError (naming the file and every mistake in it) for a file that cannot be read, is no YAML, has no
    section for this node, or fails `from_mapping`; and for a profile that is not there.
    """
    merged = profile_values(profile) if profile else {}
    if path:
        merged |= _values(Path(path), node_name)
    return from_mapping(merged, str(path or f"profile {profile}"))


def profile_values(profile: str) -> dict[str, object]:
    """Return the values of a profile by dotted name. Raises ParameterError if there is none of this name."""
    return _values(profile_path(profile), "eskf_node")


def _values(path: Path, node_name: str) -> dict[str, object]:
    """Return the values that a file gives to a node, by dotted name."""
    source = str(path)
    sections = read_sections(path)
    applying = [(name, content) for name, content in sections if _applies(name, node_name)]
    if not applying:
        names = ", ".join(name for name, _ in sections)
        raise ParameterError(source, [f"no section applies to node {node_name}; the sections are {names}"])
    concrete = sorted({name for name, _ in applying if "*" not in name})
    if len(concrete) > 1:
        raise ParameterError(
            source, [f"sections for several nodes called {node_name}: {', '.join(concrete)}; keep one"]
        )
    merged: dict[str, object] = {}
    for name, content in applying:
        if content is None:
            raise ParameterError(source, [f"{name}: nothing below 'ros__parameters:'"])
        merged.update(content)
    return merged


def read_sections(path: str | PathLike[str]) -> list[tuple[str, dict[str, object] | None]]:
    """Return the sections of a ROS 2 parameter file: node and values by dotted name (None: there is nothing in it).

    Raises ParameterError for a file that cannot be read, is no YAML, or has no section.
    """
    source = str(Path(path))
    try:
        document = yaml.load(Path(path).read_text(encoding="utf-8"), Loader=_RosLoader)
    except OSError as error:
        raise ParameterError(source, [f"cannot read the parameter file: {error.strerror}"]) from error
    except UnicodeDecodeError as error:
        raise ParameterError(source, ["not a text file, so not a parameter file"]) from error
    except yaml.YAMLError as error:
        raise ParameterError(source, [f"not valid YAML: {' '.join(str(error).split())}"]) from error
    wanted = "a ROS parameter file has '/**:', below it 'ros__parameters:', and below that the parameters"
    if not isinstance(document, Mapping):
        raise ParameterError(source, [f"no parameters found; {wanted}"])
    sections = list(_sections(document, ""))
    if not sections:
        raise ParameterError(source, [f"no 'ros__parameters:' found; {wanted}"])
    return [(name, flat(content, source) if isinstance(content, Mapping) else None) for name, content in sections]


def _sections(document: Mapping[str, object], namespace: str) -> Iterator[tuple[str, object]]:
    for key, value in document.items():
        if key == "ros__parameters":
            yield namespace or "/", value
        elif isinstance(value, Mapping):
            yield from _sections(value, f"{namespace}/{str(key).strip('/')}")


def _applies(section: str, node_name: str) -> bool:
    pattern = re.escape(section).replace(r"/\*\*", r"(/\w+)*").replace(r"/\*", r"/\w+")
    if node_name.startswith("/"):
        return re.fullmatch(pattern, node_name) is not None
    if "*" not in section:
        return section.rpartition("/")[2] == node_name
    # The namespace is unknown here: a pattern applies if it matches in some namespace.
    last = section.rpartition("/")[2]
    return last in (node_name, "*", "**")
