"""Output of a recording to a file, complete or not at all."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import rerun as rr

from magfusion.files.atomic import whole_file


@contextmanager
def whole_recording(path: Path, name: str) -> Iterator[rr.RecordingStream]:
    """Yield a recording that is written to ``path`` if nothing fails.

    It is kept in memory until then: rerun's own file sink only logs a full disk. `name`: shown in
    the viewer.
    """
    recording = rr.RecordingStream("magfusion")
    memory = recording.memory_recording()
    try:
        recording.send_recording_name(name)
        yield recording
        with whole_file(path) as unfinished:
            unfinished.write_bytes(memory.drain_as_bytes())
    finally:
        recording.disconnect()
