"""Documents whose parts are written by several commands."""

from __future__ import annotations

from pathlib import Path


def replace_section(document: Path, title: str, text: str) -> None:
    """Write ``text`` below the heading ``## title`` of a Markdown document, in place of what stands there."""
    before = document.read_text(encoding="utf-8") if document.exists() else "# Trust\n\n"
    head, *sections = before.split("\n## ")
    parts = {section.partition("\n")[0]: section.partition("\n")[2] for section in sections}
    parts[title] = f"\n{text.strip()}\n"
    body = "".join(f"\n## {name}\n{part.rstrip()}\n" for name, part in parts.items())
    document.write_text(f"{head.rstrip()}\n{body}", encoding="utf-8")
