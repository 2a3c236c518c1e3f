"""Every mistake on the command line is told in one sentence and leaves nothing behind."""

import errno
import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from conftest import Refuse, Worked, change_table, run_command

from magfusion.cli import main

JOBS = ("smooth", "fix", "demodulate")


def _change_site(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    site = yaml.safe_load(path.read_text())
    change(site)
    path.write_text(yaml.safe_dump(site))


def _in_nanotesla(columns: dict[str, Any]) -> None:
    for name in ("field_x", "field_y", "field_z"):
        columns[name] = [1e9 * value for value in columns[name]]


# Refusals of logs -----------------------------------------------------------------------------

BAD_TABLES = {
    "a missing column": ("imu", lambda c: c.pop("gyro_y"), "column gyro_y is missing.*add"),
    "times that go back": (
        "imu",
        lambda c: c["time_ns"].__setitem__(7, c["time_ns"][5]),
        r"time_ns, row 7.*sort the rows",
    ),
    "a time twice": (
        "magnetometer",
        lambda c: c["time_ns"].__setitem__(slice(8, 2000), [c["time_ns"][7]] * 1992),
        r"1992 of \d+ rows have the stamp of another.*--rate-hz magnetometer",
    ),
    "a field in nT": ("magnetometer", _in_nanotesla, "(tesla| T)"),
}


@pytest.mark.parametrize("job", JOBS)
@pytest.mark.parametrize("mistake", BAD_TABLES)
def test_a_bad_table_is_refused_by_file_place_and_remedy(
    job: str, mistake: str, log: Path, tmp_path: Path, refuse: Refuse
) -> None:
    stem, change, pattern = BAD_TABLES[mistake]
    path = log / f"{stem}.parquet"
    change_table(path, change)
    sentence = refuse(job, log, "-o", tmp_path / "run")
    assert str(path) in sentence
    assert re.search(pattern, sentence)


@pytest.mark.parametrize("job", JOBS)
@pytest.mark.parametrize("keep", [0, 4, 5000, -1])
def test_a_truncated_or_empty_table_is_refused_by_name(
    job: str, keep: int, log: Path, tmp_path: Path, refuse: Refuse
) -> None:
    path = log / "magnetometer.parquet"
    path.write_bytes(path.read_bytes()[:keep])
    assert str(path) in refuse(job, log, "-o", tmp_path / "run")


@pytest.mark.parametrize("job", JOBS)
@pytest.mark.parametrize("missing", ["", "magnetometer.parquet"])
def test_a_missing_file_is_refused_by_name(
    job: str, missing: str, log: Path, tmp_path: Path, refuse: Refuse
) -> None:
    if missing:
        (log / missing).unlink()
    else:
        shutil.rmtree(log)
    sentence = refuse(job, log, "-o", tmp_path / "run")
    assert str(log) in sentence
    assert missing in sentence


def test_a_missing_inertial_stream_is_refused_where_it_is_needed(
    log: Path, tmp_path: Path, refuse: Refuse
) -> None:
    (log / "imu.parquet").unlink()
    sentence = refuse("smooth", log, "-o", tmp_path / "run")
    assert str(log) in sentence
    assert "inertial samples (imu.parquet)" in sentence
    assert "motion_prior" in sentence


@pytest.mark.parametrize("job", JOBS)
def test_an_import_without_site_asks_for_one(
    job: str, log: Path, tmp_path: Path, refuse: Refuse
) -> None:
    (log / "site.yaml").unlink()
    assert "--site" in refuse(job, log, "-o", tmp_path / "run")


@pytest.mark.parametrize("job", JOBS)
def test_an_import_without_magnetometer_is_refused_as_input(
    job: str, worked: Worked, tmp_path: Path, refuse: Refuse
) -> None:
    folder = tmp_path / "euroc" / "mav0" / "imu0"
    folder.mkdir(parents=True)
    lines = [f"{i * 5_000_000},0.0,0.0,0.0,0.0,0.0,9.81" for i in range(100)]
    (folder / "data.csv").write_text("\n".join(["#t,wx,wy,wz,ax,ay,az", *lines]) + "\n")
    site = worked.log / "site.yaml"
    sentence = refuse(job, tmp_path / "euroc", "--site", site, "-o", tmp_path / "run")
    assert "record the magnetometer" in sentence


@pytest.mark.parametrize("job", ["smooth", "fix"])
def test_a_beacon_unknown_to_the_site_is_refused(
    job: str, worked: Worked, tmp_path: Path, refuse: Refuse
) -> None:
    log = shutil.copytree(worked.phasors, tmp_path / "log")
    change_table(
        log / "fields.parquet",
        lambda c: c.update(beacon=[name.replace("A", "E") for name in c["beacon"]]),
    )
    sentence = refuse(job, log, "-o", tmp_path / "run")
    assert str(log) in sentence
    assert "beacon E tone 0" in sentence
    assert "site" in sentence


def test_phasors_cannot_be_demodulated_again(
    worked: Worked, tmp_path: Path, refuse: Refuse
) -> None:
    sentence = refuse("demodulate", worked.phasors, "-o", tmp_path / "run")
    assert "give the raw log" in sentence


# Refusals of sites ----------------------------------------------------------------------------

BAD_SITES: dict[str, tuple[Callable[[dict[str, Any]], object], str]] = {
    "a negative frequency": (
        lambda s: s["beacons"][0].update(frequency_hz=-20.0),
        r"beacons\[0\].frequency_hz.*-20",
    ),
    "an unknown key": (lambda s: s["world"].update(gravity=9.81), "world.gravity.*not a known key"),
    "a shared frequency": (
        lambda s: s["beacons"][1].update(frequency_hz=20.0),
        "beacons A and B both transmit at 20 Hz",
    ),
    "a tone beyond the sampling": (
        lambda s: s["beacons"][1].update(frequency_hz=390.0),
        "too slow for the tone at 390 Hz",
    ),
}


@pytest.mark.parametrize("job", JOBS)
@pytest.mark.parametrize("mistake", BAD_SITES)
def test_a_bad_site_is_refused_by_file_key_and_remedy(
    job: str, mistake: str, log: Path, tmp_path: Path, refuse: Refuse
) -> None:
    change, pattern = BAD_SITES[mistake]
    _change_site(log / "site.yaml", change)
    sentence = refuse(job, log, "-o", tmp_path / "run")
    assert str(log) in sentence
    assert re.search(pattern, sentence)


@pytest.mark.parametrize("job", ["fix", "demodulate", "survey"])
def test_no_beacon_is_no_site_for_what_hears_beacons(
    job: str, log: Path, tmp_path: Path, refuse: Refuse
) -> None:
    _change_site(log / "site.yaml", lambda s: s.update(beacons=[]))
    sentence = refuse(job, log, "-o", tmp_path / "run")
    assert re.search("beacons.*at least one beacon", sentence)


HOSTILE_YAML = {
    "code": "!!python/object/apply:os.system ['touch owned']",
    "a bomb": "a: &a [x, x]\nb: &b [*a, *a]\nc: [*b, *b]",
    "an open bracket": "beacons: [",
    "a list": "- 1\n- 2",
    "nothing": "",
    "a control character": "a: \x00",
    "depth": "[" * 5000,
}


@pytest.mark.parametrize("mistake", HOSTILE_YAML)
def test_hostile_yaml_is_refused(
    mistake: str, worked: Worked, tmp_path: Path, refuse: Refuse
) -> None:
    site = tmp_path / "site.yaml"
    site.write_text(HOSTILE_YAML[mistake])
    assert str(site) in refuse("fix", worked.log, "--site", site, "-o", tmp_path / "run")
    assert str(site) in refuse("simulate", "--site", site, "-o", tmp_path / "made")


# Refusals of options --------------------------------------------------------------------------

BAD_OPTIONS = [
    ("smooth LOG -o OUT --window -1", "--window.*between 0.2 s.* and 60 s; got -1"),
    ("smooth LOG -o OUT --window nan", "--window.*got nan"),
    ("smooth LOG -o OUT --window x", "--window.*number.*see magfusion smooth --help"),
    ("fix LOG -o OUT --window 0.02", "--window.*tones cannot be separated"),
    ("fix LOG -o OUT --step 0", "--step.*got 0"),
    ("fix LOG -o OUT --step 0.0001", "--step.*twentieth of the window, 0.02 s.*got 0.0001"),
    ("fix LOG -o OUT --window 30", "no window of 30 s is usable"),
    ("demodulate LOG -o OUT --mains-hz -50", "--mains-hz"),
    ("smooth LOG -o OUT --start nan", "start: found nan"),
    ("smooth LOG -o OUT --start 5 --end 3", "--start must come before --end"),
    ("smooth LOG -o OUT --start 500", "holds no row from 500.0 s"),
    ("fix LOG -o OUT --start 2 --end 2.1", "no window of 0.4 s is usable"),
    ("smooth LOG -o OUT --estimate foo", "foo is not a calibration group; choose from beacons"),
    ("smooth LOG -o OUT --estimate ,", "nothing is not a calibration group"),
    ("smooth LOG -o OUT --coupling foo", "'tight', 'loose'"),
    ("smooth LOG -o OUT --robust foo", "'none', 'huber', 'cauchy'"),
    ("smooth LOG -o OUT --rate foo", "'field', 'imu'"),
    ("smooth LOG -o OUT --topics foo", "--topics 'foo': write role=name"),
    ("smooth LOG -o OUT --site LOG", "is a directory; give the path of a YAML file"),
    ("smooth LOG -o OUT --site NONE", "NONE: there is no such file"),
    ("simulate", "Missing option '--output'"),
    ("smooth", "Missing argument"),
    ("fix LOG OUT -o OUT", "unexpected extra argument"),
    ("smooth LOG OUT -o OUT", "there is no such file or directory; give the path of a log"),
    ("demodulate LOG -o OUT --frobnicate", "No such option: --frobnicate"),
    ("frobnicate", "No such command 'frobnicate'"),
    ("simulate -o OUT --duration nan", "--duration.*got nan"),
    ("simulate -o OUT --duration 1e9", "--duration must lie between 1 and"),
    ("simulate -o OUT --seed -1", "--seed must not be negative"),
    ("simulate -o OUT --seed 1.5", "--seed.*integer"),
    ("simulate -o OUT --motion foo", "'walk', 'turn', 'static'"),
    ("simulate -o OUT --box 1,2", "--box '1,2': give six numbers"),
    ("simulate -o OUT --box 1,2,1,2,nan,3", "each lower limit must be below its upper"),
    ("simulate -o OUT --box 2,1,1,2,1,3", "each lower limit must be below its upper"),
    ("simulate -o OUT --site NONE", "NONE: there is no such file"),
    ("demo -o OUT --duration 1", "--duration must lie between 5 and 3600 s; got 1"),
    ("demo -o OUT --seed -1", "--seed must not be negative"),
    ("view NONE", "NONE: has no recording; run magfusion smooth first"),
    ("view LOG", "has no recording"),
    ("view LOG/site.yaml", "not a recording"),
    ("evaluate NONE LOG", "NONE: there is no such file"),
    ("evaluate LOG LOG", "has no trajectory.parquet"),
    ("evaluate LOG/site.yaml LOG", "line 1.*write eight numbers"),
    ("evaluate LOG/imu.parquet LOG", "columns position_x, .* are missing"),
    ("evaluate LOG/truth.parquet NONE", "NONE: there is no such file"),
]


@pytest.mark.parametrize(("line", "pattern"), BAD_OPTIONS)
def test_a_mistake_on_the_command_line_is_told_in_one_sentence(
    line: str, pattern: str, log: Path, tmp_path: Path, refuse: Refuse
) -> None:
    places = {"LOG": log, "OUT": tmp_path / "out", "NONE": tmp_path / "NONE"}
    for name, path in places.items():
        line = line.replace(name, str(path))
    message = refuse(*line.split())
    assert re.search(pattern, message)
    assert not re.search("Input should|Value error", message)  # pydantic's words


# Refusals of output ---------------------------------------------------------------------------

WRITERS = ("smooth LOG", "fix LOG", "demodulate LOG", "simulate --duration 5", "demo --duration 5")


@pytest.mark.parametrize("writer", WRITERS)
def test_output_in_the_way_is_kept(writer: str, log: Path, tmp_path: Path, refuse: Refuse) -> None:
    command = writer.replace("LOG", str(log)).split()
    (tmp_path / "file").write_text("a user's")
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "report.json").write_text('{"job": "smooth"}')
    (tmp_path / "thesis" / "chapter.tex").write_text("a user's")
    assert "is a file" in refuse(*command, "-o", tmp_path / "file")
    assert "cannot be written" in refuse(*command, "-o", tmp_path / "file" / "below")
    assert "holds other files" in refuse(*command, "-o", tmp_path / "thesis")


