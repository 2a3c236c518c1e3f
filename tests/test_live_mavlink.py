"""Odometry by MAVLink, as parsers that are not ours read it from a socket."""

import json
import math
import socket
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Refuse, run_command
from live_states import (
    DOUBTFUL,
    EPOCH_NS,
    MAX_FINAL_STEP_SIGMAS,
    example_state,
    piped,
    release_gain,
    write_walk,
)
from scipy.spatial.transform import Rotation

from magfusion.estimation.graph.state import moved_to
from magfusion.estimation.online_integrity.judgement import Judgement
from magfusion.estimation.online_integrity.levels import Levels
from magfusion.jobs.live import LiveSettings
from magfusion.results.odometry import odometry_of
from magfusion.results.odometry_mavlink import MavlinkSender, odometry_message, quality_percent

mavlink = pytest.importorskip("pymavlink.dialects.v20.common")


class Receiver:
    """A port at which datagrams wait until they are read."""

    def __init__(self) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.address = f"udpout:127.0.0.1:{self.socket.getsockname()[1]}"

    def datagrams(self) -> list[bytes]:
        """Return what has come: on this machine it is there once it was sent."""
        self.socket.setblocking(False)
        result = []
        while True:
            try:
                result.append(self.socket.recv(65536))
            except BlockingIOError:
                return result


@pytest.fixture
def receiver() -> Iterator[Receiver]:
    opened = Receiver()
    yield opened
    opened.socket.close()


def parsed(datagrams: list[bytes]) -> list[Any]:
    return mavlink.MAVLink(None).parse_buffer(b"".join(datagrams)) or []


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_walk(tmp_path_factory.mktemp("walk") / "log")


@pytest.fixture(scope="module")
def detected(log: Path) -> Iterator[tuple[list[dict[str, Any]], list[bytes]]]:
    """Return the states of a pipe, and the datagrams that went out beside them."""
    receiver = Receiver()
    states, findings = piped(log, LiveSettings(mavlink=receiver.address))
    assert findings == ""
    yield states, receiver.datagrams()
    receiver.socket.close()


def compared(message: dict[str, Any], state: dict[str, Any]) -> None:
    """Compare a message with the state of a pipe, axis by axis as MAVLink's page has them."""
    (px, py, pz), (w, x, y, z) = state["position"], state["quaternion"]
    forward_left_up = Rotation.from_quat([x, y, z, w]).inv().apply(state["velocity"])
    expected = {
        "time_usec": round(1e6 * state["time"]),
        "frame_id": 20,  # MAV_FRAME_LOCAL_FRD
        "child_frame_id": 12,  # MAV_FRAME_BODY_FRD
        "x": px,
        "y": -py,
        "z": -pz,
        "vx": forward_left_up[0],
        "vy": -forward_left_up[1],
        "vz": -forward_left_up[2],
        "reset_counter": state["reset_counter"],
        "estimator_type": 3,  # MAV_ESTIMATOR_TYPE_VIO
    }
    for name, value in expected.items():
        assert message[name] == pytest.approx(value, rel=1e-6, abs=1e-6), name
    assert np.allclose(message["q"], [w, x, -y, -z], rtol=0.0, atol=1e-6)
    variances = [message["pose_covariance"][k] for k in (0, 6, 11)]
    assert np.allclose(np.sqrt(variances), state["sigma"]["position"], rtol=1e-5, atol=0.0)


def test_pymavlink_reads_every_state_of_a_pipe(
    detected: tuple[list[dict[str, Any]], list[bytes]],
) -> None:
    states, datagrams = detected
    messages = parsed(datagrams)
    assert len(messages) == len(datagrams)  # one each, none of them bad
    odometry = [one.to_dict() for one in messages if one.get_type() == "ODOMETRY"]
    started = [state for state in states if state["started"]]
    assert len(started) >= 3
    for message, state in zip(odometry, started, strict=True):
        compared(message, state)
        assert math.isnan(message["rollspeed"])
    beats = [one for one in messages if one.get_type() == "HEARTBEAT"]
    assert {one.system_status for one in beats} == {
        mavlink.MAV_STATE_CALIBRATING,
        mavlink.MAV_STATE_ACTIVE,
    }
    assert 6 <= len(beats) <= 8  # one a second, of eight seconds
    assert [one.get_seq() for one in messages] == list(range(len(messages)))


def wait_for(result: Callable[[], Any], step: Callable[[], object]) -> Any:
    """Return what is found at last; a step is taken as long as it is not, for half a minute."""
    for _ in range(3000):
        if result():
            return result()
        step()
        time.sleep(0.01)
    raise AssertionError("nothing came within half a minute")


