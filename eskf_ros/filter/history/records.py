"""Records of the history: IMU samples, offered measurements, their verdicts, fill levels of the buffers."""

from __future__ import annotations

import numpy as np

IMU = np.dtype([("stamp", "i8"), ("specific_force", "f8", (3,)), ("angular_rate", "f8", (3,))], align=True)

PAYLOAD_SIZE = 25

XX, XY, XZ, YY, YZ, ZZ = 3, 4, 5, 6, 7, 8
"""Places of the upper triangle of the covariance in the payload, behind the three values."""

AID = np.dtype(
    [
        ("stamp", "i8"),
        ("arrival", "i8"),
        ("stream", "i4"),
        ("source", "i4"),
        ("door", "i4"),
        ("verdict", "i4"),
        ("dof", "i4"),
        ("told", "i4"),
        ("nis", "f8"),
        ("innovation", "f8", (3,)),
        ("payload", "f8", (PAYLOAD_SIZE,)),
    ],
    align=True,
)
"""One offered measurement: what was sent, what became of it, and whether `take_live` has reported it (``told``).

``stream``, ``source``: what it measures, and which of several receivers sent it. ``door``: the verdict of the
admission; ``verdict``: that of the fusion. ``dof``: number of scalars. ``payload``: three values, the upper triangle of
their covariance by rows, and further fields that the file of the measurement describes.
"""

RECORD = np.dtype(
    [
        ("stamp", "i8"),
        ("arrival", "i8"),
        ("stream", "i4"),
        ("source", "i4"),
        ("verdict", "i4"),
        ("dof", "i4"),
        ("nis", "f8"),
        ("innovation", "f8", (3,)),
    ]
)
"""The final record of one offered measurement; fields as in AID."""

TIMELINE = np.dtype(
    [
        ("imu_count", "i8"),
        ("aid_count", "i8"),
        ("checkpoint_count", "i8"),
        ("since_checkpoint", "i8"),
        ("recorded", "i8"),
        ("frontier", "i8"),
        ("published", "i8"),
        ("rewind_to", "i8"),
        ("rewind_sample", "i8"),
        ("window", "i8"),
        ("barrier", "i8"),
        ("furthest_late", "i8"),
        ("imu_offered", "i8"),
        ("imu_duplicate", "i8"),
        ("imu_late", "i8"),
        ("imu_bad_value", "i8"),
        ("imu_bad_stamp", "i8"),
        ("elsewhere_count", "i8"),
        ("elsewhere_stamp", "i8"),
    ],
    align=True,
)
"""Fill levels of the history buffers, stamps (ns) that divide the timeline, and counters.

- ``imu_count``, ``aid_count``, ``checkpoint_count``: fill levels; ``since_checkpoint``: IMU samples since the last
  checkpoint.
- ``recorded``: measurements at the head of the buffer whose final record was handed out.
- ``frontier``: the newest IMU stamp; ``published``: the newest stamp for which a row was written.
- ``rewind_to``, ``rewind_sample``: the time of the state, and the stamp of its last IMU sample, from which the next
  advance has to start at the latest. The two differ where the stamps of the IMU jitter (`inertial/stamps.py`).
- ``window``, ``barrier``: messages older than the frontier minus the window, or than the barrier, are refused.
- ``furthest_late``: the largest lateness (ns) refused.
- ``imu_*``: IMU samples offered, and refused or replaced by reason.
- ``elsewhere_count``, ``elsewhere_stamp``: refused samples in a row that follow each other far from the frontier, and
  the stamp of the last.
"""
