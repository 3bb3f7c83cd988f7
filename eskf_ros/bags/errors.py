"""The one exception of this package."""

from __future__ import annotations


def one_line(error: object) -> str:
    """Return the text of an error without line breaks: that of a library may quote a whole SQL statement."""
    return " ".join(line.strip() for line in str(error).splitlines())


class BagError(Exception):
    """A recording cannot be read or written. Its text is one line for the user: what is wrong, where, what to do."""
