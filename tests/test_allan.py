"""Allan deviations: sums in constant memory, figures within their intervals, verdicts."""

import json
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import allantools
import numpy as np
import pyarrow.parquet
import pytest
from conftest import Refuse, run_command
from example_site import mixed_site
from scipy.signal import butter, lfilter
from spoiled_log import burst_stamps

from magfusion.calibration.allan import AllanStream
from magfusion.calibration.allan_fit import fit_allan
from magfusion.calibration.rest import RestStream
from magfusion.cli import main
from magfusion.errors import InputError
from magfusion.files.inertial_tables import IMU_LAYOUT
from magfusion.files.log import write_log
from magfusion.files.site import load_site, save_site
from magfusion.files.table import Span, write_table
from magfusion.files.table_stream import pieces, table_pieces
from magfusion.jobs.allan_noise import MeasuredNoise, measured
from magfusion.jobs.inputs import Job
from magfusion.model.progress import quiet
from magfusion.model.samples import ImuSamples, Log, Waveform
from magfusion.model.trust import Verdict

RATE = 100.0  # Hz
GYRO, ACCEL = (3e-4, 4e-5), (2e-3, 3e-4)  # white noise and walk
FIELD = 2.5e-10  # T/sqrt(Hz), one-sided

Arrays = dict[str, np.ndarray]


def _noise(rng: np.random.Generator, count: int, white: float, walk: float) -> np.ndarray:
    steps = walk / np.sqrt(RATE) * rng.normal(size=(count, 3))
    return white * np.sqrt(RATE) * rng.normal(size=(count, 3)) + np.cumsum(steps, axis=0)


def _rest(
    path: Path, seconds: float = 900.0, spoil: Callable[[Arrays], None] | None = None
) -> Path:
    """Write a log at rest with known noise."""
    rng, count = np.random.default_rng(11), int(seconds * RATE)
    built = {
        "time": np.arange(count) / RATE,
        "gyro": 2e-3 * np.array([1.0, -0.5, 0.2]) + _noise(rng, count, *GYRO),
        "accel": np.array([0.05, 0.02, 9.80665]) + _noise(rng, count, *ACCEL),
        "field": np.array([2e-5, 0.0, -4e-5]) + _noise(rng, count, FIELD / np.sqrt(2.0), 1e-12),
    }
    if spoil is not None:
        spoil(built)
    imu = ImuSamples(built["time"], built["gyro"], built["accel"])
    write_log(Log("rest", 0, "test", imu, Waveform(built["time"], built["field"])), path)
    return path


def _result(log: Path, end: float | None = None) -> MeasuredNoise:
    return measured(Job(log, None, log, None, end), None, quiet)


def _codes(result: MeasuredNoise) -> set[str]:
    return {reason.code for reason in result.trust.reasons}


# The sums -------------------------------------------------------------------------------------


def test_the_variance_is_that_of_allantools() -> None:
    """Exactly where every sample begins a cluster, and within a hundredth where every few do."""
    rng = np.random.default_rng(1)
    data = rng.normal(size=1 << 15) + 0.01 * np.cumsum(rng.normal(size=1 << 15))
    stream = AllanStream(1)
    for part in np.split(data, [100, 101, 9_000, 20_003]):
        stream.add(part[:, None])
    result = stream.result(1.0 / RATE)
    own = result.tau < 20.0
    tau, others, _, _ = allantools.oadev(data, rate=RATE, data_type="freq", taus=result.tau[own])
    np.testing.assert_allclose(tau, result.tau[own], rtol=1e-12)
    ours = np.sqrt(result.variance[own, 0])
    np.testing.assert_allclose(ours[:7], others[:7], rtol=1e-9)
    # A quarter of a cluster from one to the next: their number is still large.
    np.testing.assert_allclose(ours, others, rtol=0.02)


def test_samples_in_any_pieces_give_the_same_variance() -> None:
    data = np.random.default_rng(2).normal(size=(5_000, 3)) + 9.8
    whole, parts = AllanStream(3), AllanStream(3)
    whole.add(data)
    for part in np.split(data, np.arange(7, 5_000, 501)):
        parts.add(part)
    one, other = whole.result(1.0), parts.result(1.0)
    np.testing.assert_array_equal(one.count, other.count)
    np.testing.assert_allclose(one.variance, other.variance, rtol=1e-10)


