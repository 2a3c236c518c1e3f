"""Navigation in a pipe: the records, the states, and what is no record."""

import io
import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from conftest import run_command
from online_log import OnlineLog, online_log

from magfusion.errors import InputError
from magfusion.estimation.online.navigator import Navigator, NavigatorSettings
from magfusion.files.log import write_log
from magfusion.files.record_samples import field_samples
from magfusion.files.records import FieldsRecord
from magfusion.files.site import save_site
from magfusion.files.stream import Format, json_line, read_records
from magfusion.files.stream_contents import fields_content
from magfusion.jobs.replay import Replay, feed, run_replay
from magfusion.jobs.stream import StreamSettings, run_stream, state_content
from magfusion.model.samples import FieldSamples, Log

SCRIPT = Path(sys.executable).parent / "magfusion"
EKF = StreamSettings(NavigatorSettings("ekf"))


@pytest.fixture(scope="module")
def walk() -> OnlineLog:
    return online_log(3, 14.0)


@pytest.fixture(scope="module")
def site(walk: OnlineLog, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("site") / "site.yaml"
    save_site(walk.site, path)
    return path


def as_log(walk: OnlineLog) -> Log:
    return Log("walk", 0, "test", walk.imu, None, walk.fields)


def records(walk: OnlineLog, form: Format = "json") -> bytes:
    sink = io.BytesIO()
    run_replay(as_log(walk), sink, form, realtime=False)
    return sink.getvalue()


def answered(site: Path, given: bytes, settings: StreamSettings = EKF) -> tuple[list[Any], str]:
    sink, reported = io.BytesIO(), io.StringIO()
    run_stream(site, settings, io.BytesIO(given), sink, reported)
    return [json.loads(line) for line in sink.getvalue().splitlines()], reported.getvalue()


@pytest.mark.slow
@pytest.mark.parametrize("form", ["json", "msgpack"])
def test_a_stream_leads_to_the_states_of_the_log(walk: OnlineLog, site: Path, form: Format) -> None:
    navigator, expected = Navigator(walk.site, EKF.navigator), []
    replayed = Replay(as_log(walk))
    for k in range(len(replayed)):
        feed(navigator, replayed.piece(k))
        expected += [state_content(navigator, state) for state in navigator.take()]
    given, _ = answered(site, records(walk, form), StreamSettings(EKF.navigator, form))
    states = [s for s in given if s["started"]]
    assert len(states) >= 14
    # The site went through its file, whose angles are in degrees.
    for result, own in zip(states, expected, strict=True):
        assert result["time"] == own["time"]
        assert result["heard"] == own["heard"]
        for name in ("position", "quaternion", "velocity", "gyro_bias", "accel_bias"):
            assert np.allclose(result[name], own[name], rtol=1e-6, atol=1e-8)
    assert {name for s in states for name in s["heard"]} == {b.name for b in walk.site.beacons}
    waiting = [s["time"] for s in given if not s["started"]]
    assert np.all(np.diff(waiting) >= 1.0)
    assert 5 <= len(waiting) <= 8


@pytest.mark.slow
@pytest.mark.parametrize("form", ["json", "msgpack"])
def test_nan_and_null_are_missing_samples_as_in_tables(
    walk: OnlineLog, site: Path, form: Format
) -> None:
    """The same states as where the samples were never sent, and a count at the end."""
    lines = [json.loads(line) for line in records(walk).splitlines()]
    inertial = [k for k, one in enumerate(lines) if "imu" in one][200:1000:100]
    remaining = [one for k, one in enumerate(lines) if k not in inertial]
    spoiled = [json.loads(json.dumps(one)) for one in lines]
    for k, value in zip(inertial, (np.nan, None) * len(inertial), strict=False):
        gyro = np.array(spoiled[k]["imu"]["gyro"], dtype=object)
        gyro[..., 1] = value
        spoiled[k]["imu"]["gyro"] = gyro.tolist()
    write = msgpack.packb if form == "msgpack" else lambda one: json.dumps(one).encode() + b"\n"
    settings = StreamSettings(EKF.navigator, form)
    expected, _ = answered(site, b"".join(write(one) for one in remaining), settings)
    result, reported = answered(site, b"".join(write(one) for one in spoiled), settings)
    count = sum(np.size(lines[k]["imu"]["time"]) for k in inertial)
    assert [s for s in result if s["started"]] == [s for s in expected if s["started"]]
    assert reported == (
        f"magfusion: imu: {count} samples are NaN, or larger than any instrument measures. They are"
        " left out.\n"
    )


@pytest.mark.slow
def test_samples_beyond_a_declared_range_are_missing_in_the_pipe(
    walk: OnlineLog, tmp_path: Path
) -> None:
    imu = replace(walk.site.platform.imu, gyro_range=6.0)  # rad/s
    save_site(
        replace(walk.site, platform=replace(walk.site.platform, imu=imu)), tmp_path / "s.yaml"
    )
    lines = [json.loads(line) for line in records(walk).splitlines()]
    inertial = [k for k, one in enumerate(lines) if "imu" in one][200:1000:100]
    remaining = [one for k, one in enumerate(lines) if k not in inertial]
    for k in inertial:
        gyro = np.array(lines[k]["imu"]["gyro"])
        gyro[..., 2] = 6.1
        lines[k]["imu"]["gyro"] = gyro.tolist()
    expected, _ = answered(tmp_path / "s.yaml", b"".join(map(json_line, remaining)))
    result, reported = answered(tmp_path / "s.yaml", b"".join(map(json_line, lines)))
    count = sum(np.size(lines[k]["imu"]["time"]) for k in inertial)
    assert [s for s in result if s["started"]] == [s for s in expected if s["started"]]
    assert reported == (
        f"magfusion: gyroscope: {count} samples are beyond the range in"
        " platform.imu.gyro_range_rad_s. They are left out.\n"
    )


def test_fields_in_nanotesla_are_refused_with_the_unit(site: Path) -> None:
    time = (0.01 * np.arange(60)).tolist()
    fields = [[1.2e3, 1.9e4, -4.5e4]] * 60
    given = json_line({"magnetometer": {"time": time, "field": fields}})
    with pytest.raises(InputError, match=r"magnetometer: no sample so far .* give tesla"):
        answered(site, given)


def test_a_stream_that_begins_with_missing_samples_waits(site: Path) -> None:
    """What holds no sample has no time at which anything could be said."""
    missing = json_line({"imu": {"time": 1.0, "gyro": [None, 0.0, 0.0], "accel": [0.0, 0.0, 9.8]}})
    present = json_line({"imu": {"time": 1.1, "gyro": [0.0, 0.0, 0.0], "accel": [0.0, 0.0, 9.8]}})
    result, reported = answered(site, missing + present)
    assert [line["time"] for line in result] == [1.1]
    assert reported.startswith("magfusion: imu: 1 samples are NaN, or larger than any instrument")


def test_a_state_tells_all_that_is_known(walk: OnlineLog, site: Path) -> None:
    last = answered(site, records(walk))[0][-1]
    truth = walk.motion.trajectory(np.array([last["time"]]))
    assert np.linalg.norm(last["position"] - truth.position_world[0]) < 0.005  # m
    w, x, y, z = last["quaternion"]
    forward = [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)]
    assert np.allclose(forward, truth.world_from_body[0][:, 0], rtol=0.0, atol=0.003)
    assert set(last["sigma"]) == {
        "position",
        "rotation_body",
        "velocity",
        "gyro_bias",
        "accel_bias",
    }
    assert all(0.0 < s < 0.01 for s in last["sigma"]["position"])
    assert set(last["distortion"]) == {"A", "B", "C", "D"}
    assert last["ambiguous"] is False


