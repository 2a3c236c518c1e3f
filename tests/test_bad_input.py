"""What once broke the program is told in one sentence, with nothing left and nothing lost."""

import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
import yaml
from conftest import Refuse, Worked

from magfusion.cli import main
from magfusion.files.atomic import whole_directory, whole_file
from magfusion.files.stream import MAX_RECORD

MAGFUSION = [sys.executable, "-m", "magfusion"]
Change = Callable[[dict[str, Any]], object]


def _beacon(**values: object) -> Change:
    return lambda site: site["beacons"][0].update(values)


def _coil(**values: object) -> Change:
    return lambda site: site["beacons"][0]["coils"][0].update(values)


BEYOND: dict[str, Change] = {
    "coils[0].radius_m": _coil(radius_m=1e300),
    "coils[0].radius_m ": _coil(radius_m=1e-300),
    "coils[0].length_m": _coil(length_m=1e300),
    "coils[0].moment_a_m2": _coil(moment_a_m2=[1e300, 0.0, 0.0]),
    "coils[0].moment_a_m2 ": _coil(moment_a_m2=[1e-300, 0.0, 0.0]),
    "sigma.position_m": _beacon(sigma={"position_m": 1e9}),
    "sigma.rotation_deg": _beacon(sigma={"rotation_deg": 1e9}),
    "sigma.log_moment": _beacon(sigma={"log_moment": 1e9}),
    "frequency_hz": _beacon(frequency_hz=1e-9),
    "position_m": _beacon(position_m=[1e300, 0.0, 0.0]),
}


@pytest.mark.parametrize("key", BEYOND)
def test_a_value_beyond_what_is_built_is_refused_by_its_key(
    key: str, worked: Worked, tmp_path: Path, refuse: Refuse
) -> None:
    site = yaml.safe_load((worked.log / "site.yaml").read_text())
    BEYOND[key](site)
    path = tmp_path / "site.yaml"
    path.write_text(yaml.safe_dump(site))
    sentence = refuse("fix", worked.log, "--site", path, "-o", tmp_path / "run")
    assert f"{path}: beacons[0].{key.strip()}: found" in sentence


# Standard streams -----------------------------------------------------------------------------


def _navigate(worked: Worked, given: bytes, form: str = "json", *more: str) -> tuple[int, str]:
    site = str(worked.log / "site.yaml")
    command = [*MAGFUSION, "navigate", "-", "--site", site, "--format", form, *more]
    done = subprocess.run(command, input=given, capture_output=True, check=False)
    return done.returncode, done.stderr.decode()


_IMU = {"imu": {"time": [0.0], "gyro": [[0.0, 0.0, 0.0]], "accel": [[0.0, 0.0, 9.8]]}}
_PACKED = msgpack.packb(_IMU)
STREAMS = {
    "a time before all times": (
        "json",
        b'{"imu": {"time": -1e308, "gyro": [0,0,0], "accel": [0,0,9.8]}}\n',
        "line 1.*time",
    ),
    "a line without end": ("json", b"0" * (MAX_RECORD + 10), "line 1: is larger than 16 MiB"),
    "a record cut inside": (
        "msgpack",
        _PACKED + _PACKED[:20],
        "record 2: breaks off after 20 bytes",
    ),
    "a header of 4 GiB": (
        "msgpack",
        b"\xc6\xff\xff\xff\xff" + bytes(9),
        "record 1: (is no Mess|breaks off)",
    ),
    "a list of 4 G": (
        "msgpack",
        b"\xdd\xff\xff\xff\xff" + bytes(9),
        "record 1: (is no Mess|breaks off)",
    ),
    "a deep nest": ("msgpack", b"\x91" * 5000, "record 1: is no Mess"),
    "deep JSON": ("json", b"[" * 5000 + b"\n", "line 1:"),
}


@pytest.mark.slow
@pytest.mark.parametrize("mistake", STREAMS)
def test_a_stream_that_is_none_is_refused_by_its_place(mistake: str, worked: Worked) -> None:
    form, given, pattern = STREAMS[mistake]
    status, findings = _navigate(worked, given, form)
    assert status == 2
    assert findings.count("\n") == 1
    assert re.search(pattern, findings), findings


@pytest.mark.slow
def test_a_record_that_is_too_large_is_passed_over_where_that_is_asked(worked: Worked) -> None:
    given = b"0" * (MAX_RECORD + 10) + b"\n" + json.dumps(_IMU).encode() + b"\n"
    status, findings = _navigate(worked, given, "json", "--keep-going")
    assert status == 0
    assert "line 1: is larger than" in findings
    assert "1 records were skipped" in findings


@pytest.mark.slow
@pytest.mark.parametrize(
    ("line", "findings"),
    [
        ("replay LOG >&-", "standard output: is closed"),
        ("navigate - --site LOG/site.yaml <&-", "standard input: is closed"),
        ("replay LOG >/dev/full", "No space left on device"),
        ("--version >/dev/full", "No space left on device"),
    ],
)
def test_a_standard_stream_that_is_closed_or_full_is_told(
    line: str, findings: str, worked: Worked
) -> None:
    shell = f"exec {sys.executable} -m magfusion {line.replace('LOG', str(worked.log))}"
    done = subprocess.run(["sh", "-c", shell], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert findings in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("line", "findings"),
    [
        ("fix LOG -o OUT --start 1e300", "holds no row from 1e.300 s"),
        ("fix LOG -o OUT --mains-hz 0.01", "--mains-hz must be 0 for none, or at least 10 Hz"),
        ("simulate -o OUT --box 0,1e300,0,1,0,1", "--box .*within 100000 m of the origin"),
        ("coverage LOG/site.yaml -o OUT --box 0,1e-9,0,1,0,1", "--box .* 0.001 m apart"),
    ],
)
def test_an_option_beyond_what_is_is_told(
    line: str, findings: str, worked: Worked, tmp_path: Path, refuse: Refuse
) -> None:
    names = {"LOG": str(worked.log), "OUT": str(tmp_path / "run")}
    for name, path in names.items():
        line = line.replace(name, path)
    assert re.search(findings, refuse(*line.split()))


