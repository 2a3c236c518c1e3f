"""Bags opened by the library: one file or several of one recording, ROS 1 or 2."""

from collections import Counter
from collections.abc import Collection, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

from rosbags.highlevel import AnyReader
from rosbags.interfaces import Connection
from rosbags.typesys import Stores, get_typestore

from magfusion.errors import InputError
from magfusion.files.bag_recovery import Recovered, recovered
from magfusion.files.bag_topics import UNFINISHED, bag_files, files_in

# Of the files of one recording: what a recorder buffers, and of short ones a part.
MAX_OVERLAP_NS, MAX_OVERLAP = 1_000_000_000, 0.5
# Messages of an overlap, times those of one recording at most, and their least number: of two
# recordings at the same time there are twice as many.
MAX_DENSITY, MIN_SHARED = 1.5, 10.0


def place_of(paths: Sequence[Path]) -> str:
    """Return what a refusal calls bags."""
    return ", ".join(map(str, paths))


def is_ros1(path: Path) -> bool:
    """Return whether a bag is of ROS 1."""
    return all(map(_is_ros1_file, bag_files(path)))


def _is_ros1_file(file: Path) -> bool:
    return file.name.endswith((".bag", UNFINISHED))


class BagReader(AnyReader):
    """The library's reader, which of unfinished files reads one topic after the other.

    Without an index the library refuses messages that are not in the order of their arrival, which
    those of several topics are not.
    """

    # files that the recorder did not finish, by the place of their reader
    unfinished: Mapping[int, Path] = {}
    # topics of which the messages that were read are fewer than the index counts: the library
    # passes over what it cannot read in a chunk; and databases of which some rows cannot be read
    damage: Sequence[str] = ()

    @property
    def notes(self) -> list[str]:
        """How much of files was read that the recorder did not finish."""
        return [
            f"{path}: the recorder did not finish the file."
            f" {self.readers[k].message_count} messages in {self.readers[k].duration * 1e-9:.4g} s"
            " are whole and are read; what follows them is lost."
            for k, path in self.unfinished.items()
        ]

    def messages(
        self,
        connections: Collection[Connection] = (),
        start: int | None = None,
        stop: int | None = None,
    ) -> Generator[tuple[Connection, int, bytes], None, None]:
        """Yield messages as `AnyReader` does, and compare their number with that of the index."""
        chosen = list(connections or self.connections)
        read: Counter[str] = Counter()
        for together in [[one] for one in chosen] if self.unfinished else [chosen]:
            for message in super().messages(together, start, stop):
                read[message[0].topic] += 1
                yield message
        if start is None and stop is None:
            expected: Counter[str] = Counter()
            for one in chosen:
                expected[one.topic] += one.msgcount
            place = ", ".join(str(reader.path) for reader in self.readers)
            missing = [
                f"{place}: the file is damaged. {read[topic]} of {count} messages of {topic} are"
                " read; the others are lost. Copy the file again."
                for topic, count in expected.items()
                if read[topic] < count
            ]
            self.damage = list(dict.fromkeys([*self.damage, *missing]))


@contextmanager
def open_bag(paths: Sequence[Path]) -> Iterator[BagReader]:
    """Open bags as one recording.

    `paths`: directories of bags, or their files. Raises InputError where a bag cannot be read, also
    while its messages are read.
    """
    files = [file for path in paths for file in bag_files(path)]
    if len(set(map(_is_ros1_file, files))) > 1:
        names = ", ".join(file.name for file in files)
        raise InputError(
            f"{place_of(paths)}: holds bags of ROS 1 and of ROS 2 ({names}); give the path of one."
        )
    try:
        readable = [file for path in paths for file in _readable(path)]
        copies = [copy.path for _, copy in readable]
        with BagReader(copies, default_typestore=get_typestore(Stores.LATEST)) as reader:
            cut = {k: path for k, (path, copy) in enumerate(readable) if not copy.whole}
            reader.unfinished = {k: path for k, path in cut.items() if path.suffix != ".db3"}
            reader.damage = [
                f"{path}: the file is damaged. {reader.readers[k].message_count} messages in"
                f" {reader.readers[k].duration * 1e-9:.4g} s are read; the others are lost. Copy"
                " the file again."
                for k, path in cut.items()
                if path.suffix == ".db3"
            ]
            yield reader
    except InputError:
        raise
    except Exception as error:  # a damaged bag makes the library fail in any way whatever
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(
            f"{place_of(paths)}: cannot be read ({reason}); record the bag again."
        ) from error


def _readable(path: Path) -> list[tuple[Path, Recovered]]:
    """Return what the library can read of a bag, with the files it is of."""
    files = files_in(path) if path.is_dir() else [path]
    copies = {file: recovered(file) for file in files}
    if not any(copies.values()):  # else the metadata are of what the files were to be
        copies = dict.fromkeys(bag_files(path))
    return [(file, copy or Recovered(file, True, None)) for file, copy in copies.items()]


def refuse_overlap(reader: AnyReader, topic: str) -> None:
    """Refuse files that hold a topic at the same time: they are no parts of one recording.

    Short overlaps are those of a recorder's buffers, or of messages that both files have.
    """
    files = sorted(
        (
            (one, own)
            for one in reader.readers
            if (own := [c for c in one.connections if c.topic == topic and c.msgcount])
        ),
        key=lambda file: (file[0].start_time, file[0].end_time),
    )
    for (first, of_first), (second, of_second) in pairwise(files):
        begin, end = second.start_time, min(first.end_time, second.end_time)
        shorter = min(one.end_time - one.start_time for one in (first, second))
        if end <= begin:
            continue
        earlier, later = (
            {raw for *_, raw in one.messages(own, begin, end)}
            for one, own in ((first, of_first), (second, of_second))
        )
        usual = sum(c.msgcount for c in of_first) / (first.end_time - first.start_time)
        twofold = len(earlier | later) > MAX_DENSITY * max(MIN_SHARED, usual * (end - begin))
        if end - begin > min(MAX_OVERLAP_NS, MAX_OVERLAP * shorter) or twofold:
            raise InputError(
                f"{first.path} and {second.path} both hold {topic} at the same time, from"
                f" {begin} to {end} ns; give the path of one."
            )