def test_phasors_are_the_same_on_the_other_side_of_the_pipe(walk: OnlineLog) -> None:
    fields = walk.fields
    phasor = fields.phasor_sensor[:1].copy()
    phasor[0, 2] = np.nan
    cov = fields.phasor_cov[:1] * np.array([1.0, 2.0, 3.0])
    one = FieldSamples(fields.time[:1], fields.window[:1], fields.channels, phasor, cov)
    line = json_line(fields_content(one))
    (result,) = read_records(io.BytesIO(line), "json")
    assert result.record is not None
    assert result.record.fields is not None
    back = field_samples(result.record.fields, fields.channels)
    assert np.array_equal(back.phasor_sensor, phasor, equal_nan=True)
    detected = [0, 1, 3]
    assert np.array_equal(back.phasor_cov[:, detected], cov[:, detected])


def test_a_sigma_is_that_of_every_component() -> None:
    entry = FieldsRecord.model_validate(
        {
            "time": 1.0,
            "window": 0.4,
            "sigma": 2e-9,
            "phasors": {"B": [None, [[1e-7, 0, 0], [0, 0, 3e-7]]]},
        }
    )
    samples = field_samples(entry, (("A", 0), ("B", 0), ("B", 1)))
    assert samples.valid.tolist() == [[False, False, True]]
    assert np.array_equal(samples.phasor_sensor[0, 2], [1e-7, 0, 3e-7j])
    assert np.allclose(samples.phasor_cov[0, 2], 4e-18 * np.eye(3), rtol=1e-12, atol=0.0)