def test_missing_samples_do_not_count() -> None:
    """Without a tenth of the samples, at random and in a row, white noise is what it was."""
    rng = np.random.default_rng(3)
    data = rng.normal(size=(60_000, 1))
    data[rng.random(60_000) < 0.02] = np.nan
    data[20_000:25_000] = np.nan
    stream = AllanStream(1)
    stream.add(data)
    result = stream.result(1.0)
    few = result.clusters > 500.0
    np.testing.assert_allclose(result.variance[few, 0] * result.tau[few], 1.0, rtol=0.15)
    assert stream.missing == np.sum(np.isnan(data))


def test_late_stamps_are_no_missing_samples() -> None:
    rng = np.random.default_rng(4)
    time = np.arange(20_000) / RATE
    kept = np.ones(20_000, dtype=bool)
    kept[[5_000, 9_000, 9_001]] = False
    kept[12_000:12_700] = False
    late = np.sort(time + 5e-4 * rng.normal(size=20_000))
    rest = RestStream(1)
    for part in np.array_split(np.flatnonzero(kept), 3):
        rest.add(late[part], rng.normal(size=(len(part), 1)))
    assert rest.allan.missing == 703
    assert rest.step == pytest.approx(1.0 / RATE, rel=1e-4)


# The fit --------------------------------------------------------------------------------------


@pytest.mark.parametrize("walk", [0.0, 1e-4])
def test_intervals_hold_what_was_simulated(walk: float) -> None:
    """Thirty channels at once: 95 % intervals hold the truth in nearly all."""
    rng, count, axes = np.random.default_rng(5), 1 << 16, 30
    stream = AllanStream(axes)
    steps = walk / np.sqrt(RATE) * rng.normal(size=(count, axes))
    stream.add(1e-3 * np.sqrt(RATE) * rng.normal(size=(count, axes)) + np.cumsum(steps, axis=0))
    result = stream.result(1.0 / RATE)
    fits = [fit for axis in range(axes) if (fit := fit_allan(result, axis)) is not None]
    white = [fit.white.low <= 1e-3 <= fit.white.high for fit in fits]
    walks = [fit.walk.low <= walk <= fit.walk.high for fit in fits]
    assert sum(white) >= 27
    assert sum(walks) >= 25
    assert np.mean([fit.white.high / fit.white.low for fit in fits]) < 1.15
    # What is taken into the site covers the walk, and is no more than the log's length excuses.
    covering = np.array([fit.covering_walk for fit in fits])
    assert np.median(covering) > 0.95 * walk
    assert np.median(covering) < 3e-5 + 1.5 * walk


def _bending(time: np.ndarray, seed: int) -> np.ndarray:
    return 5e-3 * np.sin(2.0 * np.pi * time / 100.0 + seed)


def _ramp(time: np.ndarray, _seed: int) -> np.ndarray:
    return 0.5 * time / time[-1]


def _warming(time: np.ndarray, _seed: int) -> np.ndarray:
    return 0.02 * np.exp(-time / 200.0)


@pytest.mark.parametrize("drift", [_bending, _ramp, _warming])
@pytest.mark.parametrize("filter_hz", [None, 10.0])
@pytest.mark.parametrize("seed", range(3))
def test_an_axis_that_drifts_keeps_its_white_noise(
    drift: Callable[[np.ndarray, int], np.ndarray], filter_hz: float | None, seed: int
) -> None:
    rng, count, white = np.random.default_rng(seed), 200_000, 3e-4
    data = white * np.sqrt(RATE) * rng.normal(size=count)
    if filter_hz is not None:
        data = lfilter(*butter(1, filter_hz, fs=RATE), data)
    stream = AllanStream(1)
    stream.add((data + drift(np.arange(count) / RATE, seed))[:, None])
    fit = fit_allan(stream.result(1.0 / RATE), 0)
    assert fit is not None
    assert fit.white.low < white < fit.white.high
    assert fit.white.high < 1.2 * fit.white.value
    _, deviation, _, _ = allantools.oadev(data, RATE, "freq", taus=[1.0])
    assert fit.white.low < deviation[0] < fit.white.high


