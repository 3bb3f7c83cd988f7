"""A recording as tables for `eskf_ros.run`: the content of its topics as columns."""

from __future__ import annotations

from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eskf_ros.bags import open_bag
from eskf_ros.filter.measurements.row import Row
from eskf_ros.filter.rows import ROWS
from eskf_ros.parameters.tree import Parameters
from eskf_ros.replay.topics import IMU, find_topics

Table = dict[str, NDArray[Any]]

READ = {row.stream: row for row in ROWS}
"""Rows of the measurements by stream."""


def read_bag(path: str | PathLike[str], parameters: Parameters | None = None) -> dict[str, Table]:
    """Return the inputs of a recording as tables, by the names that `eskf_ros.run` takes.

    ``path``: a rosbag2 folder, an .mcap or a .db3 file. ``parameters``: name the topics to read (default: the default
    parameters); a missing topic is left out. Ranges of satellites are not read: use ``eskf_replay`` for them.

    Raises:
        BagError: the recording cannot be read.
        InputError: the IMU or the fixes are missing.
    """
    bag = Path(path)
    with open_bag([bag]) as reader:
        topics, _ = find_topics(reader, bag, parameters or Parameters(), "")
        wanted = {topic: kind for kind, topic in topics.inputs.items() if kind.name not in ("ranges", "ephemerides")}
        found: dict[str, list[Any]] = {topic: [] for topic in (topics.imu, *wanted)}
        types = {topics.imu: IMU, **{topic: kind.type for topic, kind in wanted.items()}}
        for batch in reader.batches(types):
            for topic, messages in batch.items():
                found[topic].append(messages.messages)
    samples = np.concatenate(found[topics.imu])
    tables = {
        "imu": {
            "stamp": samples["stamp"],
            "specific_force": samples["linear_acceleration"],
            "angular_rate": samples["angular_velocity"],
        }
    }
    for topic, kind in wanted.items():
        if found[topic]:
            row = READ[kind.stream]
            tables[row.name] = _table(row, np.concatenate(found[topic]))
    return tables


def _table(row: Row, messages: NDArray[Any]) -> Table:
    """Return the columns of one kind of measurement."""
    if row.name == "gnss_position":
        unknown = messages["position_covariance_type"] == 0
        covariance = np.where(unknown[:, None], 0.0, messages["position_covariance"])
        return {
            "stamp": messages["stamp"],
            "latitude_deg": messages["latitude"],
            "longitude_deg": messages["longitude"],
            "altitude": messages["altitude"],
            "covariance": covariance,
            "status": messages["status"],
        }
    assert row.read is not None
    values, covariances = row.read(messages)
    if row.is_vector:
        return {"stamp": messages["stamp"], row.columns[0]: values, "covariance": covariances}
    size = len(row.columns)
    table = {"stamp": messages["stamp"], "covariance": covariances.reshape(-1, 3, 3)[:, :size, :size]}
    return table | {column: values[:, place] for place, column in enumerate(row.columns)}
