"""States as MAVLink ODOMETRY over UDP, as external input of PX4 and ArduPilot."""

import socket
from collections.abc import Mapping
from typing import Any

import numpy as np

from magfusion.errors import InputError
from magfusion.estimation.online_integrity.judgement import JudgedState
from magfusion.model.trust import Verdict
from magfusion.results.odometry import Odometry, odometry_of

# System id of the vehicle, 1 by default.
SYSTEM = 1
HEARTBEAT = 1.0  # s
# Forward, right, down of forward, left, up.
_FRD = np.array([1.0, -1.0, -1.0])
_FRD_COV = np.outer(_FRD, _FRD)
_UPPER = np.triu_indices(6)
_ADDRESS = "udpout:HOST:PORT"


def quality_percent(state: JudgedState) -> int:
    """Return the quality of a state, from 1 to 100 as in MAVLink; 0 is unknown.

    For a threshold at the receiver: ``100 / (1 + protection level in metres)``, half of that where
    the state is doubtful.  A threshold of 50 requires a trustworthy state protected to a metre.
    """
    level = state.judgement.protection_level_m
    if level is None:
        return 0
    share = 1.0 if state.verdict is Verdict.TRUSTWORTHY else 0.5
    return max(1, int(share * 100.0 / (1.0 + level)))


def odometry_message(odometry: Odometry, quality: int, discontinuities: int) -> Any:
    """Return a message ODOMETRY, from MAV_FRAME_BODY_FRD to MAV_FRAME_LOCAL_FRD.

    Both frames are ours rotated by half a turn about x.  The local one has an arbitrary heading, as
    our world: it is not north.  Angular rates, which no state has, are NaN. `discontinuities`:
    number of jumps of the estimate.
    """
    from pymavlink.dialects.v20 import common

    velocity_cov = np.full((6, 6), np.nan)
    velocity_cov[:3, :3] = _FRD_COV * odometry.velocity_cov_body
    w, x, y, z = odometry.quaternion.tolist()
    return common.MAVLink_odometry_message(
        odometry.stamp_ns // 1000,
        common.MAV_FRAME_LOCAL_FRD,
        common.MAV_FRAME_BODY_FRD,
        *(_FRD * odometry.position_world).tolist(),
        [w, x, -y, -z],
        *(_FRD * odometry.velocity_body).tolist(),
        *(3 * [float("nan")]),
        (np.tile(_FRD_COV, (2, 2)) * odometry.pose_cov)[_UPPER].tolist(),
        velocity_cov[_UPPER].tolist(),
        reset_counter=discontinuities % 256,
        # There is no type for magnetic beacons, and PX4 rejects all but vision.
        estimator_type=common.MAV_ESTIMATOR_TYPE_VIO,
        quality=quality,
    )


class MavlinkSender:
    """Sends a heartbeat and the odometry of every state that is not lost.

    It never blocks, and ignores missing receivers. `address`: ``udpout:HOST:PORT``. `epoch_ns`:
    zero of the states' time (ns since 1970). Raises InputError where the address is invalid, or
    pymavlink is not installed.
    """

    def __init__(self, address: str, epoch_ns: int) -> None:
        try:
            from pymavlink.dialects.v20 import common
        except ImportError as error:
            raise InputError(
                "--mavlink: pymavlink is not installed; pip install 'magfusion[mavlink]'"
            ) from error
        family, self._to = _resolved(address)
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._mav = common.MAVLink(
            self, SYSTEM, common.MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY, use_native=False
        )
        self._common, self._epoch_ns, self._beat = common, epoch_ns, -np.inf
        self._unsent, self._why = 0, ""

    def take(self, state: JudgedState | None, reported: Mapping[str, Any]) -> None:
        """Send the messages of a state; for a lost one only the heartbeat, without odometry."""
        result = state if state is not None and not state.is_lost else None
        time = float(reported["time"])
        if not self._beat <= time < self._beat + HEARTBEAT:
            self._mav.send(self._heartbeat(state))
            self._beat = time
        if result is not None:
            odometry = odometry_of(result, self._epoch_ns)
            quality = quality_percent(result)
            self._mav.send(odometry_message(odometry, quality, result.reset_counter))

    def write(self, message: bytes) -> None:
        """Send the bytes of a message, or count it as unsent."""
        try:
            self._socket.sendto(message, self._to)
        except OSError as error:
            self._unsent, self._why = self._unsent + 1, error.strerror or str(error)

    def close(self) -> str | None:
        """Close; return an error."""
        self._socket.close()
        if not self._unsent:
            return None
        return f"--mavlink: {self._unsent} messages could not be sent ({self._why})"

    def _heartbeat(self, state: JudgedState | None) -> Any:
        common = self._common
        status = common.MAV_STATE_CALIBRATING
        if state is not None:
            status = common.MAV_STATE_CRITICAL if state.is_lost else common.MAV_STATE_ACTIVE
        kind, pilot = common.MAV_TYPE_ONBOARD_CONTROLLER, common.MAV_AUTOPILOT_INVALID
        return common.MAVLink_heartbeat_message(kind, pilot, 0, 0, status, 3)


def _resolved(address: str) -> tuple[int, Any]:
    """Return family and socket address of ``udpout:HOST:PORT``."""
    kind, _, place = address.partition(":")
    host, _, port = place.rpartition(":")
    if kind != "udpout" or not host or not (port.isdecimal() and 0 < int(port) < 65536):
        raise InputError(
            f"--mavlink {address!r}: is not an address to send to; write {_ADDRESS}, e.g."
            " udpout:192.168.4.1:14540"
        )
    try:
        result = socket.getaddrinfo(host.strip("[]"), int(port), type=socket.SOCK_DGRAM)
    except (OSError, UnicodeError) as error:
        raise InputError(
            f"--mavlink {address!r}: the host {host} is unknown"
            f" ({getattr(error, 'strerror', None) or error}); give its IP address"
        ) from error
    family, _, _, _, to = result[0]
    return family, to
