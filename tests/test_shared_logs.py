"""The three logs with real inertial motion, through the whole pipeline and its files."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from evo.core.metrics import APE, PoseRelation, StatisticsType
from evo.core.trajectory import PoseTrajectory3D
from evo.tools import file_interface
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from magfusion.estimation.batch.batch import SmootherSettings
from magfusion.files.open import open_log
from magfusion.files.site import load_site
from magfusion.files.trajectory_table import read_trajectory
from magfusion.jobs.inputs import Job
from magfusion.jobs.smooth import run_smooth
from magfusion.model.samples import Log
from magfusion.model.truth_poses import truth_poses
from magfusion.results.errors import TrajectoryErrors, trajectory_errors

LOGS = Path(__file__).parents[1].parent / "shared" / "logs"
THREE_SIGMA_SQUARE = chi2.ppf(0.9973, 3)  # the three-sigma ellipsoid of a position
needs_shared_logs = pytest.mark.skipif(
    not LOGS.is_dir(), reason="the shared logs are not beside the repository"
)


@dataclass(frozen=True, eq=False)
class Result:
    """What `run_smooth` wrote, read back."""

    directory: Path
    log: Log
    report: dict[str, Any]
    errors: TrajectoryErrors


def smoothed(name: str, directory: Path) -> Result:
    figures = run_smooth(Job(LOGS / name, None, directory), SmootherSettings())
    log = open_log(LOGS / name)
    report = json.loads((directory / "report.json").read_text())
    assert report.keys() == figures.keys()
    assert log.truth is not None
    estimate = read_trajectory(directory / "trajectory.parquet", log.epoch_ns)
    return Result(directory, log, report, trajectory_errors(estimate, log.truth))


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Result:
    return smoothed("walk_calibrated", tmp_path_factory.mktemp("walk") / "result")


def centimetres(metres: float) -> float:
    return 100.0 * metres


def position_inside_3_sigma(errors: TrajectoryErrors) -> float:
    """Return the share of epochs whose position error is within three sigma in every direction."""
    assert errors.pose_cov is not None
    error, cov = errors.pose_body[:, 3:], errors.pose_cov[:, 3:, 3:]
    square = np.einsum("ni,ni->n", error, np.linalg.solve(cov, error[..., None])[..., 0])
    return float(np.mean(square < THREE_SIGMA_SQUARE))


@pytest.mark.slow
@needs_shared_logs
def test_a_walk_with_an_exact_survey_is_found_to_millimetres(walk: Result) -> None:
    assert walk.report["converged"]
    assert centimetres(walk.errors.ate) <= 0.6
    assert walk.errors.attitude_rmse_deg <= 0.2
    assert position_inside_3_sigma(walk.errors) >= 0.99


@pytest.mark.slow
@needs_shared_logs
def test_the_report_says_what_the_written_trajectory_is(walk: Result) -> None:
    errors = walk.errors
    assert walk.report["ate_m"] == pytest.approx(errors.ate, rel=1e-6)
    assert walk.report["attitude_rmse_deg"] == pytest.approx(errors.attitude_rmse_deg, rel=1e-6)
    assert walk.report["position_inside_3_sigma"] >= 0.99
    assert np.isfinite([v for v in walk.report.values() if isinstance(v, float)]).all()


@pytest.mark.slow
@needs_shared_logs
def test_evo_finds_the_same_errors_in_the_tum_file(walk: Result) -> None:
    estimate = file_interface.read_tum_trajectory_file(walk.directory / "trajectory.tum")
    assert estimate.check()[0]
    assert walk.log.truth is not None
    stamps = estimate.timestamps - walk.log.epoch_ns * 1e-9
    true, exists, _ = truth_poses(walk.log.truth, stamps)
    estimate.reduce_to_ids(np.flatnonzero(exists))
    quaternion = Rotation.from_matrix(true.world_from_body).as_quat(scalar_first=True)
    truth = PoseTrajectory3D(true.position_world, quaternion, estimate.timestamps)
    result = {}
    for part in (PoseRelation.translation_part, PoseRelation.rotation_angle_deg):
        metric = APE(part)
        metric.process_data((truth, estimate))
        result[part] = metric.get_statistic(StatisticsType.rmse)
    position = result[PoseRelation.translation_part]
    angle = result[PoseRelation.rotation_angle_deg]
    assert estimate.num_poses > 900
    assert centimetres(position) <= 0.6
    assert angle <= 0.2
    assert position == pytest.approx(walk.errors.ate, rel=1e-4)
    assert angle == pytest.approx(walk.errors.attitude_rmse_deg, rel=1e-3)


@pytest.mark.slow
@needs_shared_logs
def test_the_written_site_can_be_fed_back_in(walk: Result, tmp_path: Path) -> None:
    site = load_site(walk.directory / "site.yaml")
    declared = load_site(LOGS / "walk_calibrated" / "site.yaml")
    assert site.platform.imu.time_offset == pytest.approx(walk.report["time_offset_s"], abs=1e-9)
    assert site.platform.imu.time_offset_sigma < 0.5 * declared.platform.imu.time_offset_sigma
    assert site.calibration is not None
    job = Job(LOGS / "walk_calibrated", walk.directory / "site.yaml", tmp_path / "again", end=20.0)
    figures = run_smooth(job, SmootherSettings())
    assert figures["converged"]
    assert isinstance(figures["ate_m"], float)
    assert centimetres(figures["ate_m"]) <= 0.6


@needs_shared_logs
@pytest.mark.slow
def test_a_turn_with_a_bad_survey_is_found_and_the_survey_mended(tmp_path: Path) -> None:
    turn = smoothed("turn_miscalibrated", tmp_path / "result")
    assert turn.report["converged"]
    assert centimetres(turn.errors.aligned_ate) <= 0.7
    assert turn.errors.aligned_attitude_rmse_deg <= 0.3
    assert position_inside_3_sigma(turn.errors) >= 0.99
    assert turn.report["held_aligned_ate_m"] > 2.0 * turn.report["aligned_ate_m"]
    # A robust loss and tuned noise take a part of what a survey that is held costs.
    assert (
        turn.report["held_aligned_attitude_rmse_deg"] > 1.5 * turn.errors.aligned_attitude_rmse_deg
    )
    # Where the room itself stands is the mean error of the survey, which no log of it can mend:
    # the absolute errors of both are as large as they claim, and neither need be the smaller.
    assert turn.report["ate_m"] < 3.0 * np.sqrt(3.0) * turn.report["position_sigma_median_m"]


@needs_shared_logs
@pytest.mark.slow
def test_a_walk_with_free_clocks_and_a_bad_survey_is_found(tmp_path: Path) -> None:
    free_parameters = smoothed("walk_unsynchronised", tmp_path / "result")
    assert free_parameters.report["converged"]
    assert centimetres(free_parameters.errors.aligned_ate) <= 0.8
    assert free_parameters.errors.aligned_attitude_rmse_deg <= 0.3
    assert position_inside_3_sigma(free_parameters.errors) >= 0.99
    assert free_parameters.report["held_aligned_ate_m"] > free_parameters.report["aligned_ate_m"]
    assert any("drift" in name for name in free_parameters.report["determined"])
