"""Stamps: integer nanoseconds on the clock of the IMU."""

from __future__ import annotations

SECOND = 1_000_000_000

NEVER = -(2**62)
"""Stamp before all others: of what has not happened yet."""
