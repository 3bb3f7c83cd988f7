"""The one exception of this package."""

from __future__ import annotations


class BagError(Exception):
    """A recording cannot be read or written. Its text is one line for the user: what is wrong, where, what to do."""
