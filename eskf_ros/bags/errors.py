"""The one exception of this package."""

from __future__ import annotations


def one_line(error: object) -> str:
    """A text from elsewhere (a library's error may quote a whole SQL statement) without its line breaks."""
    return " ".join(line.strip() for line in str(error).splitlines())


class BagError(Exception):
    """A recording cannot be read or written. Its text is one line for the user: what is wrong, where, what to do."""
