"""Slips of an import: each is told by its cause, all at once, and nothing is left behind."""

import re
import shlex
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from conftest import Refuse, run_command
from example_bag import FIELD, SENSORS, field_message, write_bag

from magfusion.cli import main
from magfusion.errors import InputError
from magfusion.files.fields import refuse_unsigned
from magfusion.files.log import read_log

ROWS = 400
_rng = np.random.default_rng(5)
TIME = 5.0 * np.arange(ROWS)  # ms
RATES = 20.0 * _rng.standard_normal((ROWS, 3))  # deg/s
FORCES = np.array([0.0, 0.0, 1.0]) + 0.01 * _rng.standard_normal((ROWS, 3))  # g
FIELDS = np.array([2e4, 0.0, -4e4]) + 1e3 * _rng.standard_normal((ROWS, 3))  # nT
IMU_HEAD = "t_ms,GyrX_dps,GyrY_dps,GyrZ_dps,AccX_g,AccY_g,AccZ_g"
FIELD_HEAD = "t_ms,Bx_nT,By_nT,Bz_nT"


def rows_of(*columns: np.ndarray) -> list[list[str]]:
    return [[f"{v:.6f}" for v in row] for row in np.column_stack(columns)]


def write(path: Path, head: str, rows: list[list[str]]) -> None:
    path.write_text("\n".join([head, *(",".join(row) for row in rows)]) + "\n")


