"""Amplitudes without sign in estimators that follow the motion."""

from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
import unsigned_amplitudes as scenario
from conftest import Refuse
from scipy.spatial.transform import Rotation

from magfusion.errors import InputError
from magfusion.estimation.graph.state import States
from magfusion.estimation.measurements.phasors import FieldPhasors, field_phasors
from magfusion.estimation.measurements.signs import along_axis, count_open, with_signs
from magfusion.estimation.online.navigator import Navigator, NavigatorSettings
from magfusion.files.log import write_log
from magfusion.files.named_records import site_fields
from magfusion.files.site import save_site
from magfusion.files.stream import json_line, read_records
from magfusion.files.stream_contents import fields_content
from magfusion.model.parameters import Calibration, initial_calibration, predict_channels
from magfusion.model.samples import FieldSamples, ImuSamples, Log
from magfusion.model.trajectory import Trajectory

COUNT, STEP = 5, 1e-6


def poses() -> Trajectory:
    rng = np.random.default_rng(2)
    place = rng.uniform(*scenario.BOX, (COUNT, 3))
    return Trajectory(0.1 * np.arange(COUNT), Rotation.random(COUNT, rng).as_matrix(), place)


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    return initial_calibration(scenario.floor(), 0.0)


def amplitudes(calibration: Calibration, truth: Trajectory, sigma: float) -> FieldSamples:
    site = calibration.site
    seen = predict_channels(calibration, truth.time, truth.world_from_body, truth.position_world)
    phasor = np.full_like(seen, np.nan)
    phasor[..., 0] = np.abs(seen[..., 2])
    cov = np.broadcast_to(sigma**2 * np.eye(3), (*phasor.shape, 3)).copy()
    window, channels = np.full(COUNT, 0.1), site.channels
    result = FieldSamples(truth.time, window, channels, phasor, cov, axes="x", signed=False)
    return along_axis(result, site)


def measured(calibration: Calibration, samples: FieldSamples, truth: Trajectory) -> FieldPhasors:
    none, zero = np.zeros(COUNT), np.zeros((COUNT, 3))
    own = with_signs(samples, truth, calibration)
    return field_phasors(calibration.site, own, np.arange(COUNT), truth, zero, none, 1.0)


def states(rotation: np.ndarray, position: np.ndarray) -> States:
    zero = np.zeros((COUNT, 3))
    return States(rotation, position, zero, lambda: np.zeros((COUNT, 6)))


def test_the_rows_are_the_derivatives_of_amplitudes(calibration: Calibration) -> None:
    truth = poses()
    samples = amplitudes(calibration, truth, 1e-10)
    phasors = measured(calibration, samples, truth)
    rows = phasors.linearize(states(truth.world_from_body, truth.position_world), calibration, ())
    np.testing.assert_allclose(rows.error, 0.0, atol=1e-6)
    assert rows.by_pose is not None
    detected = np.any(phasors.sqrt_information != 0.0, axis=(2, 3))
    root = np.sqrt(np.sum(phasors.sqrt_information**2, axis=(2, 3)))
    assert np.array_equal(np.linalg.matrix_rank(phasors.sqrt_information), detected.astype(int))
    for axis in range(6):
        sides = []
        for sign in (1.0, -1.0):
            step = np.zeros(6)
            step[axis] = sign * STEP
            turn = truth.world_from_body @ Rotation.from_rotvec(step[:3]).as_matrix()
            place = truth.position_world + truth.world_from_body @ step[3:]
            seen = predict_channels(calibration, truth.time, turn, place)
            sides.append(np.abs(seen[..., 2]))
        slope = root * (sides[0] - sides[1]) / (2.0 * STEP)
        result = np.sum(rows.by_pose[..., axis], axis=2)
        np.testing.assert_allclose(
            result[detected], slope[detected], rtol=1e-4, atol=1e-3 * root.max()
        )


