"""Domain of DDS in which nodes of ROS 2 are; no ROS is installed here."""

from __future__ import annotations

import os
import re
from typing import TYPE_CHECKING

from magfusion.errors import InputError

if TYPE_CHECKING:
    from cyclonedds.domain import DomainParticipant

_TOPIC = re.compile(r"(/[A-Za-z_]\w*)+", re.ASCII)
_LAST_DOMAIN = 232  # its ports are the last ones that there are


def join_domain(option: str) -> DomainParticipant:
    """Join the domain ``ROS_DOMAIN_ID``.

    `option`: that requires it, for errors. Raises InputError where the domain is invalid,
    cyclonedds is not installed, or DDS does not start.
    """
    text = os.environ.get("ROS_DOMAIN_ID", "") or "0"
    if not text.isdecimal() or int(text) > _LAST_DOMAIN:
        raise InputError(f"ROS_DOMAIN_ID: found {text!r}; it should be from 0 to {_LAST_DOMAIN}")
    try:
        from cyclonedds.core import DDSException
        from cyclonedds.domain import DomainParticipant
    except ImportError as error:
        raise InputError(
            f"{option}: cyclonedds is not installed; pip install 'magfusion[ros2]'"
        ) from error
    try:
        return DomainParticipant(int(text))
    except DDSException as error:
        raise InputError(
            f"{option}: DDS does not start in domain {text} ({error}); check the network,"
            " ROS_DOMAIN_ID and CYCLONEDDS_URI"
        ) from error


def dds_name(option: str, topic: str) -> str:
    """Return the name by which DDS knows a topic of ROS.

    Raises InputError where it is none.
    """
    if not _TOPIC.fullmatch(topic):
        raise InputError(f"{option} {topic!r}: is not a topic; write one like /robot/odometry")
    return f"rt{topic}"
