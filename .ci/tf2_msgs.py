#!/usr/bin/env python3
"""Builds the Python package tf2_msgs, which is not on PyPI, from its definition: for the tests of the transforms.

    .venv/bin/python .ci/tf2_msgs.py FOLDER    # afterwards PYTHONPATH=FOLDER gives tf2_msgs to this .venv

With the generators that come with ROS from PyPI, gcc and g++. What CMake does elsewhere, for one message.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import sysconfig
from collections.abc import Callable
from pathlib import Path
from typing import Any

PREFIX = Path(sys.prefix)
DEFINITION = "geometry_msgs/TransformStamped[] transforms\n"
SUPPORTS = ("rosidl_typesupport_fastrtps_c", "rosidl_typesupport_introspection_c")


def generate(folder: Path, package: Path) -> None:
    """Write the sources of the package."""
    from rosidl_adapter.msg import convert_msg_to_idl
    from rosidl_generator_c import generate_c
    from rosidl_generator_py import generate_py
    from rosidl_generator_type_description import generate_type_hash
    from rosidl_typesupport_c import generate_c as generate_support
    from rosidl_typesupport_fastrtps_c import generate_typesupport_fastrtps_c
    from rosidl_typesupport_introspection_c import generate_c as generate_introspection

    messages = package / "msg"
    messages.mkdir(parents=True, exist_ok=True)
    (messages / "TFMessage.msg").write_text(DEFINITION)
    convert_msg_to_idl(package, "tf2_msgs", Path("msg/TFMessage.msg"), messages)
    share = [path for path in (PREFIX / "share").iterdir() if (path / "msg").is_dir()]
    common: dict[str, Any] = {
        "package_name": "tf2_msgs",
        "output_dir": str(package),
        "idl_tuples": [f"{package}:msg/TFMessage.idl"],
        "include_paths": [f"{path.name}:{path}" for path in share],
        "ros_interface_dependencies": [f"{path.name}:{idl}" for path in share for idl in (path / "msg").glob("*.idl")],
        "target_dependencies": [],
        "type_description_tuples": [f"msg/TFMessage.idl:{messages / 'TFMessage.json'}"],
    }
    arguments = folder / "arguments.json"

    def run(generator: Callable[..., object], name: str, *others: object) -> None:
        arguments.write_text(json.dumps({**common, "template_dir": str(PREFIX / "share" / name / "resource")}))
        generator(str(arguments), *others)

    run(generate_type_hash, "rosidl_generator_type_description")
    run(generate_c, "rosidl_generator_c")
    run(generate_introspection, SUPPORTS[1])
    run(generate_typesupport_fastrtps_c, SUPPORTS[0])
    run(generate_support, "rosidl_typesupport_c", list(SUPPORTS))
    run(generate_py, "rosidl_generator_py", ["rosidl_typesupport_c", SUPPORTS[0]])
    arguments.unlink()
    for name in ("rosidl_generator_c", *SUPPORTS):
        header = f"{name}__visibility_control.h"
        text = (PREFIX / "include/geometry_msgs/geometry_msgs/msg" / header).read_text()
        for old, new in (("geometry_msgs", "tf2_msgs"), ("GEOMETRY_MSGS", "TF2_MSGS")):
            text = text.replace(old, new)
        (messages / header).write_text(text)
    (package / "__init__.py").touch()


def compile_sources(folder: Path, package: Path) -> None:
    """Make the libraries; each knows the ones before it."""
    import numpy

    includes = [folder, PREFIX / "include", *(path for path in (PREFIX / "include").iterdir() if path.is_dir())]
    includes += [Path(sysconfig.get_path("include")), Path(numpy.get_include())]
    roles = ("rosidl_generator_c", *SUPPORTS, "rosidl_typesupport_c", "rosidl_generator_py")
    libraries = [f"geometry_msgs__{role}" for role in roles]
    libraries += ["rosidl_runtime_c", "rosidl_typesupport_c", *SUPPORTS, "fastcdr"]

    def link(library: str, *sources: str) -> None:
        command = ["g++" if sources[0].endswith(".cpp") else "gcc", "-shared", "-fPIC", "-O1"]
        command += [f"-I{path}" for path in includes] + [str(package / source) for source in sources]
        command += ["-o", str(package / library), "-Wl,--no-as-needed", f"-L{PREFIX / 'lib'}", f"-L{package}"]
        command += [f"-l{name}" for name in libraries]
        command += [f"-Wl,-rpath,{PREFIX / 'lib'}:$ORIGIN", "-Wl,--unresolved-symbols=ignore-all"]
        subprocess.run(command, check=True)
        if library.startswith("lib"):
            libraries.append(library.removeprefix("lib").removesuffix(".so"))

    detail = "msg/detail/tf_message__"
    link("libtf2_msgs__rosidl_generator_c.so", f"{detail}functions.c", f"{detail}description.c")
    link(f"libtf2_msgs__{SUPPORTS[0]}.so", f"{detail}type_support_c.cpp")
    link(f"libtf2_msgs__{SUPPORTS[1]}.so", f"{detail}type_support.c")
    link("libtf2_msgs__rosidl_typesupport_c.so", "msg/tf_message__type_support.cpp")
    link("libtf2_msgs__rosidl_generator_py.so", "msg/_tf_message_s.c")
    for name in ("rosidl_typesupport_c", SUPPORTS[0]):
        link(f"tf2_msgs_s__{name}{sysconfig.get_config_var('EXT_SUFFIX')}", f"_tf2_msgs_s.ep.{name}.c")


def main() -> None:
    folder = Path(sys.argv[1]).resolve()
    package = folder / "tf2_msgs"
    os.environ["AMENT_PREFIX_PATH"] = str(PREFIX)
    generate(folder, package)
    compile_sources(folder, package)


if __name__ == "__main__":
    main()
