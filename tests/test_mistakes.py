"""The suite of mistakes: each can be made, and what is silent is counted as such."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mistake_case import LOGS, good_case
from mistake_list import GOOD, MISTAKES
from mistakes import Config, Row, run, summed, table

from magfusion.files.site import save_site
from magfusion.model.trust import CODES

ROW = Row(
    mistake="lever_20cm",
    log="moving",
    estimator="smooth",
    exit=0,
    verdict="trustworthy",
    codes=(),
    text="",
    unverified=(),
    error_m=0.2,
    error_deg=0.1,
    claimed_m=0.002,
    claimed_deg=0.1,
    nees=5000.0,
    seconds=1.0,
)


@pytest.mark.slow
def test_there_are_enough_and_every_one_can_be_made(tmp_path: Path) -> None:
    assert len(MISTAKES) >= 60
    good = good_case("moving", 1)
    for mistake in MISTAKES.values():
        case = mistake.change(good)
        if mistake.name == "earth_in_gauss":  # no file may say so
            continue
        save_site(case.site, tmp_path / "site.yaml")
        imu_same = np.array_equal(case.imu.time, good.imu.time) and np.array_equal(
            np.hstack([case.imu.gyro_body, case.imu.accel_body]),
            np.hstack([good.imu.gyro_body, good.imu.accel_body]),
        )
        wave_same = np.array_equal(case.waveform.time, good.waveform.time) and np.array_equal(
            case.waveform.measured_sensor, good.waveform.measured_sensor
        )
        assert case.site is not good.site or not (imu_same and wave_same), mistake.name
    assert GOOD.change(good) is good


def test_silent_is_what_is_wrong_and_neither_said_nor_listed() -> None:
    assert ROW.silent
    assert not replace(ROW, nees=10.0).silent
    assert not replace(ROW, verdict="doubtful").silent
    assert not replace(ROW, unverified=("sensor.position_x_m",)).silent
    assert replace(ROW, unverified=("sensor.rotation_x_deg",)).silent
    good = replace(ROW, mistake="good", nees=6.0)
    right = replace(ROW, verdict="doubtful", codes=("lever_arm",), seconds=4.0)
    rows = [good, ROW, right, replace(right, codes=("geometry",), seconds=1.0)]
    result = summed(rows)
    assert result.silent == ("lever_20cm (moving, smooth)",)
    assert result.right_first == pytest.approx(1.0 / 3.0)
    assert result.slow == ("lever_20cm (moving, smooth)",)
    assert "SILENT" in table(rows)


@pytest.mark.slow
def test_a_few_mistakes_on_each_log_make_no_traceback() -> None:
    few = ("lever_20cm", "magnetometer_in_nt", "false_20pct_15s")
    rows = run(Config(mistakes=few, estimators=("smooth",)), {"workers": 1})
    assert len(rows) == 4 * len(LOGS)
    assert not summed(rows).tracebacks
    assert all(row.exit == 2 for row in rows if row.mistake == "magnetometer_in_nt")
    assert set(code for row in rows for code in row.codes) <= set(CODES)


@pytest.mark.slow
def test_logs_without_a_start_are_navigated_to_their_end() -> None:
    """Their checkpoints are written while corrections are known."""
    few = Config(("magnetometer_held_2", "epoch_3ms"), ("moving",), ("ekf",))
    rows = run(few, {"workers": 1})
    assert not summed(rows).tracebacks


@pytest.mark.slow
def test_online_the_frame_is_open_until_motion_shows_which_sensor_is_turned() -> None:
    """The start takes the IMU's; the lever arm then contradicts it, and the rival is tried."""
    few = Config(("mounting_x180",), ("rough",), ("ekf",), seed=12)
    row = next(row for row in run(few, {"workers": 1}) if row.mistake != "good")
    assert row.right
    assert "magnetometer's axes are turned" in row.text
    assert row.nees is not None
    assert 1.0 < row.nees < 12.6  # 95 % of chi square of six


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mistake", "log", "code"),
    [
        # Snapshots along a level walk know the lever arm's height to centimetres.
        ("lever_20cm", "moving", "lever_arm"),
        ("lever_in_cm", "rough", "lever_arm"),
        # Only the lever arm tells in which of two frames the result is.
        ("mounting_z90", "moving", "mounting"),
        ("imu_ned", "moving", "mounting"),
    ],
)
def test_what_motion_contradicts_is_corrected_as_if_it_had_been_right(
    mistake: str, log: str, code: str
) -> None:
    few = Config((mistake,), (log,), ("smooth",), remedies=True)
    good, wrong = run(few, {"workers": 1})
    assert wrong.codes[0] == code
    assert wrong.error_m < 2.0 * good.error_m
    assert wrong.claimed_m < 2.0 * good.claimed_m
    assert wrong.error_deg < 1.1 * good.error_deg
    assert wrong.remedy == "works"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("estimator", "mistakes"),
    [
        ("ekf", ("accel_bias", "gyro_deg_s", "gyro_x_sign", "magnetometer_clock_20ppm")),
        ("smooth", ("gyro_bias", "gyro_sign", "survey_ned", "survey_tilted_5deg")),
        ("smooth", ("epoch_12ms", "magnetometer_50ms_late", "drives_free_running")),
        ("ekf", ("epoch_12ms", "magnetometer_50ms_late", "drives_free_running")),
        ("smooth", ("magnetometer_xy_swapped", "magnetometer_z_sign", "imu_clock_1000ppm")),
        ("ekf", ("magnetometer_xy_swapped", "magnetometer_z_sign")),
        # A common drift of all drives is their frequencies or the magnetometer's clock.
        ("smooth", ("frequencies_200ppm", "magnetometer_clock_1000ppm")),
    ],
)
def test_units_signs_biases_and_frames_are_undone_and_their_remedies_work(
    estimator: str, mistakes: tuple[str, ...]
) -> None:
    good, *rows = run(Config(mistakes, ("moving",), (estimator,), remedies=True), {"workers": 1})
    for row in rows:
        assert row.right, row.mistake
        assert row.remedy == "works", row.mistake
        assert row.error_m < 2.0 * good.error_m, row.mistake


@pytest.mark.slow
@pytest.mark.parametrize("estimator", ["smooth", "ekf"])
def test_a_bias_that_jumps_is_followed(estimator: str) -> None:
    mistakes = ("gyro_bias_steps", "accel_bias_steps")
    good, *rows = run(Config(mistakes, ("moving",), (estimator,), remedies=True), {"workers": 1})
    for row in rows:
        assert row.codes == ("changed",), row.mistake
        assert row.error_m < 2.0 * good.error_m, row.mistake
        assert row.claimed_m < 2.0 * good.claimed_m, row.mistake
        assert row.nees is not None
        assert 1.0 < row.nees < 12.6, row.mistake  # 95 % of chi square of six
        assert row.remedy == "works", row.mistake


@pytest.mark.slow
def test_a_step_that_explains_a_log_as_well_is_not_undone() -> None:
    """No site has a parameter that changes."""
    few = Config(("beacon_reversed",), ("rough",), ("ekf",), seed=15)
    assert not summed(run(few, {"workers": 1})).tracebacks
