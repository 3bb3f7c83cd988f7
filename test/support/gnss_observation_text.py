"""Ranges as the text of a RINEX 3 observation file: what the libraries that serve as oracles read."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from eskf_ros.gnss.signals import LETTERS, SIGNALS
from eskf_ros.gnss.time import date_of

LETTER = {int(gnss): letter for letter, gnss in LETTERS.items()}


def observation_text(epochs: Sequence[tuple[int, float, NDArray[np.void]]], approximate: Sequence[float]) -> str:
    """Return the file of epochs (week, seconds, RANGE): code, Doppler and C/N0 of every signal that occurs in them."""
    ranges = np.concatenate([found for _, _, found in epochs])
    codes: dict[str, list[str]] = {}
    for signal in np.unique(ranges["signal"]).tolist():
        codes.setdefault(LETTER[int(SIGNALS[signal].gnss)], []).append(SIGNALS[signal].code)
    header = [
        f"{'     3.04           OBSERVATION DATA    M':60}RINEX VERSION / TYPE",
        f"{''.join(f'{value:14.4f}' for value in approximate):60}APPROX POSITION XYZ",
    ]
    for letter, names in codes.items():
        types = "".join(f" {kind}{name}" for name in names for kind in "CDS")
        header.append(f"{f'{letter}  {3 * len(names):3d}{types}':60}SYS / # / OBS TYPES")
    first = date_of(epochs[0][0], epochs[0][1])
    header.append(f"{f'  {first.year}    {first.month:2d}    {first.day:2d}':48}{'GPS':12}TIME OF FIRST OBS")
    lines = [*header, f"{'':60}END OF HEADER"]
    for week, seconds, found in epochs:
        satellites: dict[tuple[int, int], dict[str, NDArray[np.void]]] = {}
        for row in found:
            key = int(row["gnss_id"]), int(row["sv_id"])
            satellites.setdefault(key, {})[SIGNALS[row["signal"]].code] = row
        date = date_of(week, seconds)
        minute, second = divmod(round(seconds % 86400.0, 7), 60.0)
        clock = f"{int(minute) // 60:02d} {int(minute) % 60:02d}{second:11.7f}"
        lines.append(f"> {date.year} {date.month:02d} {date.day:02d} {clock}  0{len(satellites):3d}")
        for (gnss_id, sv_id), signals in satellites.items():
            cells = ""
            for name in codes[LETTER[gnss_id]]:
                row = signals.get(name)
                values = (math.nan,) * 3 if row is None else (row["pseudorange"], row["doppler"], row["cn0"])
                cells += "".join(" " * 16 if math.isnan(value) else f"{value:14.3f}  " for value in values)
            lines.append(f"{LETTER[gnss_id]}{sv_id:02d}{cells}".rstrip())
    return "\n".join(lines) + "\n"
