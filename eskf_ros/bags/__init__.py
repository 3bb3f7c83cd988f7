"""Fast typed reading and writing of rosbag2 recordings.

The modules imported here decode serialised messages, which the node needs, too. The reader and the writer of files are
imported on first use: they need libraries that a robot does not have.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from eskf_ros.bags.clouds import POINT_CLOUD, cloud_messages
from eskf_ros.bags.errors import BagError
from eskf_ros.bags.messages import MESSAGE_TYPES, StringTable, decode, encode, message_dtype
from eskf_ros.bags.records import Batch, TopicInfo

if TYPE_CHECKING:
    from eskf_ros.bags.reader import BagReader, open_bag
    from eskf_ros.bags.writer import BagWriter

__all__ = [
    "MESSAGE_TYPES",
    "POINT_CLOUD",
    "BagError",
    "BagReader",
    "BagWriter",
    "Batch",
    "StringTable",
    "TopicInfo",
    "cloud_messages",
    "decode",
    "encode",
    "message_dtype",
    "open_bag",
]

_WHEN_ASKED_FOR = {"BagReader": "reader", "open_bag": "reader", "BagWriter": "writer"}


def __getattr__(name: str) -> Any:
    if name not in _WHEN_ASKED_FOR:
        raise AttributeError(f"module {__name__} has no attribute {name}")
    return getattr(importlib.import_module(f"{__name__}.{_WHEN_ASKED_FOR[name]}"), name)
