"""Results of a filter as tables: DataFrames if pandas is installed, else structured arrays."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eskf_ros.filter.state.enums import IS_USABLE, STREAM_NAMES, Quality, Status, Verdict
from eskf_ros.geodesy.map_frame import MapFrame, to_geodetic
from eskf_ros.replay.summary import CHI_SQUARE_95, counted, named


def aid_summary(records: NDArray[Any]) -> dict[str, Any]:
    """Return counts and consistency of the records (n,) of one stream."""
    counts = np.bincount(records["verdict"], minlength=len(Verdict))
    tested = records[np.isfinite(records["nis"])]
    inside = tested["nis"] <= CHI_SQUARE_95[tested["dof"]]
    return {
        **counted(counts),
        "waiting": int(counts[Verdict.WAITING]),
        "nis_mean": float(tested["nis"].mean()) if len(tested) else None,
        "nis_in_95": float(inside.mean()) if len(tested) else None,
        "verdicts": named(counts),
    }


def trajectory_table(rows: NDArray[Any], datum: tuple[float, float, float] | None) -> Any:
    """Return the trajectory of ODOMETRY rows (n,) as a table; columns as in `eskf_ros.Result`."""
    known = rows["position_known"]
    geodetic = np.full((len(rows), 3), math.nan)
    if datum is not None and known.any():
        geodetic[known] = to_geodetic(MapFrame(datum).to_ecef(np.ascontiguousarray(rows["position_map"][known])))
    stds = np.sqrt(np.diagonal(rows["pose_covariance"], axis1=1, axis2=2))
    hidden = ~known[:, None]
    names = np.array([Status(value).name for value in range(max(Status) + 1)])
    return as_table(
        {
            "stamp": rows["stamp"],
            "status": names[rows["status"]],
            "usable": np.isin(rows["quality"], IS_USABLE),
            "quality": np.array([value.name for value in Quality])[rows["quality"]],
            "position_known": known,
            "heading_known": rows["heading_known"],
            "latitude_deg": np.degrees(geodetic[:, 0]),
            "longitude_deg": np.degrees(geodetic[:, 1]),
            "altitude": geodetic[:, 2],
            "position": np.where(hidden, math.nan, rows["position_map"]),
            "velocity": np.where(hidden, math.nan, rows["velocity_map"]),
            "attitude": rows["attitude_body_to_map"],
            "position_std": np.where(hidden, math.nan, stds[:, :3]),
            "rotation_std": stds[:, 3:],
        }
    )


def bias_table(rows: NDArray[Any]) -> Any:
    """Return the biases of ODOMETRY rows (n,) as a table; columns as in `eskf_ros.Result`."""
    names = ("stamp", "accel_bias", "gyro_bias", "accel_bias_std", "gyro_bias_std")
    return as_table({name: rows[name] for name in names})


def innovation_table(records: NDArray[Any]) -> Any:
    """Return the innovations of RECORD rows (n,) as a table; columns as in `eskf_ros.Result`."""
    return as_table(
        {
            "aid": np.array(STREAM_NAMES)[records["stream"]],
            "stamp": records["stamp"],
            "verdict": np.array([verdict.name.lower() for verdict in sorted(Verdict)])[records["verdict"]],
            "dof": records["dof"],
            "nis": records["nis"],
            "innovation": records["innovation"],
        }
    )


def as_table(columns: dict[str, NDArray[Any]]) -> Any:
    """Return a DataFrame with a column for each element of a vector; without pandas a structured array."""
    try:
        import pandas  # type: ignore[import-untyped,import-not-found,unused-ignore]
    except ImportError:
        kinds = [(name, values.dtype, values.shape[1:]) for name, values in columns.items()]
        table = np.zeros(len(next(iter(columns.values()))), np.dtype(kinds))
        for name, values in columns.items():
            table[name] = values
        return table
    flat: dict[str, NDArray[Any]] = {}
    for name, values in columns.items():
        if values.ndim == 1:
            flat[name] = values
        else:
            axes = "wxyz" if values.shape[1] == 4 else "xyz"
            flat |= {f"{name}_{axis}": values[:, place] for place, axis in enumerate(axes)}
    return pandas.DataFrame(flat)
