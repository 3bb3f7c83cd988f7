"""docs/lessons is what the lessons write, their commands can be given, and some of them are run."""

from __future__ import annotations

import re
import runpy
import shlex
import string
from pathlib import Path
from typing import Any

import pytest

from eskf_ros.replay.arguments import parser as replay_parser
from eskf_ros.simulate.main import _options as simulate_options
from eskf_ros.simulate.main import _parser as simulate_parser
from eskf_ros.simulate.scenarios import scenario

CHECKOUT = Path(__file__).resolve().parents[2]
DOCUMENTS = CHECKOUT / "docs" / "lessons"
PROGRAM = runpy.run_path(str(CHECKOUT / "examples" / "lessons"))
LESSONS: dict[str, Any] = PROGRAM["LESSONS"]


def pattern_of(template: str) -> str:
    """Return what matches a text with any figures in it."""
    parts = string.Formatter().parse(template)
    return "".join(re.escape(text) + ("" if name is None else ".+?") for text, name, _, _ in parts)


class AnyFigure(dict[str, str]):
    """Leaves the places of the figures as they are."""

    def __missing__(self, name: str) -> str:
        return "{" + name + "}"


@pytest.mark.parametrize("name", LESSONS)
def test_a_page_is_the_text_of_its_lesson(name: str) -> None:
    """Whoever changes the text of a lesson writes its page anew."""
    page = (DOCUMENTS / f"{name}.md").read_text(encoding="utf-8")
    template = LESSONS[name].page(AnyFigure())
    assert re.fullmatch(pattern_of(template), page, re.DOTALL), f"python examples/lessons {name} writes it"
    index = (DOCUMENTS / "README.md").read_text(encoding="utf-8")
    assert re.search(rf"\({name}\.md\) \| {pattern_of(LESSONS[name].sentence)} \|\n", index)
    assert f"![{LESSONS[name].title}]({name}.png)" in page
    assert 5_000 < (DOCUMENTS / f"{name}.png").stat().st_size < 60_000


def test_there_is_nothing_else_in_the_folder() -> None:
    expected = {f"{name}.{ending}" for name in LESSONS for ending in ("md", "png")} | {"README.md"}
    assert {path.name for path in DOCUMENTS.iterdir()} == expected


def commands() -> list[str]:
    texts = [lesson.by_hand.replace("\\\n", " ") for lesson in LESSONS.values()]
    return [line for text in texts for line in re.findall(r"^\.venv/bin/(.*)$", text, re.MULTILINE)]


@pytest.mark.parametrize("command", commands())
def test_commands_of_the_pages_can_be_given(command: str) -> None:
    """Scenarios, episodes, sensors and options that exist."""
    program, *arguments = shlex.split(command, comments=True)
    if program == "eskf_replay":
        assert replay_parser().parse_args(arguments).truth == "truth"
        return
    assert program == "eskf_simulate"
    options = simulate_parser().parse_args(arguments)
    assert scenario(options.scenario).description
    assert simulate_options(options)["grade"]


@pytest.mark.parametrize(("name", "runs"), [("unobservable_heading", 1), ("complementary_filter", 1), ("feedback", 1)])
def test_what_a_page_says_is_borne_out(name: str, runs: int) -> None:
    """The claims that the text rests on, from a run of the lesson, with as few drives as it can do with."""
    outcome = LESSONS[name].run(runs)
    failed = [claim for claim, holds in outcome.claims.items() if not holds]
    assert not failed
    assert len(outcome.claims) >= 3
    assert "{" not in LESSONS[name].page(outcome.figures)


def test_the_program_writes_a_page(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert PROGRAM["main"](["late_stamps", "--out", str(tmp_path)]) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["README.md", "late_stamps.md", "late_stamps.png"]
    assert "late_stamps: Stamps that are 0.2 s late" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        PROGRAM["main"](["no_such_lesson"])
