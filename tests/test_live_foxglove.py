"""States as Foxglove's app receives them: by its protocol, with the types that it is told."""

import io
import json
import socket
import struct
import sys
import threading
from base64 import b64decode
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Refuse
from live_states import EPOCH_NS, MAX_FINAL_STEP_SIGMAS, example_state, release_gain, write_walk

from magfusion.estimation.online.navigator import NavigatorSettings
from magfusion.files.log import read_log
from magfusion.jobs.live import LiveSettings
from magfusion.jobs.replay import run_replay
from magfusion.jobs.stream import StreamSettings, run_stream
from magfusion.results.live_foxglove import FoxgloveServer

pytest.importorskip("foxglove")
websockets = pytest.importorskip("websockets.sync.client")
exceptions = pytest.importorskip("websockets.exceptions")
descriptor_pb2 = pytest.importorskip("google.protobuf.descriptor_pb2")
descriptor_pool = pytest.importorskip("google.protobuf.descriptor_pool")
message_factory = pytest.importorskip("google.protobuf.message_factory")

MAX_WAIT = 60.0  # s


class App:
    """What the app does: it subscribes to all that is advertised, and reads it by its schema."""

    def __init__(self, connection: Any) -> None:
        self.connection, self.channels = connection, {}
        while len(self.channels) < 3:
            reported = json.loads(connection.recv(timeout=MAX_WAIT))
            for channel in reported.get("channels", ()):
                self.channels[channel["id"]] = channel
        wanted = [{"id": number, "channelId": number} for number in self.channels]
        connection.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
        # Answered after what came before it.
        assert connection.ping().wait(MAX_WAIT)

    def next(self) -> tuple[str, int, Any]:
        """Return topic, time (ns) and content of the next message."""
        while isinstance(data := self.connection.recv(timeout=MAX_WAIT), str):
            pass
        kind, number, stamp = struct.unpack_from("<BIQ", data)
        assert kind == 1
        channel, content = self.channels[number], data[13:]
        if channel["encoding"] == "json":
            return channel["topic"], stamp, json.loads(content)
        files = descriptor_pb2.FileDescriptorSet.FromString(b64decode(channel["schema"]))
        pool = descriptor_pool.DescriptorPool()
        for file in files.file:
            pool.Add(file)
        described = pool.FindMessageTypeByName(channel["schemaName"])
        message = message_factory.GetMessageClass(described)()
        message.ParseFromString(content)
        return channel["topic"], stamp, message


def connected(port: int) -> Any:
    return websockets.connect(f"ws://127.0.0.1:{port}", subprotocols=["foxglove.sdk.v1"])


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_walk(tmp_path_factory.mktemp("walk") / "log")


@pytest.fixture
def server() -> Iterator[FoxgloveServer]:
    opened = FoxgloveServer("0", EPOCH_NS, "map", "base_link")
    yield opened
    opened.close()


def test_the_app_reads_state_pose_and_transform(server: FoxgloveServer) -> None:
    state = example_state(1)
    reported = release_gain(state)
    stamp = EPOCH_NS + round(1e9 * state.time)
    with connected(server.port) as connection:
        app = App(connection)
        server.take(state, reported)
        received = [app.next() for _ in range(3)]
    assert {topic for topic, _, _ in received} == {"/magfusion/state", "/magfusion/pose", "/tf"}
    for topic, time, content in received:
        assert time == stamp
        if topic == "/magfusion/state":
            assert content == reported
            continue
        assert content.timestamp.ToNanoseconds() == stamp
        if topic == "/tf":
            assert content.DESCRIPTOR.full_name == "foxglove.FrameTransform"
            assert (content.parent_frame_id, content.child_frame_id) == ("map", "base_link")
            place, turn = content.translation, content.rotation
        else:
            assert content.DESCRIPTOR.full_name == "foxglove.PoseInFrame"
            assert content.frame_id == "map"
            place, turn = content.pose.position, content.pose.orientation
        assert [place.x, place.y, place.z] == state.position_world.tolist()
        # The forward axis, by the quaternion's own formula.
        x, y, z, w = turn.x, turn.y, turn.z, turn.w
        forward = [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)]
        assert np.allclose(forward, state.world_from_body[:, 0], rtol=0.0, atol=1e-12)


def test_of_a_lost_state_and_before_the_first_there_is_no_pose(server: FoxgloveServer) -> None:
    good = example_state(2)
    lost_epochs = replace(good, judgement=MAX_FINAL_STEP_SIGMAS)
    with connected(server.port) as connection:
        app = App(connection)
        for state in (None, lost_epochs, good):
            server.take(state, release_gain(lost_epochs if state is None else state))
        received = [app.next() for _ in range(5)]
    assert [topic for topic, _, _ in received[:2]] == ["/magfusion/state"] * 2
    assert received[1][2]["verdict"] == "failed"
    assert {topic for topic, _, _ in received[2:]} == {
        "/magfusion/state",
        "/magfusion/pose",
        "/tf",
    }


class Held(io.RawIOBase):
    """Records that come when somebody listens."""

    def __init__(self, records: bytes, listening: threading.Event) -> None:
        self.records, self.listening = io.BytesIO(records), listening

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        assert self.listening.wait(MAX_WAIT)
        return self.records.readinto(buffer)


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def test_a_pipe_is_followed_live(log: Path) -> None:
    """All that the pipe prints comes to the app, in order, and a pose for each that has one."""
    records, sink, listening, port = io.BytesIO(), io.BytesIO(), threading.Event(), free_port()
    run_replay(read_log(log), records, "json", realtime=False)
    settings = StreamSettings(
        NavigatorSettings("ekf"), live=LiveSettings(foxglove=f"127.0.0.1:{port}")
    )
    received: list[tuple[str, int, Any]] = []

    def follow() -> None:
        for _ in range(600):
            try:
                connection = connected(port)
                break
            except OSError:
                threading.Event().wait(0.1)
        with connection:
            app = App(connection)
            listening.set()
            try:
                while True:
                    received.append(app.next())
            except exceptions.ConnectionClosed:
                pass

    follower = threading.Thread(target=follow)
    follower.start()
    source = io.BufferedReader(Held(records.getvalue(), listening))
    run_stream(log / "site.yaml", settings, source, sink, io.StringIO())
    follower.join(MAX_WAIT)
    printed = [json.loads(line) for line in sink.getvalue().splitlines()]
    states = [content for topic, _, content in received if topic == "/magfusion/state"]
    assert states == printed
    started = [state for state in printed if state["started"]]
    assert len(started) >= 3
    for name in ("/magfusion/pose", "/tf"):
        assert len([topic for topic, _, _ in received if topic == name]) == len(started)


@pytest.mark.parametrize("address", ["", ":", "home", "127.0.0.1:", "127.0.0.1:70000", ":8765"])
def test_a_bad_address_is_refused(log: Path, refuse: Refuse, address: str) -> None:
    findings = refuse("navigate", "-", "--site", log / "site.yaml", "--foxglove", address)
    assert f"--foxglove {address!r}: is not an address to listen at; write a port" in findings


def test_a_port_that_is_taken_is_refused(log: Path, refuse: Refuse, server: FoxgloveServer) -> None:
    findings = refuse("navigate", "-", "--site", log / "site.yaml", "--foxglove", server.port)
    assert f"--foxglove '{server.port}': it cannot listen there (" in findings
    assert "give another port" in findings


def test_what_is_not_installed_is_named(
    log: Path, refuse: Refuse, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "foxglove", None)
    findings = refuse("navigate", "-", "--site", log / "site.yaml", "--foxglove", "8765")
    assert "pip install 'magfusion[foxglove]'" in findings
