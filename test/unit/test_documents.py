"""The documents say what is: parameters they name exist and are accepted, and sentences they quote are the filter's.

Links are checked where the documents are made into a site (`.ci/docs`).
"""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

from eskf_ros.parameters.mapping import flat, to_mapping
from eskf_ros.parameters.ros_yaml import load
from eskf_ros.parameters.tree import Parameters

CHECKOUT = Path(__file__).resolve().parents[2]
PAGES = sorted([*CHECKOUT.glob("*.md"), *(CHECKOUT / "docs").rglob("*.md")])
OF_OTHER_PACKAGES = {"migrate.md"}
"""Pages that name parameters of other packages, too."""

SOURCES = [ast.parse(path.read_text(encoding="utf-8")) for path in (CHECKOUT / "eskf_ros").rglob("*.py")]
FUNCTIONS = {node.name for tree in SOURCES for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}
PARAMETERS = set(flat(to_mapping(Parameters()), "the defaults"))
GROUPS = {name.partition(".")[0] for name in PARAMETERS if "." in name}
ELLIPSIS = "…"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(CHECKOUT).as_posix())
def test_parameters_that_a_page_names_exist(page: Path) -> None:
    if page.name in OF_OTHER_PACKAGES:
        return
    named = re.findall(r"`([a-z_]+\.[a-z_0-9]+)(?::[^`]*)?`", page.read_text(encoding="utf-8"))
    of_ours = {name for name in named if name.partition(".")[0] in GROUPS and not is_code(name)}
    assert of_ours <= PARAMETERS, f"{page.name} names {sorted(of_ours - PARAMETERS)}"


def is_code(name: str) -> bool:
    """Say whether a dotted name is a file, or a function in its file: heading.align_to_course is one."""
    return name.endswith(".py") or name.partition(".")[2] in FUNCTIONS


def parameter_files() -> list[tuple[str, str]]:
    """Return page and text of each parameter file that a page shows."""
    found = []
    for page in PAGES:
        blocks = re.findall(r"^```yaml\n(.*?)^```", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
        found += [(page.name, block) for block in blocks if "ros__parameters:" in block]
    return found


def test_parameter_files_that_pages_show_are_accepted(tmp_path: Path) -> None:
    files = parameter_files()
    assert len(files) >= 7, "one for each receiver of receivers.md"
    for page, text in files:
        path = tmp_path / "shown.yaml"
        path.write_text(text, encoding="utf-8")
        assert to_mapping(load(path)) != to_mapping(Parameters()), f"{page} shows a file that changes nothing:\n{text}"


def texts_of_the_sources() -> list[str]:
    """Return all texts in the sources, formatted ones with ELLIPSIS for what is put in."""
    found = []
    for tree in SOURCES:
        for node in ast.walk(tree):
            if isinstance(node, ast.JoinedStr):
                parts = [part.value if isinstance(part, ast.Constant) else ELLIPSIS for part in node.values]
                found.append("".join(map(str, parts)))
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                found.append(node.value)
    return found


def test_troubleshooting_quotes_what_the_filter_says() -> None:
    """Who searches the page for the words on his screen finds them."""
    page = (CHECKOUT / "docs" / "troubleshooting.md").read_text(encoding="utf-8")
    quotes = [quote for row in re.findall(r"^\| (.*?) \|", page, re.MULTILINE) for quote in re.findall('"(.+?)"', row)]
    assert len(quotes) > 40
    texts = texts_of_the_sources()
    patterns = {quote: ".*".join(re.escape(piece) for piece in quote.split(ELLIPSIS)) for quote in quotes}
    unsaid = [quote for quote, pattern in patterns.items() if not any(re.search(pattern, text) for text in texts)]
    assert not unsaid, "nothing in eskf_ros says this (any more)"


def test_readme_is_short() -> None:
    """What it is, how to try it, where to go on; the rest is in docs/."""
    assert len((CHECKOUT / "README.md").read_text(encoding="utf-8").splitlines()) < 150
