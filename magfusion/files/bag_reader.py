"""Bags opened by the library: one file or several of one recording, ROS 1 or 2."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from magfusion.errors import InputError
from magfusion.files.bag_topics import bag_files

# Of the files of one recording: what a recorder buffers, and of short ones a part.
MOST_OVERLAP_NS, MOST_OVERLAP = 1_000_000_000, 0.5


def place_of(paths: Sequence[Path]) -> str:
    """Return what a refusal calls bags."""
    return ", ".join(map(str, paths))


def is_ros1(path: Path) -> bool:
    """Return whether a bag is of ROS 1."""
    return all(file.suffix == ".bag" for file in bag_files(path))


@contextmanager
def open_bag(paths: Sequence[Path]) -> Iterator[AnyReader]:
    """Open bags as one recording.

    Parameters
    ----------
    paths : sequence of Path
        Directories of bags, or their files.

    Raises
    ------
    InputError
        Where a bag cannot be read, also while its messages are read.
    """
    files = [file for path in paths for file in bag_files(path)]
    if len({file.suffix == ".bag" for file in files}) > 1:
        names = ", ".join(file.name for file in files)
        raise InputError(
            f"{place_of(paths)}: holds bags of ROS 1 and of ROS 2 ({names}); give the path of one."
        )
    try:
        with AnyReader(files, default_typestore=get_typestore(Stores.LATEST)) as reader:
            yield reader
    except InputError:
        raise
    except Exception as error:  # a damaged bag makes the library fail in any way whatever
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(
            f"{place_of(paths)}: cannot be read ({reason}); record the bag again."
        ) from error


def refuse_overlap(reader: AnyReader, topic: str) -> None:
    """Refuse files that hold a topic at the same time: they are no parts of one recording.

    Raises
    ------
    InputError
    """
    spans = sorted(
        (one.start_time, one.end_time, str(one.path))
        for one in reader.readers
        if any(c.topic == topic and c.msgcount for c in one.connections)
    )
    for (start, end, first), (begin, last, second) in pairwise(spans):
        shorter = min(end - start, last - begin)
        if end - begin > min(MOST_OVERLAP_NS, MOST_OVERLAP * shorter):
            raise InputError(
                f"{first} and {second} both hold {topic} at the same time; give the path of one."
            )