def test_the_parser_of_mavsdk_reads_it(detected: tuple[list[dict[str, Any]], list[bytes]]) -> None:
    """The C++ of MAVSDK, which lets an application follow a vehicle."""
    mavsdk = pytest.importorskip("mavsdk.mavsdk")
    from mavsdk.component_type import ComponentType
    from mavsdk.plugins.mavlink_direct.mavlink_direct import MavlinkDirect
    from mavsdk.plugins.telemetry.telemetry import Telemetry

    states, datagrams = detected
    last = next(d for d in reversed(datagrams) if parsed([d])[0].get_type() == "ODOMETRY")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        out.bind(("127.0.0.1", 0))
        station = mavsdk.Mavsdk(
            mavsdk.Configuration.create_with_component_type(ComponentType.GROUND_STATION)
        )
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free_parameters:
            free_parameters.bind(("127.0.0.1", 0))
            port = free_parameters.getsockname()[1]
        station.add_any_connection(f"udpin://127.0.0.1:{port}")

        def send_beats() -> None:
            out.sendto(datagrams[0], ("127.0.0.1", port))

        def send_odometry() -> None:
            out.sendto(last, ("127.0.0.1", port))

        read: list[Any] = []
        reported: list[Any] = []
        try:
            system = wait_for(station.get_systems, send_beats)[0]
            direct, telemetry = MavlinkDirect(system), Telemetry(system)
            direct.subscribe_message("ODOMETRY", lambda message, _: read.append(message))
            telemetry.subscribe_odometry(lambda odometry, _: reported.append(odometry))
            wait_for(lambda: read and reported, send_odometry)
        finally:
            station.destroy()
    compared(json.loads(read[0].fields_json), states[-1])
    assert (read[0].system_id, read[0].component_id) == (1, 197)
    place, turn = reported[0].position_body, reported[0].q
    px, py, pz = states[-1]["position"]
    assert np.allclose([place.x_m, place.y_m, place.z_m], [px, -py, -pz], rtol=0.0, atol=1e-6)
    w, x, y, z = states[-1]["quaternion"]
    assert np.allclose([turn.w, turn.x, turn.y, turn.z], [w, x, -y, -z], rtol=0.0, atol=1e-6)


@pytest.mark.parametrize(
    ("axis", "degrees", "roll_pitch_yaw"),
    [
        ("z", 30.0, (0.0, 0.0, -30.0)),  # to the left, seen from above
        ("y", -20.0, (0.0, 20.0, 0.0)),  # the nose up
        ("x", 10.0, (10.0, 0.0, 0.0)),  # the right side down
    ],
)
def test_an_autopilot_sees_the_same_turn(
    axis: str, degrees: float, roll_pitch_yaw: tuple[float, float, float]
) -> None:
    turn = Rotation.from_euler(axis, degrees, degrees=True)
    ahead = turn.apply([2.0, 0.0, 0.0])
    state = replace(example_state(1), world_from_body=turn.as_matrix(), velocity_world=ahead)
    message = odometry_message(odometry_of(state), 50, 0)
    w, x, y, z = message.q
    yaw, pitch, roll = Rotation.from_quat([x, y, z, w]).as_euler("ZYX", degrees=True)
    assert np.allclose((roll, pitch, yaw), roll_pitch_yaw, rtol=0.0, atol=1e-9)
    assert np.allclose((message.vx, message.vy, message.vz), (2.0, 0.0, 0.0), rtol=0.0, atol=1e-12)


def full(upper: list[float]) -> np.ndarray[Any, np.dtype[np.float64]]:
    cov = np.zeros((6, 6))
    cov[np.triu_indices(6)] = upper
    return cov + np.triu(cov, 1).T


@pytest.mark.parametrize("seed", range(3))
def test_the_covariance_is_that_of_what_the_message_says(seed: int) -> None:
    """By differences: how position, attitude and velocity of the message move with the state."""
    state = example_state(seed)

    def findings(step: np.ndarray[Any, np.dtype[np.float64]]) -> tuple[Any, Rotation, Any]:
        one = odometry_message(odometry_of(moved_to(state, state.calibration, step)), 50, 0)
        w, x, y, z = one.q
        place, speed = np.array([one.x, one.y, one.z]), np.array([one.vx, one.vy, one.vz])
        return place, Rotation.from_quat([x, y, z, w]), speed

    size, columns = 1e-5, []
    for k in range(15):
        step = size * np.eye(15)[k]
        (place, turn, speed), (back, rotated, slow) = findings(step), findings(-step)
        moved = np.concatenate([place - back, (turn * rotated.inv()).as_rotvec(), speed - slow])
        columns.append(moved / (2.0 * size))
    jacobian = np.array(columns).T
    expected = jacobian @ state.cov @ jacobian.T
    message = odometry_message(odometry_of(state), 50, 0)
    pose, speed = full(message.pose_covariance), full(message.velocity_covariance)
    scale = np.sqrt(np.diag(expected))
    close = np.abs(pose - expected[:6, :6]) / np.outer(scale[:6], scale[:6])
    assert np.max(close) < 1e-6
    close = np.abs(speed[:3, :3] - expected[6:, 6:]) / np.outer(scale[6:], scale[6:])
    assert np.max(close) < 1e-6
    assert np.all(np.isnan(speed[3:]))  # rates of turning: unknown


