"""The command `eskf_migrate`: parameter files of robot_localization, navsat_transform or FusionCore as one of ours."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from eskf_ros.migrate import fusioncore, robot_localization
from eskf_ros.migrate.conversion import Conversion
from eskf_ros.parameters.ros_yaml import read_sections
from eskf_ros.parameters.schema import ParameterError

_EPILOG = """\
The parameters go to stdout (or --out FILE), with the report as a comment at the top; the report goes to stderr too.
Sections of other nodes are left out. docs/migrate.md has the tables, parameter by parameter.
"""


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="eskf_migrate",
        description="Turns parameter files of robot_localization with navsat_transform, or of FusionCore, into one of "
        "eskf_node, and says what has no counterpart.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("files", nargs="+", type=Path, metavar="FILE", help="ROS 2 parameter file, as ekf.yaml")
    parser.add_argument("--out", type=Path, metavar="FILE", help="write the parameters here instead of stdout")
    return parser


def migrate(files: Sequence[Path]) -> Conversion:
    """Return our parameters for those of the files; raises ParameterError for what cannot be read or is not known."""
    source = ", ".join(path.name for path in files)
    sections = [
        (name.rpartition("/")[2], content) for path in files for name, content in read_sections(path) if content
    ]
    try:
        if any(robot_localization.is_filter(section) or robot_localization.is_navsat(section) for section in sections):
            return robot_localization.convert(sections, source)
        if any(fusioncore.is_fusioncore(section) for section in sections):
            return fusioncore.convert(sections, source)
    except ValueError as error:
        raise ParameterError(source, [str(error)]) from error
    names = ", ".join(name for name, _ in sections)
    raise ParameterError(source, [f"no section of robot_localization, navsat_transform or FusionCore among: {names}"])


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit code: 0, or 2 for a file that cannot be read or is of another package."""
    options = _parser().parse_args(arguments)
    try:
        found = migrate(options.files)
        text = found.parameter_file()
        if options.out:
            options.out.write_text(text, encoding="utf-8")
        else:
            sys.stdout.write(text)
    except ParameterError as error:
        print(f"eskf_migrate: error: {'; '.join(str(error).splitlines())}", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"eskf_migrate: error: {error.filename}: {error.strerror}", file=sys.stderr)
        return 2
    print("\n".join(found.report()), file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(main())