def test_what_is_predicted_near_zero_is_left_out_and_counted(calibration: Calibration) -> None:
    truth = poses()
    samples = amplitudes(calibration, truth, 3e-9)
    seen = predict_channels(calibration, truth.time, truth.world_from_body, truth.position_world)
    result = with_signs(samples, truth, calibration)
    size = np.abs(seen[..., 2])
    assert count_open(samples, result) == np.sum(~result.valid) > 0
    assert not result.valid[size < 4.0 * 3e-9].any()
    assert result.valid[size > 6.0 * 3e-9].all()
    kept = result.valid
    np.testing.assert_allclose(result.phasor_sensor[kept, 2], seen[kept, 2], rtol=1e-9)
    wide = replace(truth, pose_cov=np.tile(0.1**2 * np.eye(6), (COUNT, 1, 1)))
    assert np.sum(with_signs(samples, wide, calibration).valid) < np.sum(kept)
    assert np.all(result.numbers == result.valid)
    assert np.array_equal(np.sum(result.is_measured, axis=2), result.valid)


def test_amplitudes_are_of_one_axis(calibration: Calibration) -> None:
    site, samples = calibration.site, amplitudes(calibration, poses(), 1e-10)
    assert samples.axes == "z"
    sensor = replace(site.platform.magnetometer, axes="xyz")
    whole = replace(site, platform=replace(site.platform, magnetometer=sensor))
    with pytest.raises(InputError, match="amplitudes, which are of a receiver of one axis"):
        along_axis(samples, whole)


def test_jobs_that_take_no_amplitudes_say_so(
    calibration: Calibration, tmp_path: Path, refuse: Refuse
) -> None:
    fields = amplitudes(calibration, poses(), 1e-10)
    write_log(Log("few", 0, "test", ImuSamples.empty(), fields=fields), tmp_path / "log")
    save_site(calibration.site, tmp_path / "log" / "site.yaml")
    findings = refuse("check", tmp_path / "log")
    assert "unsigned amplitudes are supported by fix, smooth and navigate only" in findings


def test_the_pipe_takes_amplitudes_as_a_log_has_them(calibration: Calibration) -> None:
    site, samples = calibration.site, amplitudes(calibration, poses(), 1e-10)
    lines = b"".join(json_line(fields_content(one)) for one in samples.epochs())
    for number, numbered in enumerate(read_records(BytesIO(lines), "json")):
        assert numbered.record is not None
        assert numbered.record.fields is not None
        result = along_axis(site_fields(numbered.record.fields, site), site)
        one = samples.rows(slice(number, number + 1))
        assert not result.signed
        assert result.axes == one.axes
        assert np.array_equal(result.phasor_sensor, one.phasor_sensor, equal_nan=True)
        assert np.array_equal(result.phasor_cov, one.phasor_cov, equal_nan=True)


@pytest.mark.parametrize(
    ("fields", "findings"),
    [
        ({"amplitudes": {"C0": [-1e-9]}, "sigma": 1e-10}, "an amplitude has no sign"),
        ({"sigma": 1e-10}, "either phasors or amplitudes"),
        ({"amplitudes": {"C0": [1e-9]}}, "either sigma or covariance"),
    ],
)
def test_what_is_no_record_of_amplitudes_is_refused(
    fields: dict[str, object], findings: str
) -> None:
    line = json_line({"fields": {"time": 0.0, "window": 0.1, **fields}})
    (result,) = read_records(BytesIO(line), "json")
    assert result.record is None
    assert findings in result.refusal


def test_amplitudes_among_phasors_are_refused(calibration: Calibration) -> None:
    site, samples = calibration.site, amplitudes(calibration, poses(), 1e-10)
    navigator = Navigator(site, NavigatorSettings("ekf"))
    navigator.add_fields(samples.rows(slice(0, 1)))
    with pytest.raises(InputError, match="amplitudes without sign are mixed with phasors"):
        navigator.add_fields(replace(samples.rows(slice(1, 2)), signed=True))


@pytest.mark.slow
def test_amplitudes_are_worth_what_phasors_are() -> None:
    assert not scenario.faults_of(scenario.rows_of(1, 8.0))
