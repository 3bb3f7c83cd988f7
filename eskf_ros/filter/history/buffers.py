"""Buffers of the history: their size follows the window and the rates of the messages, not the running time."""

from __future__ import annotations

import numpy as np

from eskf_ros.filter.history.records import AID, IMU, TIMELINE
from eskf_ros.filter.history.timeline import CHECKPOINT_SPACING, doubled, forget
from eskf_ros.filter.state.lanes import LANES
from eskf_ros.filter.state.memory import allocate
from eskf_ros.filter.state.time import NEVER

IMU_BATCH = 1024
"""IMU samples that are inserted at once, at most."""

FIRST_SIZE = 256
"""Initial capacity for measurements, and for checkpoints."""


class Buffers:
    """IMU samples, offered measurements, checkpoints of the state and published rows, each in one growing array."""

    def __init__(self, state: np.dtype, row: np.dtype) -> None:
        """Allocate the buffers; ``state``, ``row``: record types of a checkpoint and of an output row."""
        self.imu = allocate(IMU, 4 * IMU_BATCH)
        self.aids = allocate(AID, FIRST_SIZE)
        self.checkpoints = allocate(state, (FIRST_SIZE, LANES))
        self.rows = allocate(row, len(self.imu))
        self.timeline = allocate(TIMELINE)

    def restart(self, window: int) -> None:
        """Forget everything; late messages are accepted within ``window`` (ns)."""
        self.timeline = allocate(TIMELINE)
        for field in ("frontier", "published", "barrier"):
            self.timeline[field] = NEVER
        self.timeline["rewind_to"] = self.timeline["rewind_sample"] = -NEVER
        self.timeline["window"] = window

    @property
    def held_bytes(self) -> int:
        """Memory of the buffers (bytes)."""
        return sum(buffer.nbytes for buffer in (self.imu, self.aids, self.checkpoints, self.rows))

    def _wanted(self, aids: int, constraints: int) -> tuple[int, int, int]:
        """Return the IMU samples, measurements and checkpoints after one more batch and ``aids`` more measurements.

        An interval between two samples contains at most one grid point of the constraints.
        """
        timeline = self.timeline
        return (
            timeline["imu_count"][0] + IMU_BATCH,
            timeline["aid_count"][0] + 1 + aids + IMU_BATCH * constraints,
            timeline["checkpoint_count"][0] + IMU_BATCH // CHECKPOINT_SPACING + 2,
        )

    def have_room(self, aids: int, constraints: int) -> bool:
        """Say whether one batch of IMU samples and ``aids`` measurements fit in; ``constraints``: per grid point."""
        imu, offered, checkpoints = self._wanted(aids, constraints)
        return len(self.imu) >= imu and len(self.aids) >= offered and len(self.checkpoints) >= checkpoints

    def forget(self, states: np.ndarray) -> None:
        """Drop what no accepted message can change any more; ``states``: the present state."""
        forget(states, self.imu, self.aids, self.checkpoints, self.timeline)

    def grow(self, aids: int, constraints: int) -> None:
        """Grow the buffers to twice the needed size or more (see `have_room`)."""
        imu, offered, checkpoints = self._wanted(aids, constraints)
        while len(self.imu) < 2 * imu:
            self.imu = doubled(self.imu)
            self.rows = doubled(self.rows)
        while len(self.aids) < 2 * offered:
            self.aids = doubled(self.aids)
        while len(self.checkpoints) < 2 * checkpoints:
            self.checkpoints = doubled(self.checkpoints)
