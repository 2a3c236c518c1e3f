"""The algorithms of paper 004: exact where they must be, and of the known size in a quiet room."""

from dataclasses import replace

import numpy as np
import pytest
import tilted_attitude
from paper_rooms import S0, draw_world, ring
from scipy.spatial.transform import Rotation

from magfusion.errors import InputError
from magfusion.model.samples import FieldSamples, ImuSamples
from magfusion.model.site import Site
from magfusion.papers.p004_fingerprints.algorithms import (
    TOO_FEW_BEACONS,
    TOO_FEW_POINTS,
    Method,
    RotatingFields,
    attitude_as_published,
    fix_as_published,
    locate_by_lines,
)
from magfusion.papers.p004_fingerprints.equations import distances
from magfusion.papers.p004_fingerprints.fingerprint import (
    FingerprintDatabase,
    fingerprint_database,
    locate_by_differential_range,
    locate_by_neighbours,
)
from magfusion.papers.p004_fingerprints.rotating import (
    MAX_TILT,
    attitude_is_valid,
    rotating_fields,
    rotation_axis_world,
)
from magfusion.papers.p004_fingerprints.rssi import RssiLines
from magfusion.receiver.ellipse import plane_normal
from magfusion.simulation.field import phasors_world
from magfusion.units import DEGREE, Array

METHODS: tuple[Method, ...] = ("paper-lines", "paper-knn", "paper-knn-nt", "paper-fingerprint")
BEACONS = np.array([[0.0, 0.0, 0.0], [6.2, 0.54, 0.0], [3.2, 4.28, 0.0]])  # m


def _cubic() -> FingerprintDatabase:
    """Return fingerprints of amplitudes that depend on the distance alone."""
    x, y = np.meshgrid(np.arange(0.6, 5.2, 0.5), np.arange(0.6, 4.0, 0.5))
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, 0.5)], axis=1)
    return FingerprintDatabase(("A", "B", "C"), BEACONS, points, _amplitude(points))


def _amplitude(points: Array) -> Array:
    return np.asarray(np.array([1e-5, 2e-5, 3e-5]) * distances(points, BEACONS) ** -3.0)


def test_where_the_line_holds_two_algorithms_are_exact_anywhere() -> None:
    rng = np.random.default_rng(1)
    points = rng.uniform([0.6, 0.6, 0.2], [5.1, 3.9, 1.0], (100, 3))  # above and below the survey
    lines = RssiLines(np.full(3, -3.0), np.log([1e-5, 2e-5, 3e-5]))
    for result in (
        locate_by_differential_range(_cubic(), _amplitude(points)),
        locate_by_lines(_cubic(), _amplitude(points), lines),
    ):
        np.testing.assert_allclose(result, points, rtol=0, atol=1e-6)  # m


@pytest.mark.parametrize("logarithmic", [True, False])
def test_on_a_fingerprint_matching_returns_its_position(logarithmic: bool) -> None:
    known = _cubic()
    result = locate_by_neighbours(known, known.amplitude, logarithmic=logarithmic)
    np.testing.assert_allclose(result, known.position_world, rtol=1e-12)


# The quiet room -------------------------------------------------------------------------------


def _fields(samples: FieldSamples, site: Site) -> RotatingFields:
    axis = np.array([rotation_axis_world(b) for b in site.beacons])
    return rotating_fields(samples, site, tuple(b.name for b in site.beacons), axis)


@pytest.fixture(scope="module")
def errors() -> dict[Method, tuple[float, float]]:
    """Mean errors (m, deg) over ten worlds of 200 targets."""
    result: dict[Method, list[tuple[float, float]]] = {method: [] for method in METHODS}
    for seed in range(10):
        rng = np.random.default_rng(seed)
        world = draw_world(S0, rng)
        known = fingerprint_database(world.survey(rng), world.site)
        target = world.layout.draw_targets(rng, 200)
        fields = _fields(world.measure(target, np.eye(3), rng), world.site)
        for method in METHODS:
            fixes = fix_as_published(known, fields, method)
            position = np.linalg.norm(fixes.position_world - target, axis=1).mean()
            turn = Rotation.from_matrix(fixes.world_from_body).magnitude().mean() / DEGREE
            result[method].append((position, turn))
    means = {method: np.mean(pairs, axis=0) for method, pairs in result.items()}
    return {method: (float(mean[0]), float(mean[1])) for method, mean in means.items()}