@pytest.fixture
def tables(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a directory with two tables that say all of themselves."""
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "imu.csv", IMU_HEAD, rows_of(TIME, RATES, FORCES))
    write(tmp_path / "mag.csv", FIELD_HEAD, rows_of(TIME, FIELDS))
    return tmp_path


def reported(capfd: pytest.CaptureFixture[str], line: str) -> str:
    """Return what an import that is refused says; it must leave nothing behind."""
    before = sorted(Path().rglob("*"))
    with pytest.raises(SystemExit) as ended:
        main(["import", *shlex.split(line), "-o", "log"])
    out, err = capfd.readouterr()
    assert (ended.value.code, out) == (2, ""), err
    assert err.startswith("magfusion: ")
    assert "Traceback" not in err
    assert sorted(Path().rglob("*")) == before
    return err


# What is typed --------------------------------------------------------------------------------

BOTH = "imu.csv mag.csv"
SLIPS = [
    ("", "no recording given"),
    ("nowhere.csv mag.csv", "nowhere.csv: there is no such file"),
    ("--imu imu.csv --magnetometer imu.csv", "imu.csv: no column is found for magnetometer.field"),
    (f"{BOTH} imu.csv", "imu.csv and imu.csv both hold the imu"),
    (f"{BOTH} --map imu.gyro", "write TABLE.COLUMN=NAME.unit., as 'imu.gyro_x=GyrX"),
    (f"{BOTH} --map 'gyr.x=GyrX_dps[deg/s]'", "gyr is no table; write one of imu, gyro, acc"),
    (f"{BOTH} --map 'imu.gyr_x=GyrX_dps[deg/s]'", "gyr_x is no column of imu; .*gyro_x"),
    (f"{BOTH} --map 'imu.gyro_x=GyroX[deg/s]'", "no column GyroX .*found t_ms, GyrX_dps.*is it G"),
    (f"{BOTH} --map 'imu.gyro_x=GyrX_dps[deg]'", "'deg' is no unit of angular rate; .*rad/s, mr"),
    (f"{BOTH} --map 'imu.accel_z=AccZ_g[T]'", "'T' is no unit of specific force; .*mg, ug"),
    (f"{BOTH} --map 'imu.time=t_ms[msk]'", "'msk' is no unit of time; .*s, ms, us, ns, min, h, is"),
    (f"{BOTH} --map 'imu.time=t_ms[0*ms]'", "'0.ms' is no unit of time"),
    (f"{BOTH} --map 'imu.time=t_ms[iso]'", "found '0.000000', which is no time in iso"),
    (f"{BOTH} --map 'imu.gyro=GyrX_dps,GyrY_dps[deg/s]'", "gyro takes 3 names, .*found 2"),
    (f"{BOTH} --map 'truth.time=t[s]'", "no file is given for truth; give --truth FILE"),
    (f"{BOTH} --map 'imu.time=t_ms[ms]' --map 'imu.time=t_ms[s]'", "imu.time is given twice"),
    ("imu.csv --truth mag.csv --map 'truth.quaternion=a,b,c,d'", "order of the quaternion.*wxyz"),
    (f"{BOTH} --map 'imu.time=t_ms[ms]' --rate-hz imu=200", "imu.time and --rate-hz imu are given"),
    (f"{BOTH} --rate-hz imu=0", "--rate-hz 'imu=0': write TABLE=HZ"),
    (f"{BOTH} --rate-hz gyr=200", "--rate-hz 'gyr=200': write TABLE=HZ with a table of imu"),
    (f"{BOTH} --delimiter semi", "--delimiter 'semi': write one character, or one of comma"),
    (f"{BOTH} --delimiter ';'", "imu.csv: holds no table of numbers .first line: 't_ms,Gyr"),
    (f"{BOTH} --epoch noon", "--epoch 'noon': write a stamp in ns, or first"),
    (f"{BOTH} --site nosite.yaml", "nosite.yaml: there is no such file"),
    (f"{BOTH} --map-file nomap.yaml", "nomap.yaml: there is no such file"),
    (f"{BOTH} --map 'imu.time=t_ms[s]'", "rows of imu are 5 s apart .*probably in another unit"),
    (
        f"{BOTH} --map 'imu.time=t_ms[ns]'",
        "rows of imu are 5e-09 s apart .mean., which is too fast",
    ),
    (f"{BOTH} --map 'imu.gyro=GyrX_dps,GyrY_dps,GyrZ_dps[10*rad/s]'", "imu.csv as imu.*deg/s"),
    (f"{BOTH} --map 'magnetometer.field=Bx_nT,By_nT,Bz_nT[uT]'", "mag.csv as magnetometer.*unit"),
    (f"{BOTH} --rate-hz 'imu=200@500'", "imu and magnetometer do not overlap.*one clock"),
]


@pytest.mark.parametrize(("line", "pattern"), SLIPS)
def test_a_slip_is_told_by_its_cause(
    line: str, pattern: str, tables: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert tables.is_dir()
    assert re.search(pattern, reported(capfd, line), re.S)


# What is in the file --------------------------------------------------------------------------


def _cell(row: int, column: int, text: str) -> Callable[[list[list[str]]], None]:
    def change(rows: list[list[str]]) -> None:
        rows[row][column] = text

    return change


def _later(rows: list[list[str]], begin: int, by: float) -> None:
    for row in rows[begin:]:
        row[0] = f"{float(row[0]) + by:.6f}"


SPOILED: list[tuple[Callable[[list[list[str]]], object], str]] = [
    (_cell(7, 1, "ERR"), r"column Bx_nT, row 7 of the data .*found 'ERR'; write a number, or nan"),
    (_cell(7, 0, "noon"), r"column t_ms: found 'noon', which is no time in ms"),
    (lambda rows: _later(rows, 200, 4e6), r"time, row 200 .*4000\S* s after .*the clock jumped"),
    (
        lambda rows: _later(rows, 200, -50.0),
        r"row 200 .*goes back by 0\.05 s: the clock was set ba",
    ),
    (lambda rows: _later(rows, 200, -5e3), r"row 200 .*goes back by .*a counter wrapped around"),
    (
        lambda rows: [r.__setitem__(0, "") for r in rows],
        "none of 400 rows can be used .400 without a time",
    ),
    (lambda rows: [r.__setitem__(2, "nan") for r in rows[::3] + rows[1::3]], "lack a number of m"),
    (lambda rows: [r.__setitem__(0, f"{float(r[0]) // 50 * 50}") for r in rows], "coarser than"),
    (lambda rows: rows.clear(), "holds no table of numbers"),
]


@pytest.mark.parametrize(("change", "pattern"), SPOILED)
def test_a_spoiled_table_is_refused_by_column_row_and_cause(
    change: Callable[[list[list[str]]], object],
    pattern: str,
    tables: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    rows = rows_of(TIME, FIELDS)
    change(rows)
    write(tables / "mag.csv", FIELD_HEAD, rows)
    sentence = reported(capfd, BOTH)
    assert "mag.csv" in sentence
    assert re.search(pattern, sentence)
    assert sentence.count("\n") == 1


def test_a_column_that_is_there_twice_is_named_by_its_place(
    tables: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    write(tables / "mag.csv", "t_ms,B,B,B", rows_of(TIME, FIELDS))
    sentence = reported(capfd, f"imu.csv --magnetometer mag.csv --map '{_field('B,B,B')}'")
    assert "column B is there 3 times" in sentence
    assert "one of #1, #2, #3" in sentence
    line = f"import imu.csv --magnetometer mag.csv --map '{_field('#1,#2,#3')}' -o log"
    with pytest.raises(SystemExit) as ended:
        main(shlex.split(line))
    assert not ended.value.code


def _field(names: str) -> str:
    return f"magnetometer.field={names}[nT]"


def test_all_problems_are_told_at_once_with_what_would_decide_them(
    tables: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    write(tables / "imu.csv", "time,wx,wy,wz,ax,ay,az", rows_of(TIME, RATES, FORCES))
    write(tables / "mag.csv", "time,Bx,By,Bz", rows_of(1e3 * TIME, FIELDS))
    findings = reported(capfd, BOTH)
    assert "for 5 problems" in findings
    proposed = [line.strip(" \\") for line in findings.splitlines() if line.startswith("  --map")]
    assert proposed == [
        "--map 'imu.time=time[ms]'",
        "--map 'imu.gyro=wx,wy,wz[deg/s]'",
        "--map 'imu.accel=ax,ay,az[g]'",
        "--map 'magnetometer.time=time[us]'",
        "--map 'magnetometer.field=Bx,By,Bz[nT]'",
    ]
    with pytest.raises(SystemExit) as ended:  # as it can be pasted
        main(shlex.split(f"import {BOTH} -o log {' '.join(proposed)}"))
    assert not ended.value.code


def test_what_is_in_the_way_is_kept(tables: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tables / "log").mkdir()
    (tables / "log" / "notes.txt").write_text("mine")
    assert "holds other files" in reported(capfd, BOTH)
    (tables / "log" / "notes.txt").unlink()
    for _ in range(2):  # its own log is replaced
        with pytest.raises(SystemExit) as ended:
            main(["import", "imu.csv", "mag.csv", "-o", "log"])
        assert not ended.value.code
    capfd.readouterr()
    assert "is a log of magfusion already" in reported(capfd, "log")


def test_lengths_that_differ_and_a_missing_package(
    tables: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with h5py.File(tables / "all.h5", "w") as file:
        file["t"], file["B"] = TIME, FIELDS[:-1]
    maps = "--map 'magnetometer.time=t[ms]' --map 'magnetometer.field=B[nT]'"
    sentence = reported(capfd, f"imu.csv --magnetometer all.h5 {maps}")
    assert re.search("t has 400 rows, B:. has 399 rows", sentence)
    monkeypatch.setitem(sys.modules, "h5py", None)
    assert "pip install 'magfusion[import]'" in reported(
        capfd, f"imu.csv --magnetometer all.h5 {maps}"
    )


@pytest.mark.parametrize(
    ("maps", "pattern"),
    [
        ("", r"several topics may be magnetometer: /imu/mag, /mag2.*--map magnetometer=/imu/mag"),
        ("--map imu=/gyro", "has no topic /gyro for imu .found /imu/data, /imu/mag, /mag2"),
        ("--map imu=/mag2", "topic /mag2 is of sensor_msgs/msg/MagneticField, which is none of"),
        ("--map 'imu=/imu/data[deg/s]'", "messages of sensor_msgs/msg/Imu are in SI"),
        ("--map 'magnetometer=/mag2[deg]'", r"write one of T, mT, uT, nT"),
        ("--map 'imu.gyro_x=a[deg/s]'", "a bag's columns are known; name the topic"),
        ("--map magnetometer=/mag2 --epoch /pps", "has no message of /pps for --epoch"),
    ],
)
def test_a_bag_of_which_something_is_open(
    maps: str,
    pattern: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    write_bag(tmp_path / "run", SENSORS | {"/mag2": (FIELD, field_message)})
    assert re.search(pattern, reported(capfd, f"run {maps}"), re.S)


@pytest.mark.parametrize(("signs", "refused"), [((1.0,), True), ((1.0, -1.0), False)])
def test_amplitudes_of_three_axes_are_no_parts_in_phase(
    tables: Path, capfd: pytest.CaptureFixture[str], signs: tuple[float, ...], refused: bool
) -> None:
    rows = [
        [f"{0.4 * k}", beacon, "0", axis, f"{(20.0 + k) * signs[k % len(signs)]}", "0.5", "0.4"]
        for k in range(12)
        for beacon in "AB"
        for axis in "xyz"
    ]
    write(tables / "f.csv", "t_s,beacon,tone,axis,value [nT],sigma [nT],window [s]", rows)
    if refused:
        text = reported(capfd, "imu.csv --fields f.csv")
        assert "so they are amplitudes, which are for receivers of one axis; give re and im" in text
        return
    run_command("import", "imu.csv", "--fields", "f.csv", "-o", "log")
    log = read_log(Path("log"))
    assert log.fields is not None
    absolute = np.abs(log.fields.phasor_sensor.real).astype(complex)
    fields = replace(log.fields, phasor_sensor=absolute)
    refuse_unsigned(fields, np.zeros(2), "log")  # levels
    with pytest.raises(InputError, match="log: the components of three axes are never negative"):
        refuse_unsigned(fields, np.full(2, 20.0), "log")


def test_a_tum_truth_in_milliseconds_is_read_and_other_times_beyond_a_clock_are_named(
    tables: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    start = 1_700_000_000_000
    stamped = [[f"{start + t:.0f}", *row] for t, row in zip(TIME, rows_of(RATES), strict=True)]
    write(
        tables / "imu.csv",
        IMU_HEAD,
        [[*a[:4], *b] for a, b in zip(stamped, rows_of(FORCES), strict=True)],
    )
    write(
        tables / "mag.csv",
        FIELD_HEAD,
        [[a[0], *b] for a, b in zip(stamped, rows_of(FIELDS), strict=True)],
    )
    poses = [f"{start + 100 * k} 0 0 {k} 0 0 0 1" for k in range(15)]
    (tables / "t.tum").write_text("\n".join(poses) + "\n")
    write(tables / "t.csv", "t_s,px_m,py_m,pz_m", [row.split()[:4] for row in poses])
    text = reported(capfd, f"{BOTH} --truth t.csv")
    assert "beyond any clock in s: give their unit by --map 'truth.time=NAME[ns]'" in text
    run_command("import", *BOTH.split(), "--truth", "t.tum", "-o", "log")
    assert "truth.time=0[ms]" in capfd.readouterr().out
    truth = read_log(Path("log")).truth
    assert truth is not None
    assert len(truth) == 15


def test_a_single_problem_is_one_sentence(tables: Path, refuse: Refuse) -> None:
    sentence = refuse("import", tables / "nowhere.csv", "-o", tables / "log")
    assert "give the path of a source" in sentence


@pytest.mark.parametrize(
    "names",
    ["q[0],q[1],q[2],q[3]", "q0,q1,q2,q3", "q_1,q_2,q_3,q_4", "Quat(0),Quat(1),Quat(2),Quat(3)"],
)
def test_the_order_of_a_numbered_quaternion_is_asked_for(
    tables: Path, capfd: pytest.CaptureFixture[str], names: str
) -> None:
    still = np.tile([0.0, 1.0, 2.0, 1.0, 0.0, 0.0, 0.0], (ROWS, 1))
    write(tables / "truth.csv", f"t_ms,x_m,y_m,z_m,{names}", rows_of(TIME, still))
    text = reported(capfd, f"{BOTH} --truth truth.csv")
    option = f"--map 'truth.quaternion={names}[wxyz]' or [xyzw]"
    assert f"give the order of the quaternion by {option}" in text
    ordered = f"truth.quaternion={names}[wxyz]"
    run_command("import", *BOTH.split(), "--truth", "truth.csv", "--map", ordered, "-o", "log")
    truth = read_log(Path("log")).truth
    assert truth is not None
    np.testing.assert_allclose(truth.world_from_body[0], np.eye(3), atol=1e-12)


SHARP = np.array([0.3, 0.9, 9.7]) + 0.1 * _rng.standard_normal((ROWS, 3))  # m/s^2, one axis down


def test_the_axes_of_a_sensor_are_proposed_in_one_unit(
    tables: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    both = [
        f"{side} {name} {axis}"
        for side in ("left", "right")
        for name in ("acc", "gyr")
        for axis in "xyz"
    ]
    rates = 0.3 * RATES / 20.0  # rad/s
    write(
        tables / "both.csv",
        ",".join(["t_ms", *both]),
        rows_of(TIME, SHARP, rates, SHARP, rates),
    )
    text = reported(capfd, "mag.csv --imu both.csv")
    assert "--map 'imu.accel=left acc x,left acc y,left acc z[m/s^2]'" in text
    write(
        tables / "part.csv",
        "t_ms,acc x,acc y,acc z (m/s^2),gyr x (rad/s),gyr y,gyr z",
        rows_of(TIME, SHARP, rates),
    )
    text = reported(capfd, "mag.csv --imu part.csv")
    assert "no table is given" not in text
    for option in ("accel_x=acc x[m/s^2]", "accel_y=acc y[m/s^2]", "gyro_y=gyr y[rad/s]"):
        assert f"--map 'imu.{option}'" in text


@pytest.mark.parametrize("first", [0, 1])
@pytest.mark.parametrize("lost", [0, 20])
def test_an_index_is_no_time(
    tables: Path, capfd: pytest.CaptureFixture[str], first: int, lost: int
) -> None:
    rows = [
        [str(first + k), *row]
        for k, row in enumerate(rows_of(FORCES, RATES))
        if lost == 0 or k % lost
    ]
    write(tables / "counted.csv", "c0,c1,c2,c3,c4,c5,c6", rows)
    text = reported(capfd, "mag.csv --imu counted.csv")
    assert "--map 'imu.accel=c1,c2,c3[g]'" in text
    assert "--map 'imu.gyro=c4,c5,c6[deg/s]'" in text
    assert "imu.time=c0" not in text
    assert "or give --rate-hz imu=HZ" in text
