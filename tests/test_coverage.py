"""The bound of the pose is what the best estimator reaches, and scales as the physics demands."""

from dataclasses import replace

import numpy as np
import pytest
from example_site import mixed_site
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from magfusion.estimation.snapshot.fix_separation import separate_fixes
from magfusion.estimation.snapshot.likelihood import fix_epochs
from magfusion.model.detection_range import tones_of
from magfusion.model.parameters import initial_calibration
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.model.trust import Risk
from magfusion.results.coverage import (
    best_extra_beacon,
    boundary_places,
    coverage,
    phasor_variance,
    usual_box,
    volume,
)
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import simulate_fields
from magfusion.units import Array

WINDOW = 0.4  # s
DRAWS = 400
POINTS = volume(DEMO_BOX_WORLD, 0.9)


def room(count: int = 4, synchronised: bool = True, model_error: float = 0.0) -> Site:
    site = demo_site(coil_radius=None, synchronised=synchronised)
    return replace(site, beacons=site.beacons[:count], model_error=model_error)


def with_noise(site: Site, factor: float) -> Site:
    sensor = site.platform.magnetometer
    stronger = replace(sensor, noise_density=factor * sensor.noise_density)
    return replace(site, platform=replace(site.platform, magnetometer=stronger))


def with_moment(site: Site, factor: float) -> Site:
    beacons = tuple(
        replace(
            b,
            coils=tuple(replace(c, moment_beacon=factor * c.moment_beacon) for c in b.coils),
        )
        for b in site.beacons
    )
    return replace(site, beacons=beacons)


def sigma(site: Site, points: Array = POINTS, **options: bool) -> Array:
    options.setdefault("survey", False)
    return coverage(site, points, WINDOW, **options).position_sigma


@pytest.mark.parametrize("synchronised", [True, False])
@pytest.mark.parametrize("place", [(1.5, 1.5, 0.8), (3.0, 2.5, 1.2), (4.6, 3.5, 1.0)])
def test_the_maximum_likelihood_fix_scatters_as_the_bound_says(
    place: tuple[float, float, float], synchronised: bool
) -> None:
    site, point = room(synchronised=synchronised), np.array([place])
    noise = float(np.sqrt(phasor_variance(site, WINDOW)[0]))
    still = Trajectory(
        WINDOW * np.arange(DRAWS),
        np.broadcast_to(np.eye(3), (DRAWS, 3, 3)),
        np.repeat(point, DRAWS, axis=0),
    )
    samples = simulate_fields(site, still, noise, np.random.default_rng(5))
    fixes = fix_epochs(samples, initial_calibration(site, 0.0), survey_error=False)
    bound = coverage(site, point, WINDOW, survey=False)
    shift = np.linalg.norm(fixes.position_world[:, 0] - point, axis=1)
    turn = Rotation.from_matrix(fixes.world_from_body[:, 0]).magnitude()
    # At least as wide as that of one degree of freedom a draw, the least that there can be.
    low, high = np.sqrt(chi2.ppf([5e-4, 1 - 5e-4], DRAWS) / DRAWS)
    assert low < np.sqrt(np.mean(shift**2)) / bound.position_sigma[0] < high
    assert low < np.sqrt(np.mean(turn**2)) / bound.attitude_sigma[0] < high


@pytest.mark.parametrize("place", [(1.5, 1.5, 0.8), (4.6, 3.5, 1.0)])
def test_the_protection_level_is_the_one_that_fixes_have(place: tuple[float, ...]) -> None:
    site, point = room(), np.array([place])
    noise = float(np.sqrt(phasor_variance(site, WINDOW)[0]))
    still = Trajectory(
        WINDOW * np.arange(20), np.tile(np.eye(3), (20, 1, 1)), np.repeat(point, 20, axis=0)
    )
    samples = simulate_fields(site, still, noise, np.random.default_rng(5))
    calibration = initial_calibration(site, 0.0)
    fixes = fix_epochs(samples, calibration, survey_error=False)
    states = separate_fixes(samples, calibration, fixes, survey_error=False).states
    bound = coverage(site, point, WINDOW, survey=False, risk=Risk())
    # Where the fix scattered to, its own covariance is a little another.
    assert bound.protection_level_m == pytest.approx(np.median(states.protection_level_m), rel=0.02)
    degrees = np.median(states.protection_level_deg)
    assert bound.protection_level_deg == pytest.approx(degrees, rel=0.02)