@pytest.mark.parametrize(
    ("method", "known"),  # m
    [
        ("paper-lines", 0.040),
        ("paper-knn", 0.0865),
        ("paper-knn-nt", 0.48),
        ("paper-fingerprint", 0.0083),
    ],
)
def test_in_a_quiet_room_the_errors_are_of_the_known_size(
    method: Method, known: float, errors: dict[Method, tuple[float, float]]
) -> None:
    """Of a grid that holds all targets."""
    assert errors[method][0] == pytest.approx(known, rel=0.12)


def test_matching_in_nanotesla_as_printed_is_five_times_worse(
    errors: dict[Method, tuple[float, float]],
) -> None:
    assert errors["paper-knn-nt"][0] > 5.0 * errors["paper-knn"][0]


def test_the_attitude_of_a_level_sensor_follows_the_position(
    errors: dict[Method, tuple[float, float]],
) -> None:
    by_position = sorted(METHODS, key=lambda m: errors[m][0])
    assert sorted(METHODS, key=lambda m: errors[m][1]) == by_position
    assert errors["paper-fingerprint"][1] < 1.0  # deg


# Attitude -------------------------------------------------------------------------------------


def _normals(site: Site, position: Array, world_from_body: Array) -> Array:
    world = np.concatenate([phasors_world(b, position) for b in site.beacons], axis=1)
    return plane_normal(world @ world_from_body)


def _rolled_site(rng: np.random.Generator) -> Site:
    site = draw_world(S0, rng).site
    turns = Rotation.random(3, random_state=rng).as_matrix()
    beacons = (replace(b, world_from_beacon=t) for b, t in zip(site.beacons, turns, strict=True))
    return replace(site, beacons=tuple(beacons))


def test_the_attitude_is_exact_for_a_body_in_world_axes_however_the_beacons_lie() -> None:
    rng = np.random.default_rng(2)
    site = _rolled_site(rng)
    position = rng.uniform([0.6, 0.6, -2.0], [5.1, 3.9, 2.0], (50, 3))
    axis = np.array([rotation_axis_world(b) for b in site.beacons])
    result = attitude_as_published(_normals(site, position, np.eye(3)), position, BEACONS, axis)
    np.testing.assert_allclose(result, np.broadcast_to(np.eye(3), result.shape), atol=1e-9)


def test_the_attitude_is_exact_about_the_beacons_axis_and_far_off_at_ten_degrees_of_tilt() -> None:
    site = tilted_attitude.build(65.0)
    axis = np.array([rotation_axis_world(b) for b in site.beacons])
    position = tilted_attitude.POINTS_WORLD
    error = {}
    for name in "zx":
        true = Rotation.from_euler(name, -10.0, degrees=True)
        normal = _normals(site, position, true.as_matrix())
        result = Rotation.from_matrix(attitude_as_published(normal, position, BEACONS, axis))
        error[name] = (true.inv() * result).magnitude().mean() / DEGREE
    assert error["z"] < 1e-9  # deg
    assert error["x"] == pytest.approx(29.5, abs=0.5)  # deg


# What is missing ------------------------------------------------------------------------------


