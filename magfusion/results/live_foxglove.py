"""Live states for Foxglove: a WebSocket server for the app."""

import time
from collections.abc import Mapping
from typing import Any

from magfusion.errors import InputError
from magfusion.estimation.online_integrity.judgement import JudgedState
from magfusion.files.stream import json_line
from magfusion.results.odometry import odometry_of
from magfusion.units import NS_PER_S

HOST = "127.0.0.1"
LINGER = 0.5  # s
_STATE = {
    "title": "magfusion.State",
    "type": "object",
    "properties": {
        "time": {"type": "number"},
        "started": {"type": "boolean"},
        "lost": {"type": "boolean"},
        "verdict": {"type": ["string", "null"]},
        "protection_level_m": {"type": ["number", "null"]},
        "protection_level_deg": {"type": ["number", "null"]},
        "reset_counter": {"type": "integer"},
        "position": {"type": "array", "items": {"type": "number"}},
        "quaternion": {"type": "array", "items": {"type": "number"}},
        "velocity": {"type": "array", "items": {"type": "number"}},
        "distortion": {"type": "object", "additionalProperties": {"type": "number"}},
    },
}


class FoxgloveServer:
    """Serves ``/magfusion/state``, and ``/magfusion/pose`` and ``/tf`` of states not lost.

    Slow clients miss messages; the server never blocks. Raises InputError where it cannot listen at
    the address, or foxglove-sdk is not installed.

    Parameters
    ----------
    address : str
        ``[HOST:]PORT``; without a host only local clients are served.
    epoch_ns : int
        Zero of the states' time (ns since 1970).
    frame, child : str
        Names of the frames.
    """

    def __init__(self, address: str, epoch_ns: int, frame: str, child: str) -> None:
        try:
            import foxglove
            from foxglove import channels, messages
        except ImportError as error:
            raise InputError(
                "--foxglove: foxglove-sdk is not installed; pip install 'magfusion[foxglove]'"
            ) from error
        host, port = _host_and_port(address)
        context = self._context = foxglove.Context()  # kept, since it takes its channels along
        try:
            self._server = foxglove.start_server(
                name="magfusion", host=host, port=port, context=context
            )
        except RuntimeError as error:
            raise InputError(
                f"--foxglove {address!r}: it cannot listen there ({str(error).splitlines()[0]});"
                " give another port, or an address of this machine"
            ) from error
        self._state = foxglove.Channel("/magfusion/state", schema=_STATE, context=context)
        self._pose = channels.PoseInFrameChannel("/magfusion/pose", context=context)
        self._transform = channels.FrameTransformChannel("/tf", context=context)
        self._messages, self._epoch_ns = messages, epoch_ns
        self._frame, self._child = frame, child

    @property
    def port(self) -> int:
        """Address of the server."""
        return self._server.port

    def take(self, state: JudgedState | None, reported: Mapping[str, Any]) -> None:
        """Publish a state, and its pose if it has one."""
        stamp = max(0, self._epoch_ns + round(float(reported["time"]) * NS_PER_S))
        self._state.log(json_line(dict(reported)), log_time=stamp)
        if state is None or state.is_lost:
            return
        result, make = odometry_of(state, self._epoch_ns), self._messages
        x, y, z = result.position_world.tolist()
        place = make.Vector3(x=x, y=y, z=z)
        w, x, y, z = result.quaternion.tolist()
        turn, when = make.Quaternion(x=x, y=y, z=z, w=w), make.Timestamp(*divmod(stamp, NS_PER_S))
        pose = make.PoseInFrame(
            timestamp=when, frame_id=self._frame, pose=make.Pose(position=place, orientation=turn)
        )
        transform = make.FrameTransform(
            timestamp=when,
            parent_frame_id=self._frame,
            child_frame_id=self._child,
            translation=place,
            rotation=turn,
        )
        self._pose.log(pose, log_time=stamp)
        self._transform.log(transform, log_time=stamp)

    def close(self) -> None:
        """Close, after pending messages and a notice to connected clients."""
        if self._state.has_sinks():  # the server drops what it has not sent when it stops
            time.sleep(LINGER)
        self._server.stop()


def _host_and_port(address: str) -> tuple[str, int]:
    """Return host and port of ``[HOST:]PORT``."""
    host, _, port = address.rpartition(":")
    if not port.isdecimal() or int(port) > 65535 or address.startswith(":"):
        raise InputError(
            f"--foxglove {address!r}: is not an address to listen at; write a port, e.g. 8765, or"
            " HOST:PORT, e.g. 0.0.0.0:8765 for the whole network"
        )
    return host.strip("[]") or HOST, int(port)