VECTOR = [1.0, 2.0, 3.0]
FIELDS = {"time": 1.0, "window": 0.4, "sigma": 1e-9, "phasors": {"A": [[VECTOR, VECTOR]]}}


@pytest.mark.parametrize(
    ("record", "sentence"),
    [
        (b"{", "write valid JSON"),
        (
            {"drive": {"time": 0, "current": {"x": 1}}},
            "current.x: found 'x'; write text of the form",
        ),
        ({"drive": {"time": 0, "current": {}}}, "current: found {}; write at least 1 entries"),
        ({"temperature": {"time": 0, "degc": {"A": "x"}}}, "degc.A: found 'x'; write a number"),
        ({"temperature": {"time": 0, "degc": []}}, "degc: found []; write a mapping"),
        (b"[]", "write a mapping with the keys imu, magnetometer, fields"),
        (
            b"{}",
            "it should hold imu, magnetometer, fields, temperature, drive, marks, reference",
        ),
        ({"gyro": 1}, "gyro: is not a known key; remove it or write one of imu, magnetometer"),
        ({"imu": {"time": 1.0, "gyro": VECTOR}}, "imu.accel: is missing; add it"),
        ({"imu": {"time": "1", "gyro": VECTOR, "accel": VECTOR}}, "imu.time: found '1'; it should"),
        ({"imu": {"time": True, "gyro": VECTOR, "accel": VECTOR}}, "imu.time: found True; it sho"),
        ({"imu": {"time": 1, "gyro": [1, 2], "accel": VECTOR}}, "imu.gyro: found [1, 2]; it shoul"),
        ({"imu": {"time": [1, 2], "gyro": VECTOR, "accel": VECTOR}}, "gyro has 1 rows for 2 times"),
        (b'{"magnetometer": {"time": 1, "field": [1, 2, 1e999]}}', "magnetometer.field: found [1"),
        (b'{"magnetometer": {"time": 1, "field": [1, 2, "3"]}}', "magnetometer.field: found [1, 2"),
        (
            b'{"magnetometer": {"time": 1, "field": [1, true, null]}}',
            "magnetometer.field: found [1",
        ),
        (b'{"magnetometer": {"time": NaN, "field": [1, 2, 3]}}', "magnetometer.time: found nan"),
        (b'{"magnetometer": {"time": 1e999, "field": [1, 2, 3]}}', "magnetometer.time: found inf"),
        ({"fields": {**FIELDS, "window": 0.0}}, "fields.window: found 0.0; "),
        ({"fields": {**FIELDS, "sigma": None}}, "it should have either sigma or covariance"),
        ({"fields": {**FIELDS, "sigma": -1.0}}, "fields.sigma: found -1.0"),
        ({"fields": {**FIELDS, "phasors": {"A": VECTOR}}}, "fields.phasors.A: found [1.0, 2.0, 3."),
        (
            {"fields": {**FIELDS, "phasors": {"Q": [[VECTOR, VECTOR]]}}},
            "holds beacon Q tone 0; the",
        ),
    ],
)
def test_a_bad_line_is_refused_in_one_sentence(
    site: Path, record: bytes | dict[str, Any], sentence: str
) -> None:
    line = record if isinstance(record, bytes) else json.dumps(record).encode()
    good = json_line({"magnetometer": {"time": 0.0, "field": VECTOR}})
    with pytest.raises(InputError) as raised:
        answered(site, good + b"\n" + line + b"\n")
    reported = str(raised.value)
    assert reported.startswith("standard input, line 3: ")
    assert sentence in reported
    assert "\n" not in reported


