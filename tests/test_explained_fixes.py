"""What a fix frees by itself: nothing, a beacon, or all gains, as little as explains the fields."""

from dataclasses import replace

import numpy as np
import pytest
from paper_rooms import S0, draw_world, ring
from test_gain_spread import error, scaled
from tracker_site import body_poses, tracker_site

from magfusion.estimation.snapshot.explained_fixes import ExplainedFixes, explained_fixes
from magfusion.estimation.snapshot.likelihood import fix_epochs
from magfusion.model.parameters import initial_calibration
from magfusion.model.samples import FieldSamples
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.model.trust import Verdict
from magfusion.simulation.log import simulate_fields

TARGETS = 40
FOUR = ring(4)


@pytest.fixture(scope="module")
def room() -> tuple[Site, FieldSamples, np.ndarray]:
    """Four beacons and noise alone: site, fields and where they are."""
    rng = np.random.default_rng(8)
    world = draw_world(S0, rng, FOUR, model_error=0.01)
    targets = FOUR.draw_targets(rng, TARGETS)
    return world.site, world.measure(targets, np.eye(3), rng), targets


def explained(
    site: Site, samples: FieldSamples, free_parameters: tuple[str, ...] = ()
) -> ExplainedFixes:
    return explained_fixes(
        samples, initial_calibration(site, 0.0), survey_error=False, free_parameters=free_parameters
    )


def codes(result: ExplainedFixes) -> list[str]:
    return [finding.code for finding in result.trust.findings]


def moved(site: Site, count: int, step: float = 0.5) -> Site:
    """Return a site in which some beacons stand elsewhere than they are."""
    shifts = step * np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [-1.0, 0.0, 0.0]])[:count]
    placed = tuple(
        replace(beacon, position_world=beacon.position_world + shift)
        for beacon, shift in zip(site.beacons, shifts, strict=False)
    )
    return replace(site, beacons=placed + site.beacons[count:])


def scattered(samples: FieldSamples) -> FieldSamples:
    gains = np.random.default_rng(9).normal(0.0, 0.15, (TARGETS, 4))
    return scaled(samples, gains)


def test_where_nothing_errs_the_fixes_are_those_with_gains_held_bit_for_bit(
    room: tuple[Site, FieldSamples, np.ndarray],
) -> None:
    site, samples, _ = room
    result = explained(site, samples)
    fixed = fix_epochs(samples, initial_calibration(site, 0.0), survey_error=False)
    assert result.gain_spread == 0.0
    assert result.trust.verdict is Verdict.TRUSTWORTHY
    for name in ("position_world", "world_from_body", "pose_cov", "log_gain"):
        np.testing.assert_array_equal(getattr(result.fixes, name), getattr(fixed, name))


def test_a_beacon_that_stands_elsewhere_is_left_out_and_gains_are_held(
    room: tuple[Site, FieldSamples, np.ndarray],
) -> None:
    site, samples, targets = room
    result = explained(moved(site, 1), samples)
    assert codes(result) == ["beacon_excluded"]
    assert f"beacon {site.beacons[0].name} " in result.trust.findings[0].text
    assert result.gain_spread == 0.0
    assert error(result.fixes, targets) < 2.0 * error(explained(site, samples).fixes, targets)
    # Who asks for gains gets them, and a fix that is worse.
    assert explained(moved(site, 1), samples, ("gain",)).gain_spread > 0.0


def test_gains_that_err_from_place_to_place_are_freed_unasked(
    room: tuple[Site, FieldSamples, np.ndarray],
) -> None:
    site, samples, targets = room
    samples = scattered(samples)
    result = explained(site, samples)
    assert codes(result) == ["gain_spread"]
    assert result.trust.verdict is Verdict.TRUSTWORTHY
    assert result.gain_spread == pytest.approx(0.15, rel=0.3)
    fixed = fix_epochs(samples, initial_calibration(site, 0.0), survey_error=False)
    assert error(result.fixes, targets) < 0.2 * error(fixed, targets)
    off = np.linalg.norm(result.fixes.position_world[:, 0] - targets, axis=1)
    sigma = np.sqrt(np.trace(result.fixes.pose_cov[:, 0, 3:, 3:], axis1=1, axis2=2))
    assert np.mean(off < 3.0 * sigma) > 0.95


@pytest.mark.slow
def test_a_survey_that_gains_do_not_explain_stays_in_doubt_without_them(
    room: tuple[Site, FieldSamples, np.ndarray],
) -> None:
    site, samples, _ = room
    result = explained(moved(site, 3), samples.rows(slice(0, 15)))
    assert result.gain_spread == 0.0
    assert result.trust.verdict is not Verdict.TRUSTWORTHY
    assert "gain_spread" not in codes(result)


def test_too_few_epochs_free_nothing(room: tuple[Site, FieldSamples, np.ndarray]) -> None:
    site, samples, _ = room
    assert explained(site, scattered(samples).rows(slice(0, 6))).gain_spread == 0.0


def test_the_gain_of_a_lone_beacon_is_its_range_and_stays_held() -> None:
    rng = np.random.default_rng(4)
    site = tracker_site(rng, gain=0.0, tilt=0.0, centre=0.0)
    turn, place = body_poses(site, TARGETS, rng)
    samples = simulate_fields(site, Trajectory(np.arange(float(TARGETS)), turn, place), 1e-12, rng)
    coupling = 0.03 * np.abs(samples.phasor_sensor).max(axis=(1, 2), keepdims=True)
    false = samples.phasor_sensor + coupling * rng.standard_normal(samples.phasor_sensor.shape)
    result = explained(site, replace(samples, phasor_sensor=false))
    assert "field_residuals" in codes(result)
    assert result.gain_spread == 0.0
    away = np.linalg.norm(result.fixes.position_world - place[:, None], axis=2)
    # Of the mirrors the nearer: a lone beacon has both.
    assert np.sqrt(np.mean(np.min(away, axis=1) ** 2)) < 0.02
