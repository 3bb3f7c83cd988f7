"""The Earth's magnetic field by the World Magnetic Model, through the library pygeomag, which need not be installed.

The field changes little from place to place and from year to year. It is computed once for each cell of
`PLACE_STEP_DEG`, `ALTITUDE_STEP` and `TIME_STEP`, at the middle of the cell: the result is a function of place and time
alone, whatever was asked before.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

Field = tuple[float, float, float]
"""Declination (rad, east of true north positive), inclination (rad, below the horizon positive), strength (T)."""

PLACE_STEP_DEG = 0.1
"""deg; size of a cell in latitude and longitude. With the other steps it leaves an error of a few hundredths of a
degree where the declination changes fast.
"""

ALTITUDE_STEP = 1000.0
"""m; size of a cell in altitude."""

TIME_STEP = 0.1
"""years; size of a cell in time."""

FIRST_YEAR, LAST_YEAR = 2010, 2029
"""First and last year of the coefficients in the library; three more years on either side are extrapolated."""

SECONDS_PER_YEAR = 31_556_952.0


class FieldUnknown(Exception):
    """The model does not know the field; the message is a sentence that says why and what to do."""


def field_at(latitude_deg: float, longitude_deg: float, altitude: float, stamp: int) -> Field:
    """Return the field at a place (deg, deg, ellipsoidal altitude in m) and ``stamp`` (ns since 1970).

    Raises FieldUnknown without the library, or for a year without a model.
    """
    year = 1970.0 + stamp * 1e-9 / SECONDS_PER_YEAR
    return _field_of_cell(
        math.floor(latitude_deg / PLACE_STEP_DEG),
        math.floor(longitude_deg / PLACE_STEP_DEG),
        math.floor(altitude / ALTITUDE_STEP),
        math.floor(year / TIME_STEP),
    )


@lru_cache(maxsize=1024)
def _field_of_cell(latitude: int, longitude: int, altitude: int, time: int) -> Field:
    year = (time + 0.5) * TIME_STEP
    if not FIRST_YEAR - 3 < year < LAST_YEAR + 4:
        raise FieldUnknown(
            f"the stamps are of the year {year:.0f}, for which there is no model of the magnetic field: set "
            "mag.declination_deg"
        )
    found = _model(min(max(int(year), FIRST_YEAR), LAST_YEAR)).calculate(
        glat=min(max((latitude + 0.5) * PLACE_STEP_DEG, -90.0), 90.0),
        glon=(longitude + 0.5) * PLACE_STEP_DEG,
        alt=(altitude + 0.5) * ALTITUDE_STEP * 1e-3,
        time=year,
        allow_date_outside_lifespan=True,
    )
    level = math.hypot(found.x, found.y)
    return math.atan2(found.y, found.x), math.atan2(found.z, level), math.hypot(level, found.z) * 1e-9


@lru_cache(maxsize=4)
def _model(year: int) -> Any:
    try:
        from pygeomag import GeoMag
    except ImportError:
        raise FieldUnknown(
            "the declination comes from the World Magnetic Model, and pygeomag, which has it, is not installed: "
            "pip install pygeomag, or set mag.declination_deg"
        ) from None
    return GeoMag(base_year=year)