@pytest.mark.slow
def test_bad_lines_are_counted_and_passed_over_where_that_is_asked(
    walk: OnlineLog, site: Path
) -> None:
    lines = records(walk).splitlines(keepends=True)
    clean, _ = answered(site, b"".join(lines))
    jumped = json_line({"imu": {"time": 1e6, "gyro": VECTOR, "accel": VECTOR}})
    dirty = [*lines[:50], b"nonsense\n", *lines[50:200], jumped, *lines[200:]]
    going = StreamSettings(EKF.navigator, keep_going=True)
    result, reported = answered(site, b"".join(dirty), going)
    assert result == clean
    assert "line 51: found" in reported
    assert "line 202: imu: its clock jumped ahead" in reported
    assert reported.splitlines()[-1] == "magfusion: 2 records were skipped"


def test_message_pack_that_breaks_off_inside_is_refused(site: Path) -> None:
    good = msgpack.packb({"magnetometer": {"time": 0.0, "field": VECTOR}})
    settings = StreamSettings(EKF.navigator, "msgpack")
    with pytest.raises(InputError, match="standard input, record 2: is no MessagePack"):
        answered(site, good + b"\xc1" + good, settings)
    with pytest.raises(InputError, match="standard input, record 2: gyro: is not a known key"):
        answered(site, good + msgpack.packb({"gyro": 1}), settings)


@pytest.mark.slow
def test_states_come_as_soon_as_their_records(walk: OnlineLog, site: Path) -> None:
    """A reader of the states waits for no more than has been written."""
    command = [SCRIPT, "navigate", "-", "--site", site, "--estimator", "ekf"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as running:
        assert running.stdin is not None
        assert running.stdout is not None
        lines = records(walk).splitlines(keepends=True)
        running.stdin.write(b"".join(lines[:180]))
        running.stdin.flush()
        seen = [json.loads(running.stdout.readline()) for _ in range(7)]
        assert not running.poll()
        assert seen[0]["started"] is False
        running.stdin.close()
        rest = running.stdout.read()
    assert running.returncode == 0
    assert b'"started": true' in rest or seen[-1]["started"]


@pytest.mark.slow
def test_messages_on_a_full_disk_do_not_end_navigation(walk: OnlineLog, site: Path) -> None:
    """A standard error that takes nothing: the states are those without it."""
    given = records(walk) + b"no record\n"
    command = [SCRIPT, "navigate", "-", "--site", site, "--estimator", "ekf", "--keep-going"]
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            command, input=given, stdout=subprocess.PIPE, stderr=full, check=False
        )
    assert done.returncode == 0
    expected, _ = answered(site, records(walk))
    assert len(done.stdout.splitlines()) == len(expected)


@pytest.mark.slow
def test_a_reader_that_leaves_is_no_error(walk: OnlineLog, tmp_path: Path) -> None:
    write_log(as_log(walk), tmp_path / "log")
    command = f"{SCRIPT} replay {tmp_path / 'log'} | head -n 1"
    done = subprocess.run(
        ["bash", "-o", "pipefail", "-c", command], capture_output=True, env=os.environ, check=False
    )
    assert done.returncode == 0
    assert done.stderr == b""
    assert list(json.loads(done.stdout)) == ["imu"]


def test_a_stream_needs_a_site_and_takes_no_options_of_a_log(
    capfd: pytest.CaptureFixture[str], site: Path
) -> None:
    for options, sentence in (
        (("navigate", "-"), "navigate - requires the site's file"),
        (("navigate", "-", "--site", site, "-o", "out"), "--output, --start, --end"),
        (("navigate", "-", "--site", "nowhere.yaml"), "nowhere.yaml: there is no such file"),
    ):
        with pytest.raises(AssertionError):
            run_command(*options)  # it exits with 2
        assert sentence in capfd.readouterr().err
