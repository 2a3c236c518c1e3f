"""Names, units, stamps and ways of writing of tables, each read as a person would."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from magfusion.errors import InputError
from magfusion.files.foreign.columns import STREAMS, parse_entry
from magfusion.files.foreign.convert import write_stream
from magfusion.files.foreign.dialect import find_dialect
from magfusion.files.foreign.guess import named_columns, streams_of
from magfusion.files.foreign.plan import Findings, plan_stream
from magfusion.files.foreign.source import SourceColumn
from magfusion.files.foreign.text import REPEATED, TORN, text_source
from magfusion.files.foreign.units import (
    NO_STAMP,
    UNITS,
    Dimension,
    SourceUnit,
    accepted,
    parse_unit,
    to_nanoseconds,
)

RATE, FORCE, FIELD, TIME = Dimension.RATE, Dimension.FORCE, Dimension.FIELD, Dimension.TIME

# Units ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "dimension", "si"),
    [
        ("deg/s", RATE, np.pi / 180),
        ("°/s", RATE, np.pi / 180),
        ("dps", RATE, np.pi / 180),
        ("deg s^-1", RATE, np.pi / 180),
        ("degrees/s", RATE, np.pi / 180),
        ("rad_per_s", RATE, 1.0),
        ("rad s^-1", RATE, 1.0),
        ("mdps", RATE, np.pi / 180e3),
        ("m/s²", FORCE, 1.0),
        ("m s^-2", FORCE, 1.0),
        ("m/s/s", FORCE, 1.0),
        ("g", FORCE, 9.80665),
        ("mg", FORCE, 9.80665e-3),
        ("0.061*mg", FORCE, 0.061e-3 * 9.80665),
        ("µT", FIELD, 1e-6),
        ("μT", FIELD, 1e-6),
        ("nT", FIELD, 1e-9),
        ("G", FIELD, 1e-4),
        ("mG", FIELD, 1e-7),
        ("gauss", FIELD, 1e-4),
        ("0.5 * nT", FIELD, 0.5e-9),
        ("-1e3*pT", FIELD, -1e-9),
        ("mm", Dimension.LENGTH, 1e-3),
        ("km/h", Dimension.SPEED, 1 / 3.6),
    ],
)
def test_a_unit_is_read_as_people_write_it(text: str, dimension: Dimension, si: float) -> None:
    unit = parse_unit(text, dimension)
    assert unit is not None
    assert unit.si == pytest.approx(si, rel=1e-15)


@pytest.mark.parametrize("dimension", Dimension)
def test_every_unit_that_is_offered_is_taken(dimension: Dimension) -> None:
    for name in UNITS[dimension]:
        assert name in accepted(dimension)
        assert parse_unit(name, dimension) == SourceUnit(name, dimension)
    for wrong in ("parsec", "0*", "nan*1"):
        assert parse_unit(wrong, dimension) is None


# Stamps ---------------------------------------------------------------------------------------

NOW_NS = 1_700_000_000_123_456_789


@pytest.mark.parametrize(
    ("raw", "unit", "expected"),
    [
        (pa.array(["1700000000.123456789"]), "s", NOW_NS),
        (pa.array([" 1700000000,123456789 "]), "s", NOW_NS),
        (pa.array(["-1700000000.5"]), "s", -1_700_000_000_500_000_000),
        (pa.array(["1700000000123.456789"]), "ms", NOW_NS),
        (pa.array(["1700000000123456789"]), "ns", NOW_NS),
        (pa.array(["1.7e9"]), "s", 1_700_000_000_000_000_000),
        (np.array([1_700_000_000_123_456]), "us", 1_700_000_000_123_456_000),
        (np.array([51_200_001], dtype=np.uint64), "39.0625*us", 2_000_000_039_063),
        (np.array([0.25]), "s", 250_000_000),
        (np.array([1.5]), "min", 90_000_000_000),
        (np.array([np.nan]), "s", NO_STAMP),
        (pa.array(["nan"]), "s", NO_STAMP),
        (pa.array(["2023-11-14T22:13:20.123456789"]), "iso", NOW_NS),
        (pa.array(["2023-11-14 22:13:20.123456789Z"]), "iso", NOW_NS),
        (pa.array(["2023-11-14T23:13:20.123456789+01:00"]), "iso", NOW_NS),
        (pa.array(["14.11.2023 22:13:20,123456789"]), "iso", NOW_NS),
        (pa.array(["2023/11/14 22:13:20.123456789"]), "iso", NOW_NS),
        (pa.array(["01:00:00.5"]), "iso", 3_600_500_000_000),
        (pa.array([""]), "iso", NO_STAMP),
        (np.array(["2023-11-14T22:13:20.123456789"], dtype="M8[ns]"), "iso", NOW_NS),
    ],
)
def test_a_stamp_is_exact_to_the_nanosecond(raw: object, unit: str, expected: int) -> None:
    known = parse_unit(unit, TIME)
    assert known is not None
    assert to_nanoseconds(raw, known).tolist() == [expected]


@pytest.mark.parametrize("text", ["noon", "1.2.3", "14/11/2023 22:13:20", "12h"])
@pytest.mark.parametrize("unit", ["s", "iso"])
def test_what_is_no_stamp_is_told(text: str, unit: str) -> None:
    known = parse_unit(unit, TIME)
    assert known is not None
    with pytest.raises(ValueError, match=text):
        to_nanoseconds(pa.array(["", text]), known)


# Names ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "stream", "target", "unit"),
    [
        ("gyro_x_dps", "imu", "gyro_x", "deg/s"),
        ("GyrY", "imu", "gyro_y", None),
        ("wz", "imu", "gyro_z", None),
        ("w_RS_S_x [rad s^-1]", "imu", "gyro_x", "rad/s"),
        ("imu.angular_velocity.y", "imu", "gyro_y", None),
        ("Gyroscope x (rad/s)", "imu", "gyro_x", "rad/s"),
        ("gyro_x_rad_per_s", "imu", "gyro_x", "rad/s"),
        ("ax [g]", "imu", "accel_x", "g"),
        ("acc_z_m_s2", "imu", "accel_z", "m/s^2"),
        ("xacc", "imu", "accel_x", None),
        ("linear_acceleration.z", "imu", "accel_z", None),
        ("accel:1", "imu", "accel_y", None),
        ("Bx_nT", "magnetometer", "field_x", "nT"),
        ("mag_y_uT", "magnetometer", "field_y", "uT"),
        ("Magnetic field z (µT)", "magnetometer", "field_z", "uT"),
        ("field.magnetic_field.x", "magnetometer", "field_x", None),
        ("x", "magnetometer", "field_x", None),
        ("magnetometer_ga[1]", "magnetometer", "field_y", "gauss"),
        ("accelerometer_m_s2[2]", "imu", "accel_z", "m/s^2"),
        ("gyro_rad[0]", "imu", "gyro_x", None),
        ("timestamp [ns]", "magnetometer", "time", "ns"),
        ("t_ms", "imu", "time", "ms"),
        ("Time (s)", "imu", "time", "s"),
        ("pose.position.x", "truth", "position_x", None),
        ("px_mm", "truth", "position_x", "mm"),
        ("q_w", "truth", "qw", "1"),
        ("orientation.z", "truth", "qz", "1"),
        ("vel_x_m_s", "truth", "velocity_x", "m/s"),
    ],
)
def test_a_name_says_what_it_is(name: str, stream: str, target: str, unit: str | None) -> None:
    result = {t: named for t, named in named_columns([SourceColumn(name)], stream).items() if named}
    assert list(result) == [target]
    (one,) = result[target]
    assert one.unit == (None if unit is None else parse_unit(unit, STREAMS[stream][target]))


@pytest.mark.parametrize(
    ("name", "stream"),
    [
        *(("gyro_bias_x", "imu"), ("temperature", "imu"), ("index", "imu"), ("mag_x_nT", "imu")),
        *(("acc_cov_x", "imu"), ("gyro_x_dps", "magnetometer"), ("x", "imu"), ("cpu", "truth")),
    ],
)
def test_what_another_thing_is_called_is_not_taken(name: str, stream: str) -> None:
    assert not any(named_columns([SourceColumn(name)], stream).values())


def test_one_table_with_two_clocks_gives_each_stream_its_own() -> None:
    names = [
        "imu_time_ms",
        "gyro_x",
        "acc_x",
        "mag_time_ms",
        "mag_x",
        "gt_time_ms",
        "gt_x",
        "gt_qw",
    ]
    columns = [SourceColumn(name) for name in names]
    assert streams_of(columns, "all") == {"imu", "magnetometer"}
    for stream, place in (("imu", 0), ("magnetometer", 3), ("truth", 5)):
        assert [n.place for n in named_columns(columns, stream)["time"]] == [place]


# Ways of writing ------------------------------------------------------------------------------

WRITINGS: dict[str, tuple[str, str, str]] = {
    # name: (text, encoding, how it is understood)
    "plain": ("t,x,y\n1,2.5,3\n2,3.5,4\n", "utf-8", "delimiter comma, data from line 2"),
    "decimal comma": (
        "Messung 3\r\nZeit;x;y\r\ns;nT;nT\r\n1;2,5;3\r\n2;3,5;4\r\n",
        "utf-8-sig",
        "delimiter semicolon, decimal comma, data from line 4",
    ),
    "spaces": (
        "  t   x[µT]   y\n  1   2.5    3\n  2 3.5   4  \n",
        "cp1252",
        "delimiter space, cp1252, data from line 2",
    ),
    "comments": (
        "# serial 7, fw 2\n#t x y\n1 2.5 3\n# break\n2 3.5 4\n",
        "utf-8",
        "delimiter space, data from line 3",
    ),
    "quoted": (
        '"t, s","x","y"\n"1","2.5","3"\n"2","3.5","4"\n',
        "utf-8",
        "delimiter comma, data from line 2",
    ),
    "utf-16": (
        "t\tx\ty\r\n1\t2.5\t3\r\n2\t3.5\t4\r\n",
        "utf-16",
        "delimiter tab, utf-16-le, data from line 2",
    ),
    "no header": ("1|2.5|3\n2|3.5|4\n", "utf-8", "delimiter pipe, data from line 1"),
    "empty last column": ("t,x,y,\n1,2.5,3,\n2,3.5,4,\n", "utf-8", "delimiter comma, data from"),
    "torn rows": ("t,x,y\n1,2.5,3\n7,8\n\n2,3.5,4\n9,9", "utf-8", "delimiter comma, data from"),
    "quoted decimal comma": (
        't,x,y\n"1,0","2,5","3,0"\n"2,0","3,5","4,0"\n',
        "utf-8",
        "delimiter comma, decimal comma, data from line 2",
    ),
    "exponents": ("t,x,y\n1.0e0,+2.5E+00,3.\n2,.35e1,4\n", "utf-8", "delimiter comma, data from"),
}


@pytest.mark.parametrize("name", WRITINGS)
def test_a_table_is_read_in_whatever_way_it_is_written(name: str, tmp_path: Path) -> None:
    text, encoding, form = WRITINGS[name]
    path = tmp_path / "table.csv"
    path.write_bytes(text.encode(encoding))
    source = text_source(path)
    assert source.form.startswith(form)
    parts = list(source.read([0, 1, 2], {0}))
    assert [t.strip() for p in parts for t in p.columns[0].to_pylist()][-1] in ("2", "2,0")
    np.testing.assert_array_equal(np.concatenate([p.columns[1] for p in parts]), [2.5, 3.5])
    np.testing.assert_array_equal(np.concatenate([p.columns[2] for p in parts]), [3.0, 4.0])
    torn = sum(p.left_out.get(TORN, 0) for p in parts)
    assert torn == (2 if name == "torn rows" else 0)


def test_units_of_a_second_row_are_those_of_the_columns(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    path.write_text("t;Bx;By\n[ms];[nT];-\n1;2;3\n")
    assert find_dialect(path).columns == (
        SourceColumn("t", "ms"),
        SourceColumn("Bx", "nT"),
        SourceColumn("By", "-"),
    )


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (b"", "is empty"),
        (b"\x93NUMPY\x01\0v\0", "is no text; name a binary table by its suffix"),
        (b"PK\3\4\x14\0\6\0", "is a spreadsheet or an archive; save its table as CSV"),
        (b"Dear Sir,\nplease find attached\n", "holds no table of numbers .first line: 'Dear"),
    ],
)
def test_what_is_no_table_is_refused(content: bytes, sentence: str, tmp_path: Path) -> None:
    (tmp_path / "table.csv").write_bytes(content)
    with pytest.raises(InputError, match=rf"table.csv: {sentence}"):
        text_source(tmp_path / "table.csv")


# Rows -----------------------------------------------------------------------------------------


def test_rows_are_sorted_and_what_is_left_out_is_counted(tmp_path: Path) -> None:
    rows = [[10.0 * k, 1.0, 2.0, 3.0] for k in range(50)]
    rows[20], rows[21] = rows[21], rows[20]
    rows.insert(30, list(rows[30]))
    rows[5][2] = np.nan
    text = "\n".join(",".join(map(str, row)) for row in rows)
    (tmp_path / "m.csv").write_text(f"t_ms,Bx_nT,By_nT,Bz_nT\n{text}\n,1,2,3\n7\n")
    reported = Findings()
    plan = plan_stream("magnetometer", text_source(tmp_path / "m.csv"), (), None, reported)
    assert plan is not None
    assert not reported.problems
    counts = write_stream(plan, tmp_path / "m.parquet")
    assert (counts.read, counts.written, counts.missing, counts.unsorted) == (52, 50, 1, 1)
    assert counts.left_out == {
        **{"without a time": 1, "that are copies of others": 1},
        TORN: 1,
    }
    written = pa.parquet.read_table(tmp_path / "m.parquet")
    assert written["time_ns"].to_pylist() == [10_000_000 * k for k in range(50)]
    np.testing.assert_allclose(written["field_z"].to_numpy(), 3e-9, rtol=1e-15, atol=0)


@pytest.mark.parametrize("delimiter", [",", "   "])
def test_a_repeated_head_is_skipped_and_counted(tmp_path: Path, delimiter: str) -> None:
    head = delimiter.join(("t_ms", "Bx_nT", "By_nT", "Bz_nT"))
    rows = [delimiter.join((f"{10 * k}", "1", "2", "3")) for k in range(50)]
    (tmp_path / "m.csv").write_text("\n".join([head, *rows[:20], head, *rows[20:]]) + "\n")
    plan = plan_stream("magnetometer", text_source(tmp_path / "m.csv"), (), None, Findings())
    assert plan is not None
    counts = write_stream(plan, tmp_path / "m.parquet")
    assert (counts.read, counts.written, counts.left_out) == (50, 50, {REPEATED: 1})


def test_rows_of_other_streams_are_no_missing_samples(tmp_path: Path) -> None:
    """Of a table of two rates; a sample of which one number is missing is missing."""
    rows = [[5.0 * k, *([k, k, k] if k % 4 == 0 else ["", "", ""])] for k in range(400)]
    rows[8][2] = ""
    text = "\n".join(",".join(map(str, row)) for row in rows)
    (tmp_path / "all.csv").write_text(f"t_ms,Bx_nT,By_nT,Bz_nT\n{text}\n")
    plan = plan_stream("magnetometer", text_source(tmp_path / "all.csv"), (), None, Findings())
    assert plan is not None
    counts = write_stream(plan, tmp_path / "m.parquet", shared=True)
    assert (counts.read, counts.written, counts.missing) == (400, 100, 1)
    assert counts.left_out == {"that are of other streams": 300}
    with pytest.raises(InputError, match="301 of 400 rows lack a number"):
        write_stream(plan, tmp_path / "m.parquet")


@pytest.mark.parametrize(
    ("names", "columns", "maps"),
    [
        ("", "cgggaaa", ["imu.time=0[ms]", "imu.gyro=1,2,3[deg/s]", "imu.accel=4,5,6[g]"]),
        ("", "aaagggc", ["imu.time=6[ms]", "imu.gyro=3,4,5[deg/s]", "imu.accel=0,1,2[g]"]),
        (
            "n;p [°/s];q [°/s];r [°/s];u [g];v [g];w [g]",
            "cgggaaa",
            ["imu.time=n[ms]", "imu.gyro=p [°/s],q [°/s],r [°/s][deg/s]"],
        ),
        ("Uhr;a;b;c;d;e;f", "dgggaaa", ["imu.time=Uhr[iso]", "imu.gyro=a,b,c[deg/s]"]),
    ],
)
def test_columns_of_unknown_names_are_proposed_by_unit_place_and_size(
    names: str, columns: str, maps: list[str], tmp_path: Path
) -> None:
    rng = np.random.default_rng(6)
    values = {
        "c": [f"{5 * k}" for k in range(300)],
        "d": [f"03.05.2024 12:00:{5 * k // 1000:02d},{5 * k % 1000:03d}" for k in range(300)],
        "g": rng.normal(0.0, 30.0, 300).astype(str).tolist(),
        "a": rng.normal(0.57, 0.01, 300).astype(str).tolist(),
    }
    rows = zip(*(values[kind] for kind in columns), strict=True)
    lines = [";".join(row) for row in rows]
    (tmp_path / "i.csv").write_text("\n".join(filter(None, [names, *lines])))
    reported = Findings()
    assert plan_stream("imu", text_source(tmp_path / "i.csv"), (), None, reported) is None
    assert reported.proposals[: len(maps)] == maps


def test_truth_leaves_out_what_holds_no_pose(tmp_path: Path) -> None:
    lines = [f"{0.1 * k:.1f},{k},0,0,1,0,0,0" for k in range(9)]
    lines[3] = "0.3,nan,0,0,1,0,0,0"
    lines[6] = "0.6,0,0,0,0,0,0,0"
    (tmp_path / "g.csv").write_text("\n".join(["t,x,y,z,qw,qx,qy,qz", *lines]))
    entries = [
        e for text in ("truth.time=t[s]", "truth.position=x,y,z[cm]") for e in parse_entry(text)
    ]
    plan = plan_stream("truth", text_source(tmp_path / "g.csv"), entries, None, Findings())
    assert plan is not None
    counts = write_stream(plan, tmp_path / "g.parquet")
    assert counts.left_out == {"without a pose": 1, "with a quaternion of zeros": 1}
    written = pa.parquet.read_table(tmp_path / "g.parquet")
    assert written["position_x"].to_pylist() == pytest.approx(
        [0, 0.01, 0.02, 0.04, 0.05, 0.07, 0.08]
    )


def test_the_order_of_a_quaternion_is_that_which_is_said() -> None:
    def names(text: str) -> dict[str, str]:
        return {entry.column: entry.value for entry in parse_entry(text)}

    plain = {"qw": "a[1]", "qx": "b[1]", "qy": "c[1]", "qz": "d[1]"}
    assert names("truth.quaternion=a,b,c,d[wxyz]") == plain
    assert names("truth.quaternion=b,c,d,a[xyzw]") == plain
    array = {"qw": "q:3[1]", "qx": "q:0[1]", "qy": "q:1[1]", "qz": "q:2[1]"}
    assert names("truth.quaternion=q[xyzw]") == array
