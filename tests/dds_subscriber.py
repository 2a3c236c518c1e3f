"""Receive one message of a topic, knowing only its name: ``dds_subscriber.py DOMAIN TOPIC``.

Its type is asked of whoever publishes it, and one line of JSON is printed.
"""

import dataclasses
import json
import sys
import time
from typing import Any

from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
from cyclonedds.domain import DomainParticipant
from cyclonedds.dynamic import get_types_for_typeid
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

MAX_WAIT = 60.0  # s


def plain(value: Any) -> Any:
    """Return what a message holds as mappings, lists and numbers."""
    if hasattr(value, "__idl__"):
        return {f.name: plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    return list(value) if isinstance(value, list | tuple) else value


def main(domain: int, name: str) -> None:
    """Print the first message of the topic, or nothing."""
    participant, end = DomainParticipant(domain), time.monotonic() + MAX_WAIT
    publications = BuiltinDataReader(participant, BuiltinTopicDcpsPublication)
    reader = None
    while time.monotonic() < end:
        for result in publications.take(10):
            if reader is None and result.topic_name == name:
                datatype, _ = get_types_for_typeid(
                    participant, result.type_id, duration(seconds=10)
                )
                reader = DataReader(participant, Topic(participant, name, datatype, qos=result.qos))
                kind = result.type_name
        for message in reader.take(1) if reader is not None else ():
            sys.stdout.write(json.dumps({"type": kind, "message": plain(message)}) + "\n")
            return
        time.sleep(0.01)


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2])
