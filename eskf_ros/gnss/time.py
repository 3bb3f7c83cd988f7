"""GNSS time: GPS week and seconds of week, and its relation to the time of the other systems.

An instant is a pair (week, seconds of week) in GPS time everywhere in this package. A single float of seconds since
1980 resolves 0.2 us, in which a satellite moves by a millimetre; the pair resolves 0.1 ns. Weeks count from 6 January
1980 without rolling over.
"""

from __future__ import annotations

import datetime
from bisect import bisect_right

from eskf_ros.compiled import njit

SECONDS_PER_DAY = 86400.0
SECONDS_PER_WEEK = 604800.0

BEIDOU_OFFSET = 14.0
"""GPS time minus BeiDou time, s (BDS-SIS-ICD-B1I 3.0: BDT started at UTC of 1 January 2006)."""

_FIRST_DAY = datetime.date(1980, 1, 6).toordinal()
_UNIX_DAY = datetime.date(1970, 1, 1).toordinal()
_SECOND = 1_000_000_000

# Days on which GPS minus UTC grew by one second, from 0 (IERS Bulletin C).
_LEAP_DAYS = tuple(
    datetime.date(year, month, 1).toordinal()
    for year, month in (
        (1981, 7),
        (1982, 7),
        (1983, 7),
        (1985, 7),
        (1988, 1),
        (1990, 1),
        (1991, 1),
        (1992, 7),
        (1993, 7),
        (1994, 7),
        (1996, 1),
        (1997, 7),
        (1999, 1),
        (2006, 1),
        (2009, 1),
        (2012, 7),
        (2015, 7),
        (2017, 1),
    )
)

Instant = tuple[int, float]
"""Week and seconds of week."""


def from_calendar(year: int, month: int, day: int, hour: int, minute: int, second: float) -> Instant:
    """Return (week, seconds of week) of a date and time on a scale without leap seconds, counted from 6 January 1980.

    The result is on the same scale as the date: a UTC date still lacks `leap_seconds`. Raises ValueError for a date
    that does not exist.
    """
    if not (0 <= hour < 25 and 0 <= minute < 60 and 0.0 <= second < 61.0):
        raise ValueError(f"no such time of day: {hour}:{minute}:{second}")
    days = datetime.date(year, month, day).toordinal() - _FIRST_DAY
    week, weekday = divmod(days, 7)
    return normalized(week, weekday * SECONDS_PER_DAY + hour * 3600.0 + minute * 60.0 + second)


def normalized(week: int, seconds: float) -> Instant:
    """Return the instant with seconds of week between 0 and 604800."""
    weeks = int(seconds // SECONDS_PER_WEEK)
    return week + weeks, seconds - weeks * SECONDS_PER_WEEK


def leap_seconds(year: int, month: int, day: int) -> int:
    """Return GPS time minus UTC (s) on a UTC date: 18 since 1 January 2017."""
    return bisect_right(_LEAP_DAYS, datetime.date(year, month, day).toordinal())


def date_of(week: int, seconds: float) -> datetime.date:
    """Return the date of an instant. Raises ValueError or OverflowError outside of the years 1 to 9999."""
    return datetime.date.fromordinal(_FIRST_DAY + 7 * week + int(seconds // SECONDS_PER_DAY))


def week_near(seconds: float, near: Instant) -> int:
    """Return the week in which ``seconds`` of week are closest to the instant ``near``, at most half a week away.

    Broadcast weeks are truncated (10 bits roll over every 1024 weeks) and often wrong by one around the end of a week;
    seconds of week with a known date nearby have neither problem.
    """
    return near[0] + round((near[1] - seconds) / SECONDS_PER_WEEK)


def from_unix(stamp: int) -> Instant:
    """Return the GPS time of a stamp in ns of Unix time (UTC without its leap seconds, as computers keep it)."""
    days = stamp // (86400 * _SECOND) + _UNIX_DAY
    date = datetime.date.fromordinal(days)
    since = stamp - (_FIRST_DAY - _UNIX_DAY) * 86400 * _SECOND
    since += leap_seconds(date.year, date.month, date.day) * _SECOND
    week, rest = divmod(since, 604800 * _SECOND)
    return week, rest / _SECOND


def to_unix(week: int, seconds: float) -> int:
    """Return the stamp in ns of Unix time of an instant of GPS time, the inverse of `from_unix`."""
    since = (_FIRST_DAY - _UNIX_DAY) * 86400 * _SECOND + week * 604800 * _SECOND + round(seconds * _SECOND)
    # Leap seconds are those of the date in UTC, which may be the day before that of GPS time.
    late = date_of(week, seconds)
    date = date_of(week, seconds - leap_seconds(late.year, late.month, late.day))
    return since - leap_seconds(date.year, date.month, date.day) * _SECOND


@njit
def elapsed(week, seconds, since_week, since_seconds):
    """Return the seconds from one instant to another, exact to 0.1 ns within a year."""
    return (week - since_week) * SECONDS_PER_WEEK + (seconds - since_seconds)
