"""What is wrong with a checkpoint is told in one sentence; nothing is executed, nothing is lost."""

import io
import pickle
import struct
from collections.abc import Callable
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from conftest import Refuse, _listing
from online_log import online_log
from test_navigate_stream import records

from magfusion.errors import InputError
from magfusion.estimation.online.navigator import NavigatorSettings
from magfusion.files.checkpoint import MAGIC, read_checkpoint, write_checkpoint
from magfusion.files.log import write_log
from magfusion.files.plain_data import from_plain
from magfusion.files.site import save_site
from magfusion.jobs import navigate
from magfusion.jobs.drift_world import WorldTask, run_world
from magfusion.jobs.inputs import named
from magfusion.jobs.navigate import run_navigate
from magfusion.jobs.navigate_settings import NavigateSettings
from magfusion.jobs.stream import StreamSettings, run_stream
from magfusion.model.samples import Log
from magfusion.simulation.demo_site import demo_site
from magfusion.units import Array

START = (
    100  # bytes before the content: magic 16, version 4, position 8, key 32, length 8, digest 32
)


@dataclass(frozen=True)
class Hostile:
    """Creates a file where it is unpickled."""

    sentinel: Path

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.sentinel,)


@dataclass(frozen=True)
class Interrupted:
    """What a killed run left, and how to go on with it."""

    place: Path
    go_on: Callable[[], object]
    names: tuple[str, ...] = ()


def sealed(whole: bytes, content: bytes) -> bytes:
    """Return a checkpoint with another content, its length and digest right."""
    head = whole[:60] + struct.pack("<Q", len(content))
    return head + sha256(head + content).digest() + content


def flipped(whole: bytes, rng: np.random.Generator) -> bytes:
    """Return it with some bits turned over, in the header as often as in the content."""
    out = bytearray(whole)
    within = START if rng.random() < 0.5 else len(out)
    for at in rng.integers(0, within, rng.integers(1, 9)):
        out[at] ^= 1 << int(rng.integers(0, 8))
    # Two flips of one bit are none.
    return bytes(out) if bytes(out) != whole else whole[:-1]


def cut(whole: bytes, rng: np.random.Generator) -> bytes:
    return whole[: rng.integers(0, len(whole))]


def extended(whole: bytes, rng: np.random.Generator) -> bytes:
    return whole + rng.bytes(int(rng.integers(1, 1000)))


def of_another_run(whole: bytes, rng: np.random.Generator) -> bytes:
    head = whole[:28] + rng.bytes(32) + whole[60:68]
    return head + sha256(head + whole[START:]).digest() + whole[START:]


def of_another_version(whole: bytes, rng: np.random.Generator) -> bytes:
    head = whole[:16] + struct.pack("<I", rng.integers(5, 1 << 32)) + whole[20:68]
    return head + sha256(head + whole[START:]).digest() + whole[START:]


def bomb(whole: bytes, rng: np.random.Generator) -> bytes:
    """Return one that announces far more than it holds."""
    huge = struct.pack(">I", int(rng.integers(1 << 20, 1 << 32)))
    array = {"dtype": "<f8", "shape": [1 << 20, 1 << 20, 1 << 20], "data": b""}
    contents = [
        b"\xdd" + huge,  # a list
        b"\xdf" + huge,  # a mapping
        b"\xdb" + huge,  # a text
        b"\xc6" + huge,  # bytes
        (b"\xdd" + struct.pack(">I", 1 << 14)) * 2000,  # lists in lists
        b"\x91" * 100_000,
        msgpack.packb({"navigator": array, "beside": None}),
        msgpack.packb({"navigator": array | {"dtype": "O"}, "beside": None}),
        msgpack.packb({"navigator": array | {"shape": [-1]}, "beside": None}),
    ]
    chosen = int(rng.integers(len(contents) + 1))
    if chosen < len(contents):
        return sealed(whole, contents[chosen])
    return whole[:60] + b"\xff" * 8 + whole[68:]


def leaves(data: Any) -> list[tuple[Any, Any]]:
    """Return every place of a value that is no collection."""
    pairs = data.items() if isinstance(data, dict) else enumerate(data)
    out = []
    for key, value in pairs:
        out += leaves(value) if isinstance(value, dict | list) else [(data, key)]
    return out


