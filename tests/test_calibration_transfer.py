"""Two halves of a real log tell one calibration, and each makes the other's trajectory better."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from magfusion.estimation.batch.batch import Smoothed, SmootherSettings, smooth
from magfusion.files.open import open_log
from magfusion.files.site import load_site
from magfusion.model.parameters import difference, prior_sigma
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.results.errors import TrajectoryErrors, trajectory_errors
from magfusion.results.observability import gauge_basis, observability
from magfusion.results.refinement import result_site
from magfusion.results.transfer import Estimated, agreement

LOGS = Path(__file__).parents[1].parent / "shared" / "logs"
NAMES = ("turn_miscalibrated", "walk_unsynchronised")
HALF = 90.0  # s since the log's epoch
CALIBRATING = SmootherSettings(loss=None, tune=False)
HELD_CASES = SmootherSettings(estimate=("phase", "time-offset"), loss=None, tune=False)
# Ten seconds for a half of a log, eight of them: the job itself is tested on a simulated log.
pytestmark = [
    pytest.mark.skipif(not LOGS.is_dir(), reason="the shared logs are not beside the repository"),
    pytest.mark.slow,
]


@dataclass(frozen=True, eq=False)
class Halves:
    """Both halves of a log, each with a calibration of its own."""

    site: Site
    logs: tuple[Log, Log]
    results: tuple[Smoothed, Smoothed]


@pytest.fixture(scope="module", params=NAMES)
def halves(request: pytest.FixtureRequest) -> Halves:
    path = LOGS / request.param
    # A model error that is constant in place leaves fewer directions determined.
    site = replace(load_site(path / "site.yaml"), model_error_length=0.0)
    logs = (open_log(path, end=HALF), open_log(path, start=HALF))
    return Halves(site, logs, tuple(smooth(log, site, CALIBRATING) for log in logs))


def estimated(result: Smoothed) -> Estimated:
    return Estimated(result.declared, result.calibration, result.blocks, result.calibration_cov)


def compared(halves: Halves) -> np.ndarray:
    return agreement(*(estimated(result) for result in halves.results))


def test_the_halves_agree_within_3_sigma(halves: Halves) -> None:
    result = compared(halves)
    assert len(result) >= 30  # directions that both determined
    assert np.max(np.abs(result)) < 3.0
    # Were the sigmas far too large they would agree just as well.
    assert np.sqrt(np.mean(result**2)) > 0.3


def test_nothing_but_the_survey_speaks_along_the_gauge(halves: Halves) -> None:
    """No log can tell, so that both halves stay where the survey was: agreement without proof."""
    for result in halves.results:
        reported = observability(result.calibration, result.blocks, result.calibration_cov)
        assert len(reported.gauge) >= 8
        assert min(one.ratio for one in reported.gauge) > 0.9
        # The frame is that of the calibration found, a few degrees from that of the survey.
        basis = gauge_basis(result.declared, result.blocks)[:, :4]
        step = difference(result.declared, result.calibration, result.blocks)
        moved = basis.T @ (step / prior_sigma(result.blocks))
        assert np.max(np.abs(moved)) < 0.2


def scored(log: Log, site: Site) -> TrajectoryErrors:
    assert log.truth is not None
    return trajectory_errors(smooth(log, site, HELD_CASES).states, log.truth)


def refined(result: Smoothed, log: Log) -> Site:
    return result_site(result, log.name)


def test_calibrating_on_one_half_lowers_the_other_halfs_error(halves: Halves) -> None:
    for mine, other in ((0, 1), (1, 0)):
        before = scored(halves.logs[other], halves.site)
        after = scored(halves.logs[other], refined(halves.results[mine], halves.logs[mine]))
        assert after.aligned_ate < 0.5 * before.aligned_ate
        assert after.aligned_attitude_rmse_deg < 0.7 * before.aligned_attitude_rmse_deg
