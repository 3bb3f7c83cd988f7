"""Fast typed reading and writing of rosbag2 recordings. Never imported by the node."""

from __future__ import annotations

from eskf_ros.bags.clouds import POINT_CLOUD, cloud_messages
from eskf_ros.bags.errors import BagError
from eskf_ros.bags.messages import MESSAGE_TYPES, StringTable, decode, encode, message_dtype
from eskf_ros.bags.reader import BagReader, Batch, TopicInfo, open_bag
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