def spoiled(whole: bytes, rng: np.random.Generator, scratch: Path) -> bytes:
    """Return one whose digest is right and whose content is of another type or shape."""
    scratch.write_bytes(whole)
    result = read_checkpoint(scratch)
    assert result is not None
    places = leaves(result.content["navigator"])
    holder, key = places[rng.integers(len(places))]
    value = holder[key]
    if isinstance(value, np.ndarray) and rng.random() < 0.5:
        holder[key] = np.zeros(value.shape, "<f8" if value.dtype == bool else bool)
    else:
        wrong: list[Any] = [{"a": 1}, {"__reduce__": "os.system"}, np.zeros((2, 0, 7), bool)]
        holder[key] = wrong[rng.integers(len(wrong))]
    write_checkpoint(result, scratch)
    return scratch.read_bytes()


def hostile(whole: bytes, rng: np.random.Generator, sentinel: Path) -> bytes:
    attack = pickle.dumps(Hostile(sentinel), protocol=int(rng.integers(0, 6)))
    inside = {"navigator": attack, "beside": attack}
    extension = {"navigator": msgpack.ExtType(int(rng.integers(0, 128)), attack), "beside": None}
    forms = [
        attack,
        MAGIC + attack,
        whole[:START] + attack,
        sealed(whole, attack),
        sealed(whole, msgpack.packb(inside)),
        sealed(whole, msgpack.packb(extension)),
        pickle.dumps({"key": whole[28:60], "navigator": Hostile(sentinel)}),
    ]
    return forms[rng.integers(len(forms))]


def damaged(whole: bytes, k: int, tmp_path: Path) -> bytes:
    """Return the k-th way to damage a checkpoint."""
    rng = np.random.default_rng(k)
    plain = (flipped, cut, extended, of_another_run, of_another_version, bomb)
    ways: list[Callable[[], bytes]] = [lambda w=way: w(whole, rng) for way in plain]  # type: ignore[misc]
    ways += [
        lambda: spoiled(whole, rng, tmp_path / "scratch"),
        lambda: hostile(whole, rng, tmp_path / "sentinel"),
    ]
    return ways[k % len(ways)]()


def refused(residual: Interrupted, file: Path, content: bytes, tmp_path: Path) -> str:
    """Go on with a damaged file; return the refusal, having seen that nothing came of it."""
    former = file.read_bytes()
    file.write_bytes(content)
    before = _listing(tmp_path)
    try:
        with pytest.raises(InputError) as reported:
            residual.go_on()
        assert _listing(tmp_path) == before
        assert file.read_bytes() == content
    finally:
        file.write_bytes(former)
    assert not (tmp_path / "sentinel").exists()
    sentence = str(reported.value)
    assert "\n" not in sentence
    assert str(file) in sentence or "does not match its checkpoint" in sentence
    assert len(sentence) < 400 + len(str(file))
    return sentence


@pytest.fixture
def stream(tmp_path: Path) -> Interrupted:
    """Return a pipe that was cut in the middle, its calibration estimated."""
    walk, site, place = online_log(3, 12.0), tmp_path / "site.yaml", tmp_path / "checkpoint"
    save_site(demo_site(), site)
    lines = records(walk).splitlines(keepends=True)
    settings = StreamSettings(NavigatorSettings(lag=1.5), checkpoint=place, every=0.5)

    def run(given: bytes, *, resume: bool) -> None:
        chosen = replace(settings, resume=resume)
        run_stream(site, chosen, io.BytesIO(given), io.BytesIO(), io.StringIO())

    run(b"".join(lines[:-20]), resume=False)
    return Interrupted(place, lambda: run(b"", resume=True))


@pytest.mark.slow
def test_damaged_checkpoints_of_a_pipe_are_refused(stream: Interrupted, tmp_path: Path) -> None:
    whole = stream.place.read_bytes()
    stream.go_on()
    reported = [
        refused(stream, stream.place, damaged(whole, k, tmp_path), tmp_path) for k in range(400)
    ]
    assert all("--resume" in sentence or "another path" in sentence for sentence in reported)
    stream.go_on()


