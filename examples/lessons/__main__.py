"""Write docs/lessons: run each lesson, draw its picture, put its figures into its page.

    python examples/lessons [NAME ...] [--out DIR]

Without names it runs all thirteen, in a few minutes. It says which statement of a page the
figures no longer bear out, and ends with the exit code 1 then. Needs matplotlib (extra ``[lessons]``).
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path

import complementary_filter
import feedback
import few_satellites
import fix_interval
import imu_grade
import ins_and_gnss
import late_stamps
import lever_arm_forgotten
import lying_covariance
import multipath_gate
import tilt_and_gravity
import tunnel_biases
import unobservable_heading
from lesson import Lesson, Outcome
from matplotlib import pyplot as plt
from PIL import Image  # matplotlib brings it

MODULES = (
    ins_and_gnss,
    tunnel_biases,
    fix_interval,
    tilt_and_gravity,
    lever_arm_forgotten,
    late_stamps,
    few_satellites,
    multipath_gate,
    unobservable_heading,
    imu_grade,
    complementary_filter,
    feedback,
    lying_covariance,
)
LESSONS: dict[str, Lesson] = {module.LESSON.name: module.LESSON for module in MODULES}

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "lessons"

INDEX = """# Lessons

Thirteen lessons in inertial navigation: each a small simulated scenario, a picture, the figures of the run, and what
they mean. Text and figures are written by one command, in a few minutes:

```sh
.venv/bin/python examples/lessons                 # all
.venv/bin/python examples/lessons fix_interval    # one of them
```

It needs matplotlib, which `./run test` installs (elsewhere: `pip install '.[lessons]'`). The code of a lesson is one
file in `examples/lessons`, made to be changed; the section "By hand" of each page shows the
same with the commands of this package. Figures hold for the seeds of the file; other seeds give others, about as large.

| lesson | in one sentence |
|---|---|
"""


def write(folder: Path, lesson: Lesson, outcome: Outcome) -> None:
    """Write page and picture of a lesson."""
    drawn = BytesIO()
    outcome.picture.savefig(drawn, dpi=80)
    plt.close(outcome.picture)
    # 64 colours show lines as well as 16 million do, in half the bytes.
    picture = Image.open(drawn).convert("RGB").quantize(64, dither=Image.Dither.NONE)
    picture.save(folder / f"{lesson.name}.png", optimize=True)
    (folder / f"{lesson.name}.md").write_text(lesson.page(outcome.figures), encoding="utf-8")


def index(folder: Path) -> str:
    """Return the index of the pages in a folder, each with its sentence, the first paragraph."""
    lines = [
        f"| [{lesson.title}]({name}.md) | {(folder / f'{name}.md').read_text(encoding='utf-8').splitlines()[2]} |\n"
        for name, lesson in LESSONS.items()
        if (folder / f"{name}.md").exists()
    ]
    return "".join([INDEX, *lines])


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the lessons that are named; return how many no longer bear out what they say, at most 1."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"one of {', '.join(LESSONS)}")
    parser.add_argument("--out", type=Path, default=FOLDER, metavar="DIR", help="default: docs/lessons")
    options = parser.parse_args(arguments)
    if unknown := set(options.names) - LESSONS.keys():
        parser.error(f"no such lesson: {', '.join(sorted(unknown))}; there are {', '.join(LESSONS)}")
    options.out.mkdir(parents=True, exist_ok=True)
    is_borne_out = True
    for name in options.names or LESSONS:
        lesson = LESSONS[name]
        outcome = lesson.run(lesson.runs)
        write(options.out, lesson, outcome)
        print(f"{name}: {lesson.sentence.format_map(outcome.figures)}", flush=True)
        for claim in (text for text, holds in outcome.claims.items() if not holds):
            is_borne_out = False
            print(f"{name}: no longer so: {claim}", file=sys.stderr, flush=True)
    (options.out / "README.md").write_text(index(options.out), encoding="utf-8")
    return 0 if is_borne_out else 1


if __name__ == "__main__":
    sys.exit(main())