def test_there_is_no_protection_level_where_one_beacon_is_all_that_determines_the_pose() -> None:
    bound = coverage(room(1), POINTS, WINDOW, risk=Risk())
    assert np.all(bound.determined)
    assert bound.protection_level_m is not None
    assert np.all(np.isinf(bound.protection_level_m))


def test_a_protection_level_grows_with_what_it_promises() -> None:
    plain, surer, worse = (
        coverage(room(), POINTS, WINDOW, risk=risk).protection_level_m
        for risk in (Risk(), Risk(total=1e-6, fault=1e-4), Risk(fault=1e-2))
    )
    assert plain is not None
    assert np.all(surer > plain)
    assert np.all(worse > plain)
    assert np.all(plain > 3.0 * sigma(room(), survey=True))


def test_the_noise_of_a_tone_is_what_least_squares_leave_of_a_window() -> None:
    site, rate = room(1), 500.0
    time = np.arange(-WINDOW / 2, WINDOW / 2, 1 / rate) + 0.5 / rate
    angle = 2 * np.pi * site.beacons[0].frequency_hz * time
    design = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    per_sample = site.platform.magnetometer.noise_density**2 * rate / 2  # T^2, up to Nyquist
    fitted = per_sample * np.diag(np.linalg.inv(design.T @ design))
    assert np.allclose(fitted / phasor_variance(site, WINDOW)[0], 1.0, rtol=1e-6, atol=0)


def test_coils_driven_in_turn_share_the_window() -> None:
    site = room(1)
    coils = tuple(replace(c, slot=k) for k, c in enumerate(site.beacons[0].coils))
    rotated = replace(site, beacons=(replace(site.beacons[0], coils=coils),))
    ratio = phasor_variance(rotated, WINDOW) / phasor_variance(site, WINDOW)
    assert np.allclose(ratio, [2.0, 2.0], rtol=1e-12, atol=0)


def test_the_bound_scales_with_noise_moment_and_window() -> None:
    plain = sigma(room())
    assert np.allclose(sigma(with_noise(room(), 3.0)) / plain, 3.0, rtol=1e-6, atol=0)
    assert np.allclose(sigma(with_moment(room(), 3.0)) / plain, 1 / 3.0, rtol=1e-6, atol=0)
    longer = coverage(room(), POINTS, 4 * WINDOW, survey=False).position_sigma
    assert np.allclose(longer / plain, 0.5, rtol=1e-6, atol=0)


def test_the_bound_grows_with_the_fourth_power_of_the_distance() -> None:
    """The field falls with its third, so its change along the way with the fourth."""
    site = room(1)
    sensor = replace(site.platform.magnetometer, position_body=np.zeros(3))
    site = replace(site, platform=replace(site.platform, magnetometer=sensor))
    away = np.array([0.5, 0.7, 0.6])
    points = site.beacons[0].position_world + np.array([[2.0], [4.0], [8.0]]) * away
    assert np.allclose(sigma(site, points)[1:] / sigma(site, points)[:-1], 16.0, rtol=1e-6, atol=0)


@pytest.mark.parametrize("survey", [True, False])
def test_the_position_hardly_depends_on_the_attitude(survey: bool) -> None:
    site = room(model_error=0.005)
    rotated = coverage(
        site, POINTS, WINDOW, survey=survey, world_from_body=Rotation.random(rng=3).as_matrix()
    )
    ratio = rotated.position_sigma / sigma(site, survey=survey)
    assert np.all(np.abs(ratio - 1.0) < 0.05)  # a lever arm of 6 cm in metres of distance


def test_what_is_not_known_costs() -> None:
    plain = sigma(room())
    assert np.all(sigma(room(synchronised=False)) > plain)
    assert np.all(sigma(room(), survey=True) > plain)
    assert np.all(sigma(room(model_error=0.005)) > plain)
    assert np.all(sigma(room(), attitude_known=True) < plain)
    assert np.all(sigma(room(3)) > plain)


def test_an_attitude_known_from_elsewhere_has_no_error() -> None:
    bound = coverage(room(), POINTS, WINDOW, attitude_known=True)
    assert np.all(bound.attitude_sigma == 0.0)


def test_the_survey_is_a_floor_that_less_noise_does_not_break() -> None:
    strong, quiet = room(), with_noise(room(), 1e-3)
    assert np.all(sigma(quiet) < 2e-3 * sigma(strong))
    millimetre = 1e-3  # m, how well the demo's beacons are surveyed
    assert np.all(sigma(quiet, survey=True) > 0.3 * millimetre)


def test_the_mirror_of_a_single_beacon_does_not_make_the_bound_singular() -> None:
    bound = coverage(room(1), POINTS, WINDOW, survey=False)
    assert np.all(bound.determined)
    assert np.all(np.isfinite(bound.position_sigma))