@pytest.fixture
def log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Interrupted:
    """Return the navigation along a log that was killed in the middle."""
    walk, path = online_log(3, 12.0), tmp_path / "log"
    write_log(Log("walk", 0, "test", walk.imu, None, walk.fields), path)
    save_site(walk.site, path / "site.yaml")
    output = tmp_path / "run"
    settings = NavigateSettings(log=path, estimator="ekf", every=1.0)
    usual, fed = navigate.feed, []

    def interrupted(*given: Any) -> None:
        fed.append(given)
        if len(fed) > 100:
            raise KeyboardInterrupt
        usual(*given)

    monkeypatch.setattr(navigate, "feed", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run_navigate(settings, output)
    resumed = replace(settings, resume=True)
    return Interrupted(
        output / "checkpoint.bin",
        lambda: run_navigate(resumed, output),
        ("checkpoint.bin", "checkpoint.rows"),
    )


@pytest.mark.slow
def test_damaged_state_of_a_log_is_refused(log: Interrupted, tmp_path: Path) -> None:
    place, rows = (log.place.with_name(name) for name in log.names)
    whole = place.read_bytes()
    for k in range(40):
        refused(log, place, damaged(whole, k, tmp_path), tmp_path)
    whole = rows.read_bytes()
    built = read_checkpoint(place)
    assert built is not None
    size = built.content["beside"]["rows"]["size"]
    for k in range(30):
        rng = np.random.default_rng(k)
        content = (
            hostile(whole, rng, tmp_path / "sentinel") if k % 3 else flipped(whole[:size], rng)
        )
        refused(log, rows, whole[: rng.integers(0, size)] if k % 3 == 1 else content, tmp_path)


@pytest.mark.slow
def test_damaged_state_of_a_world_is_refused(tmp_path: Path) -> None:
    task = WorldTask(0, "ekf", 0.1, 1, place=str(tmp_path / "unfinished"))
    run_world(task)
    remaining = Interrupted(task.progress, lambda: run_world(task))
    whole = task.progress.read_bytes()
    for k in range(24):
        refused(remaining, task.progress, damaged(whole, k, tmp_path), tmp_path)
    for name in ("errors.rows", "pace.rows"):
        rows = task.progress.with_name(name)
        whole = rows.read_bytes()
        for k in range(3):
            refused(remaining, rows, flipped(whole, np.random.default_rng(k)), tmp_path)


@pytest.mark.parametrize("option", [["--resume"], []])
@pytest.mark.parametrize("kind", ["pickle", "text", "directory", "rows"])
def test_a_file_that_is_not_ours_is_kept(
    refuse: Refuse, tmp_path: Path, worked: Any, option: list[str], kind: str
) -> None:
    place = tmp_path / "mine"
    if kind == "directory":
        place.mkdir()
    elif kind == "rows":
        place.with_name("mine.rows").write_text("the only copy of my rows")
    else:
        hostile_one = pickle.dumps(Hostile(tmp_path / "sentinel"))
        place.write_bytes(hostile_one if kind == "pickle" else b"the only copy of my thesis")
    reported = refuse(
        "navigate", worked.log, "-o", tmp_path / "run", "--checkpoint", place, *option
    )
    assert str(place) in reported


@dataclass(frozen=True)
class _Inner:
    name: str


@dataclass(frozen=True)
class _Outer:
    parts: list[_Inner]


def test_what_is_wrong_deep_inside_is_said_once() -> None:
    with pytest.raises(InputError) as refused:
        from_plain(_Outer, {"parts": [{"name": "a"}, {"name": 3}]}, "navigator")
    assert str(refused.value) == "navigator.parts[1].name is no str; run without --resume"


def test_a_file_is_named_though_its_name_is_part_of_a_word() -> None:
    with pytest.raises(InputError, match=r"^c: channels do not fit$"), named(Path("c")):
        raise InputError("channels do not fit")
    with pytest.raises(InputError, match=r"^log/c: is damaged$"), named(Path("log/c")):
        raise InputError("log/c: is damaged")


@pytest.mark.parametrize("value", [1e300, -1e300, np.array([0.0, 1e300])])
def test_a_number_that_no_state_has_is_refused(value: Any) -> None:
    kind = Array if isinstance(value, np.ndarray) else float
    with pytest.raises(InputError, match=r"state\.x is beyond 1e\+100; run without --resume"):
        from_plain(kind, value, "state.x")
    assert from_plain(float, float("-inf"), "state.x") == float("-inf")


@pytest.mark.parametrize(
    ("name", "value"), [("usual", 0.0), ("usual", 1e-9), ("offset", 1e9), ("last_epoch", np.nan)]
)
def test_an_inertial_stream_of_no_rate_is_refused(
    name: str, value: float, stream: Interrupted, tmp_path: Path
) -> None:
    state = read_checkpoint(stream.place)
    assert state is not None
    arrived = state.content["navigator"]["parts"]["_loop"]["arrived"]
    (arrived if name in arrived else arrived["imu"])[name] = value
    (scratch := tmp_path / "scratch").touch()
    write_checkpoint(state, scratch)
    assert "an invalid " in refused(stream, stream.place, scratch.read_bytes(), tmp_path)
