"""Records of the history: IMU samples, offered measurements, their verdicts, and how full the buffers are."""

from __future__ import annotations

import numpy as np

IMU = np.dtype([("stamp", "i8"), ("specific_force", "f8", (3,)), ("angular_rate", "f8", (3,))], align=True)

PAYLOAD_SIZE = 25

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
"""One offered measurement: what was sent, what became of it, and whether ``take_live`` has told that already.

``source``: which of several receivers it is from. ``payload``: three values, the upper triangle of their covariance by
rows, and what else the file of the aid says.
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
"""The final record of one offered measurement."""

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
"""Fill levels of the history buffers, the newest IMU stamp, how far back the next advance has to start; counters.

``recorded``: aids at the head of the buffer whose final record was handed out. ``published``: newest stamp for which
a row was written. ``barrier``: nothing older is accepted. ``furthest_late``: largest lateness (ns) refused.
``elsewhere_count``: refused samples in a row that follow each other far from the frontier; ``elsewhere_stamp``: the
last one's stamp.
"""