@pytest.mark.parametrize("survey", [True, False])
def test_a_direction_that_stays_open_is_told(survey: bool) -> None:
    """A turn about the axis of one rotating beacon looks like a shift of its phase."""
    bound = coverage(room(1, synchronised=False), POINTS, WINDOW, survey=survey)
    assert not np.any(bound.determined)
    assert np.all(np.isinf(bound.position_sigma))
    assert np.isinf(bound.position_quantile(0.5))


@pytest.mark.parametrize("survey", [True, False])
def test_one_coil_does_not_determine_the_pose(survey: bool) -> None:
    site = room(1)
    single = replace(
        site.beacons[0],
        coils=site.beacons[0].coils[:1],
        sigma=replace(site.beacons[0].sigma, log_moment=np.zeros(1)),
    )
    assert not np.any(
        coverage(replace(site, beacons=(single,)), POINTS, WINDOW, survey=survey).determined
    )


def test_a_point_at_a_beacon_is_not_determined() -> None:
    site = room()
    assert not coverage(site, site.beacons[0].position_world[None], WINDOW).determined[0]


def test_far_away_no_beacon_is_heard() -> None:
    bound = coverage(room(), np.array([[3.0, 2.5, 1.0], [3e4, 0.0, 0.0]]), WINDOW)
    assert list(bound.beacons) == [4, 0]


def test_the_bound_holds_for_every_kind_of_beacon() -> None:
    bound = coverage(mixed_site(), POINTS, WINDOW)
    assert np.all(bound.determined)
    assert np.allclose(np.linalg.norm(bound.worst_world, axis=1), 1.0, rtol=1e-9, atol=0)


def test_the_noise_factor_of_a_beacon_is_its_noise() -> None:
    site = room()
    factors = tuple(replace(b, noise_factor=3.0) for b in site.beacons)
    strong = sigma(replace(site, beacons=factors))
    assert np.allclose(strong, sigma(with_noise(site, 3.0)), rtol=1e-9, atol=0)
    one = replace(site, beacons=(*factors[:1], *site.beacons[1:]))
    assert np.all((sigma(one) > sigma(site)) & (sigma(one) < strong))


def test_a_planned_beacon_shares_its_frequency_with_none() -> None:
    site = room(2)
    first = replace(site.beacons[0], name="other", position_world=np.array([1.0, 2.0, 2.0]))
    both = replace(site, beacons=(*site.beacons, first))
    planned = replace(site, beacons=(*site.beacons, replace(first, planned=True)))
    assert tones_of(both).reused
    assert not tones_of(planned).reused
    np.testing.assert_array_equal(tones_of(planned).of_channel, [0, 1, 2])
    # What it tells is what it would tell at another frequency, which hardly weakens it.
    tuned = replace(first, frequency_hz=first.frequency_hz + 1e-6)
    separate = sigma(replace(site, beacons=(*site.beacons, tuned)))
    assert np.allclose(sigma(planned), separate, rtol=1e-6, atol=0)
    assert np.any(sigma(both) > 1.5 * separate)


def test_one_more_beacon_helps_most_where_it_is_put() -> None:
    site = room(2)

    def bound(extended: Site, points: Array):
        return coverage(extended, points, WINDOW, survey=False)

    result = best_extra_beacon(site, DEMO_BOX_WORLD, bound, POINTS)
    assert result.after < result.before
    assert result.before == bound(site, POINTS).position_quantile(0.5)
    for place in boundary_places(DEMO_BOX_WORLD):
        other = replace(site.beacons[0], name="other", position_world=place, planned=True)
        extended = replace(site, beacons=(*site.beacons, other))
        assert result.after <= bound(extended, POINTS).position_quantile(0.5)


def test_the_volume_spans_its_box() -> None:
    points = volume(DEMO_BOX_WORLD, 0.5)
    assert np.array_equal(np.array([points.min(axis=0), points.max(axis=0)]), DEMO_BOX_WORLD)
    assert np.all(np.diff(np.unique(points[:, 0])) <= 0.5 + 1e-9)  # m
    assert set(volume(DEMO_BOX_WORLD, 0.5, np.array([1.0]))[:, 2]) == {1.0}


def test_the_usual_box_holds_the_beacons() -> None:
    for count in (1, 4):
        low, high = usual_box(room(count))
        assert np.all(low < high)
        for beacon in room(count).beacons:
            assert np.all((low <= beacon.position_world) & (beacon.position_world <= high))