# Files ----------------------------------------------------------------------------------------


def test_a_loop_of_links_is_no_output(worked: Worked, tmp_path: Path, refuse: Refuse) -> None:
    (tmp_path / "a").symlink_to(tmp_path / "b")
    (tmp_path / "b").symlink_to(tmp_path / "a")
    assert "leads nowhere" in refuse("fix", worked.log, "-o", tmp_path / "a")
    assert "no such file" in refuse("fix", tmp_path / "a", "-o", tmp_path / "run")


@pytest.mark.slow
@pytest.mark.parametrize("blocks", [12, 60])
def test_a_full_disk_is_told_with_the_file_and_leaves_nothing(
    blocks: int, worked: Worked, tmp_path: Path
) -> None:
    """The recording, too, which rerun would leave out with a word of its own."""
    # The interpreter would write its compiled modules in part, and fail to read them afterwards.
    command = f"{sys.executable} -B -m magfusion fix {worked.log} -o {tmp_path}/run"
    shell = f"ulimit -f {blocks}; exec {command}"
    done = subprocess.run(["bash", "-c", shell], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith(f"magfusion: {tmp_path / 'run'}/")
    assert "free some space" in done.stderr
    assert done.stderr.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_what_a_killed_run_left_is_removed_and_what_it_moved_away_given_back(
    tmp_path: Path,
) -> None:
    child = os.fork()
    if not child:  # a run that is killed at the worst moments
        with whole_directory(tmp_path / "run", lambda _: True) as built:
            (built / "part").write_text("unfinished")
            (built.with_name(built.name.replace("unfinished", "former"))).mkdir()
            with whole_file(tmp_path / "state") as unfinished:
                unfinished.write_text("unfinished")
                os.kill(os.getpid(), signal.SIGKILL)
    os.waitpid(child, 0)
    (tmp_path / ".run.2024").write_text("a user's")
    assert len(list(tmp_path.iterdir())) == 4
    with whole_directory(tmp_path / "run", lambda _: True) as built:
        assert (tmp_path / "run").is_dir()  # given back
        (built / "whole").write_text("")
    with whole_file(tmp_path / "state") as unfinished:
        unfinished.write_text("whole")
    assert {p.name for p in tmp_path.iterdir()} == {"run", "state", ".run.2024"}


# What was not foreseen ------------------------------------------------------------------------


def test_what_was_not_foreseen_is_one_sentence_with_a_way_to_report_it(
    worked: Worked, tmp_path: Path, refuse: Refuse, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object, **__: object) -> None:
        raise np.linalg.LinAlgError("SVD did not\nconverge")

    monkeypatch.setattr("magfusion.jobs.fix.run_fix", broken)
    sentence = refuse("fix", worked.log, "-o", tmp_path / "run", status=1)
    assert "LinAlgError: SVD did not converge; test_bad_input.py, line" in sentence
    assert "report it" in sentence
    assert "--debug" in sentence


@pytest.mark.parametrize("place", [0, -1])
def test_debug_shows_where_an_error_came_from(
    place: int, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    arguments = ["fix", str(tmp_path / "none")]
    arguments.insert(place, "--debug")
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 2
    err = capfd.readouterr().err
    assert "Traceback" in err
    assert err.splitlines()[-1].startswith("magfusion: ")


@pytest.mark.slow
def test_sigterm_ends_with_143_and_tells_how_to_go_on(worked: Worked) -> None:
    site = str(worked.log / "site.yaml")
    command = [*MAGFUSION, "navigate", "-", "--site", site]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as run:
        assert run.stdin is not None
        assert run.stdout is not None
        run.stdin.write(json.dumps(_IMU).encode() + b"\n")
        run.stdin.flush()
        assert run.stdout.readline().startswith(b'{"time": 0.0')  # it is at work
        run.send_signal(signal.SIGTERM)
        _, findings = run.communicate()
    assert run.returncode == 143
    assert findings.startswith(b"magfusion: terminated")
    assert b"--resume" in findings
    assert findings.count(b"\n") == 1


def test_an_interrupt_while_the_command_is_imported_shows_no_traceback() -> None:
    program = """
import sys
class Interrupt:
    def find_spec(self, name, *_):
        if name == "magfusion.cli":
            raise KeyboardInterrupt
sys.meta_path.insert(0, Interrupt())
from magfusion.__main__ import run
run()
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, check=False)
    assert done.returncode == 130
    assert done.stderr == b""


def test_a_refused_drift_leaves_nothing(tmp_path: Path, refuse: Refuse) -> None:
    assert "--workers" in refuse("drift", "-o", tmp_path / "run", "--hours", 0.1, "--workers", 0)
