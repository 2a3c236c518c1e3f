"""The static field by the poses against the Earth's as declared: one test online and offline."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from magfusion.estimation.batch.batch import smooth
from magfusion.estimation.data_checks.static_field import off_earth
from magfusion.estimation.integrity.judge import judge_result
from magfusion.model.trust import Verdict
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import SimulationConfig, simulate_log
from magfusion.units import DEGREE, Array

SITE = demo_site()
EXACT = np.zeros((3, 3))


def _earth() -> Array:
    assert SITE.earth_field_world is not None
    return SITE.earth_field_world


def _rotated(angle_deg: float) -> Array:
    return np.asarray(Rotation.from_rotvec([0.0, 0.0, angle_deg * DEGREE]).apply(_earth()))


@pytest.mark.parametrize("angle_deg", [-120.0, 30.0])
def test_a_turn_about_the_vertical_is_one_of_the_surveys_axes(angle_deg: float) -> None:
    off = off_earth(SITE, _rotated(angle_deg) - _earth(), EXACT)
    assert off is not None
    assert off.of_survey
    assert off.turn == pytest.approx(abs(angle_deg) * DEGREE, abs=1e-9)
    assert f"{angle_deg:+.0f} deg about the vertical" in off.finding.text
    place = np.array([3.0, 4.0, 7.0])
    moved = Rotation.from_rotvec([0.0, 0.0, angle_deg * DEGREE]).apply(place) - place
    assert off.shift(place) == pytest.approx(float(np.linalg.norm(moved)))


def test_what_the_declaration_allows_is_not_said() -> None:
    declination_deg = SITE.earth.declination_sigma / DEGREE
    assert off_earth(SITE, _rotated(2.0 * declination_deg) - _earth(), EXACT) is None
    assert off_earth(replace(SITE, earth_field_world=None), _earth(), EXACT) is None


def test_a_heading_that_is_not_known_tells_nothing_of_the_survey() -> None:
    unknown = np.diag([0.0, 0.0, 0.5**2])  # rad^2
    remaining = _rotated(30.0) - _earth()
    assert off_earth(SITE, remaining, unknown) is None
    steeper = np.diag([0.5**2, 0.0, 0.0])
    assert off_earth(SITE, remaining, steeper) is not None


def test_another_size_is_no_turn() -> None:
    off = off_earth(SITE, 0.4 * _earth(), EXACT)
    assert off is not None
    assert not off.of_survey
    assert off.turn == pytest.approx(0.4)
    assert off.shift(np.ones(3)) == 0.0
    assert "magnetometer's axes and scale" in off.finding.text


@pytest.mark.slow
def test_a_smoothed_log_is_doubted_where_the_survey_has_other_axes() -> None:
    rng = np.random.default_rng(3)
    log = simulate_log(SITE, SimulationConfig(DEMO_BOX_WORLD, duration=16.0), rng).log
    _, right = judge_result(smooth(log, SITE), log)
    assert right.verdict is Verdict.TRUSTWORTHY
    site = replace(SITE, earth_field_world=_rotated(30.0))
    result, wrong = judge_result(smooth(log, site), log)
    assert wrong.verdict is Verdict.DOUBTFUL
    assert wrong.reasons[0].code == "earth_field"
    cov = result.states.pose_cov
    assert cov is not None
    assert np.all(np.sqrt(cov[:, 2, 2]) > 25.0 * DEGREE)
    horizontal = np.linalg.norm(result.states.position_world[:, :2], axis=1)
    assert np.all(np.sqrt(cov[:, 3, 3]) > 0.5 * horizontal)