def test_quality_falls_with_the_protection_level_and_halves_with_doubt() -> None:
    tight, wide = (
        quality_percent(example_state(0, Judgement(levels=Levels((level, None)))))
        for level in (0.0, 3.0)
    )
    assert (tight, wide) == (100, 25)
    assert quality_percent(example_state(0, DOUBTFUL)) == 25
    assert quality_percent(example_state(0, Judgement(levels=Levels((1e6, None))))) == 1
    assert quality_percent(example_state(0, Judgement())) == 0  # MAVLink's word for unknown


def test_of_a_lost_state_only_the_heartbeat_tells(receiver: Receiver) -> None:
    sender = MavlinkSender(receiver.address, EPOCH_NS)
    good = example_state(4)
    lost_epochs = replace(good, time=good.time + 2.0, judgement=MAX_FINAL_STEP_SIGMAS)
    again = replace(good, time=good.time + 4.0)
    for state in (good, lost_epochs, again):
        sender.take(state, release_gain(state))
    assert sender.close() is None
    kinds = [
        (one.get_type(), getattr(one, "system_status", None))
        for one in parsed(receiver.datagrams())
    ]
    active, critical = mavlink.MAV_STATE_ACTIVE, mavlink.MAV_STATE_CRITICAL
    assert kinds == [
        ("HEARTBEAT", active),
        ("ODOMETRY", None),
        ("HEARTBEAT", critical),
        ("HEARTBEAT", active),
        ("ODOMETRY", None),
    ]


def test_resets_and_stamps_are_those_of_the_log(receiver: Receiver) -> None:
    sender = MavlinkSender(receiver.address, EPOCH_NS)
    state = replace(example_state(4), reset_counter=257)
    sender.take(state, release_gain(state))
    sender.close()
    _, message = parsed(receiver.datagrams())
    assert message.reset_counter == 1  # of eight bits
    assert abs(message.time_usec - (EPOCH_NS // 1000 + 1e6 * state.time)) <= 1.0


def test_who_cannot_be_reached_stops_nothing() -> None:
    """Everybody may not be sent to without being asked for, so that the kernel refuses it."""
    sender, state = MavlinkSender("udpout:255.255.255.255:14550", 0), example_state(4)
    for later in range(3):
        sender.take(state, release_gain(state) | {"time": state.time + 0.1 * later})
    findings = sender.close()
    assert findings is not None
    assert findings.startswith(
        "--mavlink: 4 messages could not be sent ("
    )  # one of them a heartbeat


@pytest.mark.slow
def test_the_replay_of_a_log_sends_them_too(
    log: Path,
    tmp_path: Path,
    receiver: Receiver,
    detected: tuple[list[dict[str, Any]], list[bytes]],
) -> None:
    run_command(
        *("navigate", log, "--estimator", "ekf", "--mavlink", receiver.address),
        *("-o", tmp_path / "run"),
    )
    result = [one for one in parsed(receiver.datagrams()) if one.get_type() == "ODOMETRY"]
    started = [state for state in detected[0] if state["started"]]
    for message, state in zip(result, started, strict=True):
        reported = message.to_dict()
        assert abs(reported.pop("time_usec") - EPOCH_NS // 1000 - 1e6 * state["time"]) <= 1.0
        compared(reported | {"time_usec": round(1e6 * state["time"])}, state)


@pytest.mark.parametrize(
    ("address", "sentence"),
    [
        ("127.0.0.1:14550", "is not an address to send to; write udpout:HOST:PORT"),
        ("udpout:127.0.0.1", "is not an address to send to"),
        ("udpout:127.0.0.1:70000", "is not an address to send to"),
        ("tcp:127.0.0.1:5760", "is not an address to send to"),
        ("udpout:no..body:14550", "the host no..body is unknown"),
    ],
)
def test_a_bad_address_is_refused(
    log: Path, tmp_path: Path, refuse: Refuse, address: str, sentence: str
) -> None:
    findings = refuse("navigate", log, "-o", tmp_path / "run", "--mavlink", address)
    assert f"--mavlink {address!r}: " in findings
    assert sentence in findings
    assert sentence in refuse("navigate", "-", "--site", log / "site.yaml", "--mavlink", address)


def test_what_is_not_installed_is_named(
    log: Path, refuse: Refuse, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pymavlink.dialects.v20", None)
    findings = refuse(
        "navigate", "-", "--site", log / "site.yaml", "--mavlink", "udpout:[::1]:14550"
    )
    assert "pip install 'magfusion[mavlink]'" in findings