def test_an_instruments_own_filter_is_no_quiet_instrument() -> None:
    """A running mean makes short clusters smooth: the white noise is that of long ones."""
    data = np.random.default_rng(6).normal(size=(1 << 16) + 7)
    stream = AllanStream(1)
    stream.add(np.convolve(data, np.full(8, 0.125), "valid")[:, None])
    fit = fit_allan(stream.result(1.0), 0)
    assert fit is not None
    assert fit.white.low < 1.0 < fit.white.high
    assert fit.first_tau > 4.0


# The job --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def resting(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return _rest(tmp_path_factory.mktemp("rest") / "log", 1800.0)


@pytest.mark.slow
def test_a_log_at_rest_gives_the_keys_of_a_site(
    resting: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    save_site(mixed_site(), tmp_path / "site.yaml")
    site = tmp_path / "site.yaml"
    run_command("allan", resting, "--site", site, "-o", tmp_path / "out", "--json")
    report = json.loads(capfd.readouterr().out.splitlines()[-1])
    names = {entry.name for entry in (tmp_path / "out").iterdir()}
    assert names == {"allan.png", "report.html", "report.json", "site.yaml"}
    assert report["verdict"] == "trustworthy"
    assert report["reasons"] == []
    assert report["gyro_noise"] == pytest.approx(GYRO[0], rel=0.03)
    assert report["accel_noise"] == pytest.approx(ACCEL[0], rel=0.03)
    assert report["noise_density_t_rthz"] == pytest.approx(FIELD, rel=0.03)
    for axis in "xyz":
        for key, (white, walk) in (("gyro", GYRO), ("accel", ACCEL)):
            assert report[f"{key}_white_{axis}_low"] < white < report[f"{key}_white_{axis}_high"]
            low, high = (report[f"{key}_random_walk_{axis}_{end}"] for end in ("low", "high"))
            assert low < walk < high
    assert GYRO[1] < report["gyro_bias_walk"] < 2.0 * GYRO[1]
    before, after = load_site(site), load_site(tmp_path / "out" / "site.yaml")
    imu = after.platform.imu
    assert imu.gyro_noise == report["gyro_noise"]
    assert imu.accel_bias_walk == report["accel_bias_walk"]
    assert imu.gyro_bias_sigma >= before.platform.imu.gyro_bias_sigma
    assert after.platform.magnetometer.noise_density == report["noise_density_t_rthz"]
    assert "imu.accel_bias across gravity" in {u["parameter"] for u in report["unverified"]}


def _knock(simulation: Arrays) -> None:
    simulation["gyro"][20_000:20_300] += 0.5


def _gap(simulation: Arrays) -> None:
    for name, values in simulation.items():
        simulation[name] = np.delete(values, np.arange(15_000, 16_000), axis=0)


def _freeze(simulation: Arrays) -> None:
    simulation["gyro"][15_000:18_000] = simulation["gyro"][15_000]
    simulation["accel"][15_000:18_000] = simulation["accel"][15_000]


def _coarse(simulation: Arrays) -> None:
    simulation["accel"] = np.round(simulation["accel"] / 0.1) * 0.1


def _propagate(simulation: Arrays) -> None:
    time = simulation["time"]
    simulation["gyro"] += 0.4 * np.sin(time)[:, None]


def _bursts(simulation: Arrays) -> None:
    count = len(simulation["time"])
    simulation["time"] = burst_stamps(count, RATE, np.random.default_rng(6))


def _milliseconds(simulation: Arrays) -> None:
    simulation["time"] = 1e-3 * np.floor(simulation["time"] * 1e3 * RATE / 150.0)


@pytest.mark.slow
@pytest.mark.parametrize(("spoil", "rate_hz"), [(_bursts, RATE), (_milliseconds, 150.0)])
def test_samples_of_a_coarse_or_late_clock_are_counted(
    spoil: Callable[[Arrays], None], rate_hz: float, tmp_path: Path
) -> None:
    result = _result(_rest(tmp_path / "log", spoil=spoil))
    assert _codes(result) <= {"few_data"}  # of the walk
    density = np.sqrt(RATE / rate_hz)  # the same samples at another rate
    assert result.keys["gyro_noise"] == pytest.approx(GYRO[0] * density, rel=0.05)
    assert result.keys["accel_noise"] == pytest.approx(ACCEL[0] * density, rel=0.05)


def _ideal(simulation: Arrays) -> None:
    simulation["accel"] = np.tile([0.0, 0.0, 9.81], (len(simulation["time"]), 1))


def test_an_axis_without_noise_is_named_and_the_others_are_measured(tmp_path: Path) -> None:
    log = _rest(tmp_path / "log", 300.0, _ideal)
    run_command("allan", log, "-o", tmp_path / "out")
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    (reason,) = [one for one in report["reasons"] if "accelerometer" in one["text"]]
    assert reason["code"] == "stuck_axis"
    assert "axes x, y, z without noise" in reason["text"]
    assert report["gyro_noise"] == pytest.approx(GYRO[0], rel=0.05)
    assert "accel_noise" not in report


def test_a_log_without_any_noise_is_refused(tmp_path: Path, refuse: Refuse) -> None:
    def nothing(simulation: Arrays) -> None:
        _ideal(simulation)
        for name in ("gyro", "field"):
            simulation[name] = np.zeros_like(simulation[name])

    log = _rest(tmp_path / "log", 300.0, nothing)
    sentence = refuse("allan", log, "-o", tmp_path / "out")
    assert "no noise: gyroscope x, y, z; accelerometer x, y, z; magnetometer x, y, z" in sentence


@pytest.mark.parametrize(
    ("spoil", "code", "white_holds"),
    [
        (_knock, "not_at_rest", True),
        (_gap, "gap", True),
        (_freeze, "frozen_imu", True),
        (_coarse, "quantised", False),
    ],
)
def test_what_spoils_a_log_is_said_and_left_out(
    spoil: Callable[[Arrays], None], code: str, white_holds: bool, tmp_path: Path
) -> None:
    result = _result(_rest(tmp_path / "log", 400.0, spoil))
    assert result.trust.verdict is Verdict.DOUBTFUL
    assert code in _codes(result)
    assert result.keys["gyro_noise"] == pytest.approx(GYRO[0], rel=0.05)
    fixed = result.keys["accel_noise"] == pytest.approx(ACCEL[0], rel=0.05)
    assert fixed is white_holds


@pytest.mark.slow
def test_a_log_in_motion_fails(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    log = _rest(tmp_path / "log", 120.0, _propagate)
    with pytest.raises(SystemExit) as ended:
        main(["allan", str(log), "-o", str(tmp_path / "out")])
    assert ended.value.code == 1
    assert "motion or vibration" in capfd.readouterr().err
    assert {p.name for p in (tmp_path / "out").iterdir()} == {"report.json", "failed"}


def test_a_short_log_does_not_know_the_walk_of_a_bias(resting: Path) -> None:
    result = _result(resting, 60.0)
    assert result.trust.verdict is Verdict.DOUBTFUL
    assert _codes(result) == {"few_data"}
    low, high = result.intervals["gyro_noise"]
    assert low < GYRO[0] < high
    assert result.keys["gyro_bias_walk"] > GYRO[1]


def test_too_few_samples_are_refused(resting: Path, tmp_path: Path, refuse: Refuse) -> None:
    findings = refuse("allan", resting, "--end", "1", "-o", tmp_path / "out")
    assert (
        "has 100 samples in the selected part; record at rest for at least some minutes" in findings
    )
    assert "there is no such file" in refuse("allan", tmp_path / "nowhere")


@pytest.mark.parametrize(
    ("name", "factor", "sentence"),
    [
        ("accel", 1 / 9.80665, "probably in g; multiply it by 9.8"),
        ("field", 1e9, "divide nanotesla by 1e9"),
    ],
)
def test_samples_in_another_unit_are_refused(
    tmp_path: Path, refuse: Refuse, name: str, factor: float, sentence: str
) -> None:
    _rest(tmp_path / "log", 60.0, lambda built: built.update({name: factor * built[name]}))
    assert sentence in refuse("allan", tmp_path / "log", "-o", tmp_path / "out")


def test_an_axis_that_is_never_measured_is_named(tmp_path: Path, refuse: Refuse) -> None:
    _rest(tmp_path / "log", 60.0)
    table = pyarrow.parquet.read_table(tmp_path / "log" / "imu.parquet")
    place = table.column_names.index("gyro_y")
    empty = pyarrow.array(np.full(len(table), np.nan))
    table = table.set_column(place, "gyro_y", empty)
    pyarrow.parquet.write_table(table, tmp_path / "log" / "imu.parquet")
    sentence = refuse("allan", tmp_path / "log", "-o", tmp_path / "out")
    assert f"gyro_y is NaN in all {len(table)} rows of imu; repair the sensor" in sentence


# Any length, the same memory ------------------------------------------------------------------


def test_a_table_is_read_in_the_memory_of_a_part_of_it(tmp_path: Path) -> None:
    """Eight times the rows take no more memory, by the same batches."""
    peaks = []
    for parts in (2, 16):
        count = parts << 17
        columns: dict[str, object] = {"time_ns": np.arange(count) * 10_000_000}
        columns |= {name: np.zeros(count, dtype=np.float64) for name in IMU_LAYOUT.numbers}
        path = tmp_path / f"{parts}.parquet"
        write_table(columns, path)
        del columns
        tracemalloc.start()
        rows = sum(len(table.numbers(IMU_LAYOUT.numbers)) for table in _tables(path))
        peaks.append(tracemalloc.get_traced_memory()[1] + pyarrow.total_allocated_bytes())
        tracemalloc.stop()
        assert rows == count
    assert peaks[1] < 1.3 * peaks[0]


def _tables(path: Path) -> object:
    return table_pieces(path, IMU_LAYOUT, Span(0))


def test_what_is_kept_of_a_stream_does_not_grow() -> None:
    rng = np.random.default_rng(8)
    kept = []
    rest = RestStream(6)
    for part in range(12):
        time = (np.arange(4_000) + 4_000 * part) / 5.0
        rest.add(time, rng.normal(size=(4_000, 6)))
        levels = rest.allan._levels
        kept.append(len(rest.blocks().begin) + sum(len(level.mean) for level in levels))
    assert max(kept[1:]) <= 4096 + 1 + 13 * len(levels)
    assert len(rest) == 48_000


def test_parts_of_a_table_are_held_to_the_same_rules(tmp_path: Path) -> None:
    rows = (1 << 17) + 5
    time_ns = np.arange(rows) * 10_000_000
    time_ns[1 << 17] = 0  # the first row of the second batch
    columns: dict[str, object] = {"time_ns": time_ns}
    columns |= {name: np.zeros(rows) for name in IMU_LAYOUT.numbers}
    write_table(columns, tmp_path / "imu.parquet")
    sentence = r"row 131072 .*found 0; which is before the row above"
    with pytest.raises(InputError, match=sentence):
        for _ in table_pieces(tmp_path / "imu.parquet", IMU_LAYOUT, Span(0)):
            pass


def test_a_span_of_a_csv_is_that_of_a_parquet(resting: Path, tmp_path: Path) -> None:
    log = tmp_path / "csv"
    log.mkdir()
    (log / "log.yaml").write_text((resting / "log.yaml").read_text())
    table = pyarrow.parquet.read_table(resting / "imu.parquet").slice(0, 3_000)
    pyarrow.csv.write_csv(table, log / "imu.csv")
    one = [p.values for p in pieces(resting, "imu", 3.0, 20.0)]
    other = [p.values for p in pieces(log, "imu", 3.0, 20.0)]
    assert np.concatenate(one).shape == (1_700, 6)
    np.testing.assert_allclose(np.concatenate(other), np.concatenate(one), rtol=1e-12)
    assert list(pieces(log, "magnetometer")) == []
