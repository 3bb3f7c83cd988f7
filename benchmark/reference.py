"""The kernels against plain numpy over ten minutes of a drive, loose and tight: the largest relative differences.

    python benchmark/reference.py [--minutes 10]

`test/support/reference_filter.py` is the filter once more, in dense matrices, from the equations of docs/theory.md.
Exits with 1 if a difference is above 1e-9.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "test"))

from support.reference_run import compare_loose, compare_tight, largest

AGREED = 1e-9

ALIGNED = 40.0
"""s of the drive until both lanes run."""


def main() -> int:
    """Compare and print; return 1 if something differs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10.0)
    stop = ALIGNED + 60.0 * parser.parse_args().minutes
    worst = 0.0
    for mode, compare in (("loose", compare_loose), ("tight", compare_tight)):
        found = compare(stop)
        print(f"{mode}, {found[-1].seconds:.0f} s")
        for name, difference in largest(found).items():
            print(f"  {name:35} {difference:.1e}")
            worst = max(worst, difference)
    return 0 if worst < AGREED else 1


if __name__ == "__main__":
    sys.exit(main())
