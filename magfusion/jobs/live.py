"""Live outputs of states, in addition to the files: the viewer, and robot middleware."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, TextIO

from magfusion.errors import InputError
from magfusion.files.standard_streams import write_message
from magfusion.jobs.settings import FrameSettings, option

if TYPE_CHECKING:
    from magfusion.estimation.online_integrity.judgement import JudgedState
    from magfusion.model.site import Site
    from magfusion.results.recording_live import LiveView


class StateSink(Protocol):
    """Receives states one by one, and never blocks the estimator."""

    def take(self, state: JudgedState | None, reported: Mapping[str, Any], /) -> None:
        """Receive a state, None before the first, with its representation in the pipe."""

    def close(self) -> str | None:
        """Close; return an error as a sentence without its full stop."""


@dataclass(frozen=True, kw_only=True)
class LiveSettings(FrameSettings):
    """Live outputs of the states."""

    live: bool = option(False, "Show the states in the viewer")
    mavlink: str | None = option(
        None,
        "Send the states as MAVLink ODOMETRY, by UDP",
        metavar="udpout:HOST:PORT",
        note="magfusion[mavlink]",
    )
    foxglove: str | None = option(
        None,
        "Serve the states to Foxglove, by WebSocket",
        metavar="[HOST:]PORT",
        note="magfusion[foxglove]",
    )
    ros2: str | None = option(
        None,
        "Publish the states as nav_msgs/Odometry of ROS 2, by DDS",
        metavar="TOPIC",
        note="magfusion[ros2]",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        named = (self.frame, self.child) != (FrameSettings.frame, FrameSettings.child)
        if named and self.foxglove is None and self.ros2 is None:
            raise InputError("--frame and --child require --foxglove or --ros2; give one of them")


@contextmanager
def state_sinks(
    settings: LiveSettings, site: Site, epoch_ns: int, messages: TextIO
) -> Iterator[tuple[StateSink, ...]]:
    """Yield the outputs of the states, and report their errors at the end.

    `epoch_ns`: zero of the states' time (ns since 1970). Raises InputError where one cannot be
    opened.
    """
    sinks: list[StateSink] = []
    try:
        for sink in _opened(settings, site, epoch_ns):
            sinks.append(sink)  # one by one: those before one that fails are to be closed
        yield tuple(sinks)
    finally:
        for sink in sinks:
            wrong = sink.close()
            if wrong is not None:
                write_message(messages, wrong)


def _opened(settings: LiveSettings, site: Site, epoch_ns: int) -> Iterator[StateSink]:
    if settings.mavlink is not None:
        from magfusion.results.odometry_mavlink import MavlinkSender

        yield MavlinkSender(settings.mavlink, epoch_ns)
    if settings.foxglove is not None:
        from magfusion.results.live_foxglove import FoxgloveServer

        yield FoxgloveServer(settings.foxglove, epoch_ns, settings.frame, settings.child)
    if settings.ros2 is not None:
        from magfusion.results.odometry_dds import RosPublisher

        yield RosPublisher(settings.ros2, epoch_ns, settings.frame, settings.child)
    if settings.live:
        from magfusion.results.recording_live import open_live_view

        yield _Viewer(open_live_view(site))


class _Viewer(NamedTuple):
    view: LiveView

    def take(self, state: JudgedState | None, reported: Mapping[str, Any]) -> None:
        if state is not None and not state.is_lost:
            self.view.show(state, reported["distortion"])

    def close(self) -> None:
        """Leave the viewer open."""