@pytest.mark.parametrize("writer", ["smooth LOG", "fix LOG", "demodulate LOG"])
def test_a_result_never_replaces_the_log_it_came_from(
    writer: str, log: Path, refuse: Refuse
) -> None:
    command = writer.replace("LOG", str(log)).split()
    assert "holds other files" in refuse(*command, "-o", log)


def test_an_earlier_result_makes_way_but_not_what_a_user_put_into_it(
    worked: Worked, tmp_path: Path, refuse: Refuse
) -> None:
    run = shutil.copytree(worked.fixes, tmp_path / "run")
    run_command("smooth", worked.log, "-o", run, "--coupling", "loose")
    assert not (run / "fixes.parquet").exists()
    (run / "notes.txt").write_text("a user's")
    assert "holds other files" in refuse("fix", worked.log, "-o", run)


def test_a_full_disk_is_told_in_one_sentence(
    worked: Worked, tmp_path: Path, refuse: Refuse, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(tmp_path / "x"))

    monkeypatch.setattr("magfusion.jobs.fix.write_tum", full)
    sentence = refuse("fix", worked.log, "-o", tmp_path / "deep" / "run")
    assert "No space left on device" in sentence
    assert "free some space" in sentence


def test_an_interrupt_ends_with_130_and_no_word(
    worked: Worked,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("magfusion.jobs.fix.run_fix", interrupted)
    with pytest.raises(SystemExit) as ended:
        main(["fix", str(worked.log), "-o", str(tmp_path / "run")])
    assert ended.value.code == 130
    assert capfd.readouterr() == ("", "")
    assert not list(tmp_path.iterdir())