@pytest.mark.parametrize("axis", [[0.0, 0.0, 1.0], [0.6, 0.0, 0.8]])
def test_an_attitude_is_valid_about_the_shared_axis_alone(axis: list[float]) -> None:
    """The accelerometer decides where the axes are parallel, whatever their signs."""
    shared = np.array(axis)
    axes = np.array([shared, -shared, shared])
    time = np.array([1.0, 3.0, 9.0])  # s; no sample near the last
    stamps = np.arange(0.0, 4.0, 0.01)
    about = Rotation.from_rotvec(np.where(stamps[:, None] < 2.0, 1.5, 0.7) * shared)
    across = np.cross(shared, [0.0, 1.0, 0.0])
    for tilt, expected in ((0.8 * MAX_TILT, True), (1.2 * MAX_TILT, False)):
        tilted = Rotation.from_rotvec((stamps[:, None] >= 2.0) * tilt * np.array([0.0, 1.0, 0.0]))
        force = about.apply((tilted).apply([0.0, 0.0, 9.81]))  # about the axis, and tilted later
        imu = ImuSamples(stamps, np.zeros_like(force), force)
        np.testing.assert_array_equal(attitude_is_valid(axes, time, imu), [True, expected, True])
    bent = np.array([shared, shared, shared + np.tan(2.0 * MAX_TILT) * across])
    bent /= np.linalg.norm(bent, axis=1, keepdims=True)
    assert not np.any(attitude_is_valid(bent, time, imu))


def test_an_epoch_is_located_by_the_beacons_that_it_hears_or_dropped_with_its_reason() -> None:
    world = draw_world(S0, np.random.default_rng(3), layout=ring(5))
    rng = np.random.default_rng(4)
    known = fingerprint_database(world.survey(rng), world.site)
    target = world.layout.draw_targets(rng, 30)
    samples = world.measure(target, np.eye(3), rng)
    samples.phasor_sensor[:10, 0] = np.nan
    samples.phasor_sensor[10:20, 1:3] = np.nan
    samples.phasor_sensor[20:23, :3] = np.nan
    fixes = fix_as_published(known, _fields(samples, world.site), "paper-fingerprint")
    np.testing.assert_array_equal(fixes.epoch, np.delete(np.arange(30), [20, 21, 22]))
    assert np.max(np.linalg.norm(fixes.position_world - target[fixes.epoch], axis=1)) < 0.05  # m
    assert fixes.dropped == {TOO_FEW_BEACONS: 3}
    known.amplitude[2:, 4] = np.nan
    fixes = fix_as_published(known, _fields(samples, world.site), "paper-fingerprint")
    assert len(fixes.epoch) == 0
    assert fixes.dropped == {TOO_FEW_BEACONS: 3, TOO_FEW_POINTS: 27}


def test_fingerprints_belong_to_the_sensor_and_are_free_of_its_matrix() -> None:
    rng = np.random.default_rng(5)
    world = draw_world(S0, rng)
    survey = world.survey(rng)
    assert survey.phasor_sensor is not None
    turn = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    matrix = np.diag([1.1, 0.9, 1.05])
    sensor = replace(
        world.site.platform.magnetometer, position_body=np.array([0.1, 0, 0]), matrix=matrix
    )
    site = replace(world.site, platform=replace(world.site.platform, magnetometer=sensor))
    rotated = replace(
        survey,
        world_from_body=np.tile(turn, (len(survey), 1, 1)),
        phasor_sensor=survey.phasor_sensor @ turn @ matrix.T,
    )
    plain, result = fingerprint_database(survey, world.site), fingerprint_database(rotated, site)
    np.testing.assert_allclose(result.amplitude, plain.amplitude, rtol=1e-12)
    shift = result.position_world - plain.position_world
    np.testing.assert_allclose(shift, np.tile([0.0, 0.1, 0.0], (len(survey), 1)), atol=1e-12)


def test_a_survey_of_amplitudes_gives_the_same_fingerprints_as_its_phasors() -> None:
    rng = np.random.default_rng(6)
    world = draw_world(S0, rng)
    survey = world.survey(rng)
    by_phasors = fingerprint_database(survey, world.site)
    amplitudes = replace(survey, phasor_sensor=None, amplitude=by_phasors.amplitude)
    by_amplitudes = fingerprint_database(amplitudes, world.site)
    np.testing.assert_allclose(by_amplitudes.amplitude, by_phasors.amplitude, rtol=1e-12)


def test_a_beacon_that_the_site_does_not_know_is_refused() -> None:
    rng = np.random.default_rng(7)
    world = draw_world(S0, rng)
    channels = (("M1", 0), ("M9", 0), ("M3", 0))
    with pytest.raises(InputError, match="beacon M9 tone 0"):
        fingerprint_database(replace(world.survey(rng), channels=channels), world.site)
