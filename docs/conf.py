"""How the documents become a site: Sphinx with MyST, built by `.ci/docs` (docs/developing.md says why these).

The sources are the files as they are read on GitHub. Their root is the checkout, so that links to README.md, config/
and examples/ are checked as well. The order of the pages is `PAGES`; a new page not named there goes to the end.
"""

from __future__ import annotations

import sys
from pathlib import Path

CHECKOUT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(CHECKOUT))

project = "eskf_ros"
author = "eskf_ros maintainers"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinxcontrib.mermaid"]
root_doc = "README"
include_patterns = ["README.md", "CONTRIBUTING.md", "QUALITY_DECLARATION.md", "CHANGELOG.rst", "docs/**.md"]
exclude_patterns = [".*", "build", "install", "log", "results", "shared"]

PAGES = {
    "Use": ["start", "install", "recording", "replay", "report", "check", "node", "topics", "parameters"],
    "Set up": ["profiles", "receivers", "tuning", "calibrate", "troubleshooting", "heading", "migrate", "nav2"],
    "More to use": ["api", "simulate", "smoother", "tight", "ranges", "views", "watch", "fleets"],
    "Learn": ["lessons/README", "lessons/*", "theory", "architecture"],
    "How good it is": ["results", "trust", "trust_independent", "consistency", "benchmarks", "small_boards", "peers"],
    "Change it": ["developing", "add_a_measurement", "releasing", "../CONTRIBUTING", "../CHANGELOG"],
    "What it promises": ["../QUALITY_DECLARATION"],
}
"""Pages below docs/ by chapter; a pattern stands for what it matches, and what is not there is left out."""

myst_enable_extensions = ["dollarmath"]
myst_fence_as_directive = ["math", "mermaid"]
myst_heading_anchors = 4  # headings have the anchors that GitHub gives them
suppress_warnings = ["myst.header"]  # tables written by benchmarks begin with the heading level of a file of their own
default_role = "code"
autodoc_typehints = "description"
autodoc_member_order = "bysource"
napoleon_use_ivar = True

html_theme = "furo"
html_title = "eskf_ros"
html_copy_source = False


def chapters() -> list[tuple[str, list[str]]]:
    """Return the chapters with the pages that are there, as paths below the checkout without their ending."""
    documents = CHECKOUT / "docs"
    named: list[Path] = []
    found = []
    for chapter, patterns in PAGES.items():
        pages = []
        for pattern in patterns:
            folder, name = (documents / pattern).parent.resolve(), Path(pattern).name
            matches = [*folder.glob(f"{name}.md"), *folder.glob(f"{name}.rst")]
            pages += [path for path in sorted(matches) if path not in named and path not in pages]
        named += pages
        found.append((chapter, pages))
    others = [path for path in sorted(documents.rglob("*.md")) if path not in named]
    found.append(("Other", others))
    return [
        (chapter, [path.relative_to(CHECKOUT).with_suffix("").as_posix() for path in pages])
        for chapter, pages in found
        if pages
    ]


def as_myst(app: object, name: str, source: list[str]) -> None:
    """Turn what GitHub writes otherwise than MyST (formulas), and give the first page the list of all pages."""
    source[0] = source[0].replace("$`", "$").replace("`$", "$")
    if name == root_doc:
        for chapter, pages in chapters():
            listed = "\n".join(f"/{page}" for page in pages)
            source[0] += f"\n\n```{{toctree}}\n:hidden:\n:caption: {chapter}\n\n{listed}\n```\n"


def add_index(app, error: Exception | None) -> None:
    """Lead whoever opens the folder of the site to its first page."""
    if error is None and app.builder.format == "html":
        page = '<!doctype html><meta http-equiv="refresh" content="0; url=README.html"><title>eskf_ros</title>\n'
        (Path(app.outdir) / "index.html").write_text(page, encoding="utf-8")


def setup(app) -> None:
    """Register the hooks above."""
    app.connect("source-read", as_myst)
    app.connect("build-finished", add_index)
