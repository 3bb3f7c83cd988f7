"""Standard deviations of pseudorange and Doppler by elevation and C/N0, where the receiver gives none.

    code^2    = (zenith / sin el)^2 + (ionosphere_share I)^2 + (noise 10^((40 - C/N0) / 20))^2
    Doppler^2 = floor^2 + (noise 10^((40 - C/N0) / 15))^2

The defaults are fitted to residuals at known positions: a consumer receiver carried by a walker, one on a car in deep
urban streets, a geodetic receiver at rest (the last is two to ten times better than they say). The form is that of
RTKLIB with a term by C/N0 (Groves, section 9.4.2).
"""

from __future__ import annotations

import math
from typing import NamedTuple

from eskf_ros.compiled import njit
from eskf_ros.gnss.signals import Gnss, is_beidou_geostationary

LOWEST_SINE = math.sin(math.radians(5.0))


class Weighting(NamedTuple):
    """Parameters of the error model, in the form that a kernel takes.

    ``code_zenith``, ``code_noise``: m. ``ionosphere_share``: standard deviation as a share of the modelled delay.
    ``doppler_floor``, ``doppler_noise``: m/s. ``weak_factor``: factor on the standard deviation of code for GLONASS
    (its channels have different delays) and geostationary BeiDou (their orbits are less accurate). ``unknown_cn0``:
    stand-in for an unknown C/N0, dB-Hz.
    """

    code_zenith: float = 0.8
    code_noise: float = 1.5
    ionosphere_share: float = 0.5
    doppler_floor: float = 0.04
    doppler_noise: float = 0.065
    weak_factor: float = 1.5
    unknown_cn0: float = 35.0


DEFAULT_WEIGHTING = Weighting()


@njit
def code_std(weighting, gnss_id, sv_id, elevation, cn0, ionosphere, noise_factor):
    """Return the standard deviation (m) of a pseudorange.

    ``elevation`` rad, ``cn0`` dB-Hz (NaN unknown), ``ionosphere``: delay that was corrected by a model, m;
    ``noise_factor`` of a combination of ranges.
    """
    if math.isnan(cn0):
        cn0 = weighting.unknown_cn0
    zenith = weighting.code_zenith / max(LOWEST_SINE, math.sin(elevation))
    noise = weighting.code_noise * 10.0 ** ((40.0 - cn0) / 20.0)
    std = math.sqrt((zenith**2 + noise**2) * noise_factor**2 + (weighting.ionosphere_share * ionosphere) ** 2)
    if gnss_id == Gnss.GLONASS or is_beidou_geostationary(gnss_id, sv_id):
        return weighting.weak_factor * std
    return std


@njit
def doppler_std(weighting, cn0):
    """Return the standard deviation (m/s) of a range rate from Doppler; ``cn0`` in dB-Hz (NaN unknown)."""
    if math.isnan(cn0):
        cn0 = weighting.unknown_cn0
    noise = weighting.doppler_noise * 10.0 ** ((40.0 - cn0) / 15.0)
    return math.sqrt(weighting.doppler_floor**2 + noise**2)
