"""`magfusion calibrate magnetometer`: its files, what it finds, and what it refuses."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import twelve_positions
import yaml
from conftest import Refuse, Worked, change_table, run_command
from test_shared_logs import LOGS, needs_shared_logs

from magfusion.calibration.magnetometer import field_from_measured, spread
from magfusion.calibration.magnetometer_log import calibrate_log
from magfusion.calibration.static_field import static_field, window_length
from magfusion.calibration.stops import find_stops
from magfusion.errors import EstimationError, InputError
from magfusion.files.log import write_log
from magfusion.files.open import open_log
from magfusion.files.site import load_site, save_site
from magfusion.jobs.calibrate_magnetometer import run_calibrate_magnetometer
from magfusion.jobs.inputs import Job
from magfusion.model.samples import ImuSamples, Log, Waveform
from magfusion.model.site import Magnetometer, MotionModel, Site
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import SimulatedLog, SimulationConfig, simulate_log
from magfusion.simulation.motion import Rests

FILES = {"site.yaml", "report.html", "report.json", "magnetometer.png"}
DURATION = 60.0  # s


def miscalibrated() -> Site:
    site = demo_site()
    sensor = site.platform.magnetometer
    sigma = replace(
        sensor.sigma,
        matrix=np.full((3, 3), 0.02),
        offset=np.full(3, 5e-7),
        rotation_sensor=np.full(3, 0.02),
    )
    sensor = replace(sensor, sigma=sigma)
    return replace(site, platform=replace(site.platform, magnetometer=sensor))


def write(log: Log, site: Site, place: Path) -> Path:
    write_log(log, place)
    save_site(site, place / "site.yaml")
    return place


@pytest.fixture(scope="module")
def rotated(tmp_path_factory: pytest.TempPathFactory) -> tuple[SimulatedLog, Path]:
    config = SimulationConfig(
        DEMO_BOX_WORLD, DURATION, "turn", rests=Rests(2.0, 60.0, 0.0), time_offset=0.0
    )
    simulated = simulate_log(miscalibrated(), config, np.random.default_rng(3))
    place = tmp_path_factory.mktemp("turned") / "log"
    return simulated, write(simulated.log, miscalibrated(), place)


@pytest.fixture(scope="module")
def result(rotated: tuple[SimulatedLog, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    output = tmp_path_factory.mktemp("calibrated") / "result"
    for _ in range(2):  # an earlier result is replaced
        run_command("calibrate", "magnetometer", rotated[1], "-o", output)
    return output


def report_of(place: Path) -> dict[str, Any]:
    result: dict[str, Any] = json.loads((place / "report.json").read_text())
    return result


def spread_of(log: Log, site: Site, sensor: Magnetometer) -> float:
    assert log.waveform is not None
    readings = static_field(log.waveform, log.imu, site, magnetometer=sensor)
    measured = readings.measured_sensor
    return spread(field_from_measured(measured, sensor.matrix, sensor.offset))


@pytest.mark.slow
def test_the_command_writes_site_picture_and_report(result: Path) -> None:
    assert {path.name for path in result.iterdir()} == FILES
    assert (result / "magnetometer.png").read_bytes().startswith(b"\x89PNG")
    report = report_of(result)
    assert report["job"] == "calibrate magnetometer"
    assert report["spread_after"] < 1e-3 < report["spread_before"]
    assert len(report["determined"]) == 12
    assert report["notes"] == []


@pytest.mark.slow
def test_sensor_and_mounting_together_are_found_within_their_sigmas(
    rotated: tuple[SimulatedLog, Path], result: Path
) -> None:
    true = rotated[0].true_site.platform.magnetometer
    estimate = load_site(result / "site.yaml").platform.magnetometer
    declared = miscalibrated().platform.magnetometer
    np.testing.assert_allclose(
        estimate.body_from_sensor, declared.body_from_sensor, rtol=0.0, atol=1e-12
    )
    # The mounting is held, so that the matrix holds its error.
    product = true.matrix @ true.body_from_sensor.T @ declared.body_from_sensor
    off = np.abs(product - declared.matrix)
    assert np.max(off) > 0.02
    report = report_of(result)
    sigma = [[report[f"magnetometer.matrix_{r}{c}_sigma"] for c in "xyz"] for r in "xyz"]
    assert np.max(np.abs(estimate.matrix - product) / sigma) < 3.5
    assert np.max(sigma) < 3e-3
    assert np.max(np.abs(estimate.offset - true.offset) / estimate.sigma.offset) < 3.5
    assert np.max(estimate.sigma.offset) < 5e-9


def test_the_refined_site_fed_back_in_changes_no_more(
    rotated: tuple[SimulatedLog, Path], result: Path, tmp_path: Path
) -> None:
    job = Job(rotated[1], result / "site.yaml", tmp_path / "again")
    report = run_calibrate_magnetometer(job)
    for name in ("matrix_xx", "matrix_yz", "offset_nt_x"):
        change = report[f"magnetometer.{name}"]
        sigma = report[f"magnetometer.{name}_prior_sigma"]
        assert isinstance(change, float)
        assert isinstance(sigma, float)
        assert abs(change) < sigma
    assert report["spread_after"] == pytest.approx(report["spread_before"], rel=0.1)


@pytest.mark.slow
def test_without_an_earth_field_the_scale_stays_and_the_report_says_so(
    rotated: tuple[SimulatedLog, Path], result: Path, tmp_path: Path
) -> None:
    bare = replace(miscalibrated(), earth_field_world=None)
    save_site(bare, tmp_path / "bare.yaml")
    report = run_calibrate_magnetometer(Job(rotated[1], tmp_path / "bare.yaml", tmp_path / "out"))
    assert report["scale_from"] == "the declared matrix"
    notes = report["notes"]
    assert isinstance(notes, list)
    assert any("scale" in note for note in notes)
    scaled = load_site(result / "site.yaml").platform.magnetometer.matrix
    estimate = load_site(tmp_path / "out" / "site.yaml").platform.magnetometer
    ratio = estimate.matrix / scaled
    assert np.ptp(np.diagonal(ratio)) < 1e-3
    # What only the declared matrix tells is as uncertain as that.
    assert np.min(np.diagonal(estimate.sigma.matrix)) > 0.01


def test_a_site_that_declares_no_sigma_gets_a_wide_prior(
    rotated: tuple[SimulatedLog, Path], result: Path, tmp_path: Path
) -> None:
    site = yaml.safe_load((rotated[1] / "site.yaml").read_text())
    del site["platform"]["magnetometer"]["sigma"]
    (tmp_path / "site.yaml").write_text(yaml.safe_dump(site))
    run_calibrate_magnetometer(Job(rotated[1], tmp_path / "site.yaml", tmp_path / "out"))
    wide = load_site(tmp_path / "out" / "site.yaml").platform.magnetometer
    usual = load_site(result / "site.yaml").platform.magnetometer
    np.testing.assert_allclose(wide.matrix, usual.matrix, rtol=0.0, atol=2e-3)
    np.testing.assert_allclose(wide.offset, usual.offset, rtol=0.0, atol=2e-9)


HARD_IRON = 9e-5 * np.array([0.6, 0.64, 0.48])  # T; twice the Earth's field


def with_hard_iron(
    rotated: tuple[SimulatedLog, Path],
    place: Path,
    sigma: float,
    end: float,
    field_world: bool = True,
) -> Path:
    """Write the turned log with a large hard iron, declared with a sigma (T)."""
    log, site = rotated[0].log, miscalibrated()
    assert log.waveform is not None
    kept = log.waveform.time < end
    waveform = Waveform(log.waveform.time[kept], log.waveform.measured_sensor[kept] + HARD_IRON)
    sensor = site.platform.magnetometer
    sensor = replace(sensor, sigma=replace(sensor.sigma, offset=np.full(3, sigma)))
    site = replace(site, platform=replace(site.platform, magnetometer=sensor))
    if not field_world:
        site = replace(site, earth_field_world=None)
    return write(replace(log, waveform=waveform), site, place)


@pytest.mark.parametrize("field_world", [pytest.param(True, marks=pytest.mark.slow), False])
def test_a_large_hard_iron_is_found_where_its_sigma_allows_it(
    field_world: bool, rotated: tuple[SimulatedLog, Path], tmp_path: Path
) -> None:
    log = with_hard_iron(rotated, tmp_path / "log", 3e-5, 30.0, field_world)
    report = run_calibrate_magnetometer(Job(log, None, tmp_path / "out"))
    result = load_site(tmp_path / "out" / "site.yaml").platform.magnetometer
    true = rotated[0].true_site.platform.magnetometer.offset + HARD_IRON
    assert np.max(np.abs(result.offset - true) / result.sigma.offset) < 3.5
    assert np.max(result.sigma.offset) < 5e-7
    assert report["verdict"] != "failed"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("end", "field_world"),
    [
        pytest.param(30.0, True, marks=pytest.mark.slow),
        pytest.param(12.0, True, marks=pytest.mark.slow),
        (12.0, False),
    ],
)
def test_a_hard_iron_beyond_its_sigma_is_never_called_determined(
    end: float, field_world: bool, rotated: tuple[SimulatedLog, Path], tmp_path: Path
) -> None:
    log = with_hard_iron(rotated, tmp_path / "log", 5e-7, end, field_world)
    with pytest.raises(EstimationError):
        run_calibrate_magnetometer(Job(log, None, tmp_path / "out"))
    assert not (tmp_path / "out" / "site.yaml").exists()


def test_what_is_kept_keeps_the_sigma_that_it_had(
    rotated: tuple[SimulatedLog, Path],
) -> None:
    simulated = rotated[0]
    log = simulated.log
    assert log.waveform is not None
    true = simulated.true_site.platform.magnetometer
    sigma = replace(true.sigma, matrix=np.full((3, 3), 0.003), offset=np.full(3, 3e-8))
    known = replace(true, sigma=sigma)
    site = miscalibrated()
    site = replace(site, platform=replace(site.platform, magnetometer=known))
    kept = log.waveform.time < 14.0  # in which one half tells little of the other
    waveform = Waveform(log.waveform.time[kept], log.waveform.measured_sensor[kept])
    result = calibrate_log(waveform, log.imu, site)
    assert result.shape_kept
    np.testing.assert_allclose(result.magnetometer.offset, known.offset, rtol=0.0, atol=0.0)
    np.testing.assert_allclose(result.magnetometer.sigma.offset, sigma.offset, rtol=1e-6)
    size = np.linalg.norm(result.magnetometer.matrix, axis=0) / np.linalg.norm(known.matrix, axis=0)
    np.testing.assert_allclose(size, 1.0, rtol=0.0, atol=0.02)
    assert np.all(np.diagonal(result.magnetometer.sigma.matrix) > 0.9 * 0.003)


def test_the_size_of_the_field_speaks_against_a_small_spread(
    rotated: tuple[SimulatedLog, Path],
) -> None:
    """Twelve seconds: the declared offset of zero leaves little spread, of a field too large."""
    log, site = rotated[0].log, miscalibrated()
    assert log.waveform is not None
    sensor = site.platform.magnetometer
    zero = np.zeros(3)
    none = replace(sensor.sigma, matrix=np.zeros((3, 3)), offset=zero)
    site = replace(site, platform=replace(site.platform, magnetometer=replace(sensor, sigma=none)))
    kept = log.waveform.time < 12.0
    waveform = Waveform(log.waveform.time[kept], log.waveform.measured_sensor[kept])
    result = calibrate_log(waveform, log.imu, site).magnetometer
    true = rotated[0].true_site.platform.magnetometer
    assert np.max(np.abs(result.offset - true.offset) / result.sigma.offset) < 3.5


@pytest.mark.slow
def test_twelve_stops_are_found_in_the_stream(tmp_path: Path) -> None:
    session = twelve_positions.record(twelve_positions.Config(), 12, np.random.default_rng(2))
    assert len(find_stops(session.log.imu, MotionModel())) == 12
    log = write(session.log, session.site, tmp_path / "log")
    run_command("calibrate", "magnetometer", log, "--positions", "-o", tmp_path / "out")
    assert report_of(tmp_path / "out")["readings"] == 12
    result = load_site(tmp_path / "out" / "site.yaml").platform.magnetometer
    np.testing.assert_allclose(result.matrix, session.true.matrix[0], rtol=0.0, atol=2e-3)
    np.testing.assert_allclose(result.offset, session.true.offset[0], rtol=0.0, atol=2e-8)


def test_too_few_stops_are_counted(tmp_path: Path, refuse: Refuse) -> None:
    session = twelve_positions.record(twelve_positions.Config(), 7, np.random.default_rng(2))
    log = write(session.log, session.site, tmp_path / "log")
    reported = refuse("calibrate", "magnetometer", log, "--positions", "-o", tmp_path / "out")
    assert "7 stops" in reported


def test_turning_without_a_rest_is_no_set_of_positions(
    rotated: tuple[SimulatedLog, Path], tmp_path: Path, refuse: Refuse
) -> None:
    given = ("--positions", "--start", 4, "--end", 55)
    reported = refuse("calibrate", "magnetometer", rotated[1], *given, "-o", tmp_path / "out")
    assert "no stationary interval" in reported


def test_a_level_walk_is_told_what_it_lacks(worked: Worked, tmp_path: Path) -> None:
    run_command("calibrate", "magnetometer", worked.log, "-o", tmp_path / "out")
    notes = report_of(tmp_path / "out")["notes"]
    assert "The sensor's x axis never pointed up or down." in notes
    assert "The sensor's z axis never pointed down." in notes


def test_a_sensor_that_was_not_turned_is_refused_in_words(tmp_path: Path, refuse: Refuse) -> None:
    run_command("simulate", "-o", tmp_path / "log", "--motion", "static", "--duration", 20)
    reported = refuse("calibrate", "magnetometer", tmp_path / "log", "-o", tmp_path / "out")
    assert "too few orientations" in reported
    assert "the sensor's x axis never pointed up" in reported


def test_a_short_log_is_refused(worked: Worked, tmp_path: Path, refuse: Refuse) -> None:
    given = ("--end", 5, "-o", tmp_path / "out")
    assert "readings" in refuse("calibrate", "magnetometer", worked.log, *given)


def test_phasors_alone_are_refused(worked: Worked, tmp_path: Path, refuse: Refuse) -> None:
    reported = refuse("calibrate", "magnetometer", worked.phasors, "-o", tmp_path / "out")
    assert "waveform" in reported


@pytest.mark.parametrize(("factor", "reported"), [(1e9, "nanotesla"), (np.nan, "field_x")])
def test_nanotesla_and_nan_are_refused(
    factor: float, reported: str, log: Path, tmp_path: Path, refuse: Refuse
) -> None:
    def spoil(columns: dict[str, Any]) -> None:
        columns["field_x"] = [factor * value for value in columns["field_x"]]

    change_table(log / "magnetometer.parquet", spoil)
    assert reported in refuse("calibrate", "magnetometer", log, "-o", tmp_path / "out")


@pytest.mark.parametrize("date", ["1899-12-31", "2030-06-01"])
def test_a_date_beyond_the_reference_field_is_refused(
    date: str, log: Path, tmp_path: Path, refuse: Refuse
) -> None:
    site = yaml.safe_load((log / "site.yaml").read_text())
    site["world"].pop("earth_field_t", None)
    place = {"latitude_deg": 41.8, "longitude_deg": 123.4, "height_m": 50.0, "date": date}
    site["world"]["location"] = place
    (log / "site.yaml").write_text(yaml.safe_dump(site))
    reported = refuse("calibrate", "magnetometer", log, "-o", tmp_path / "out")
    assert "1900-01-01 to 2030-01-01" in reported


def test_tones_average_out_of_the_steady_field(rotated: tuple[SimulatedLog, Path]) -> None:
    simulated = rotated[0]
    log, site = simulated.log, simulated.true_site
    assert log.waveform is not None
    readings = static_field(log.waveform, log.imu, site)
    attitude = simulated.motion.world_from_body(readings.time)
    assert site.earth_field_world is not None
    sensor = site.platform.magnetometer
    clean = attitude.inv().apply(site.earth_field_world) @ sensor.body_from_sensor
    expected = clean @ sensor.matrix.T + sensor.offset
    remaining = readings.measured_sensor - expected
    raw = np.ptp(log.waveform.measured_sensor[: int(0.05 * 400)], axis=0)
    assert np.max(raw) > 1e-7  # T; what the tones do to a sample
    assert np.sqrt(np.mean(remaining**2)) < 2e-9
    resting = readings.time < 1.7
    up = attitude[resting].inv().apply([0.0, 0.0, site.gravity])
    bias = 3.0 * np.sqrt(3.0) * site.platform.imu.accel_bias_sigma
    assert np.max(np.linalg.norm(readings.accel_body[resting] - up, axis=1)) < bias


def test_windows_with_a_gap_are_left_out(rotated: tuple[SimulatedLog, Path]) -> None:
    log, site = rotated[0].log, rotated[0].true_site
    assert log.waveform is not None
    whole = static_field(log.waveform, log.imu, site)
    for stream in ("waveform", "imu"):
        time = getattr(log, stream).time
        kept = (time < 20.0) | (time > 23.0)
        waveform, imu = log.waveform, log.imu
        if stream == "waveform":
            waveform = Waveform(time[kept], waveform.measured_sensor[kept])
        else:
            imu = ImuSamples(time[kept], imu.gyro_body[kept], imu.accel_body[kept])
        cut = static_field(waveform, imu, site)
        assert not np.any((cut.time > 20.0) & (cut.time < 23.0))
        assert len(whole) - 10 <= len(cut) <= len(whole) - 7
        others = np.isin(np.round(whole.time, 6), np.round(cut.time, 6))
        np.testing.assert_allclose(
            cut.measured_sensor, whole.measured_sensor[others], rtol=0.0, atol=1e-12
        )


def test_a_tone_too_low_to_average_out_is_refused() -> None:
    site = demo_site()
    slow = replace(site.beacons[0], frequency_hz=2.0)
    with pytest.raises(InputError, match="2 Hz"):
        window_length(replace(site, beacons=(slow,)))


@pytest.mark.slow
@needs_shared_logs
@pytest.mark.parametrize(
    ("name", "gain"),
    [("turn_miscalibrated", 3.0), ("walk_unsynchronised", 3.0), ("walk_calibrated", 1.0)],
)
@pytest.mark.parametrize("half", [0, 1])
def test_real_motion_calibrates_one_half_and_the_other_profits(
    name: str, gain: float, half: int, tmp_path: Path
) -> None:
    parts: list[tuple[float | None, float | None]] = [(None, 90.0), (90.0, None)]
    own, other = parts[half], parts[1 - half]
    site = load_site(LOGS / name / "site.yaml")
    output = tmp_path / "out"
    run_calibrate_magnetometer(Job(LOGS / name, None, output, start=own[0], end=own[1]))
    result = load_site(output / "site.yaml").platform.magnetometer
    for part in (own, other):
        log = open_log(LOGS / name, *part)
        before = spread_of(log, site, site.platform.magnetometer)
        after = spread_of(log, site, result)
        # A rotation of the sensor changes the averaging within a window, by next to nothing.
        assert after * gain <= before * (1.0 + 1e-4), (before, after)
