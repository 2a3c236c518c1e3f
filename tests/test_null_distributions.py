"""Null distributions of the tests of a result: two-sided, by drawn errors of the declared kind."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from magfusion.estimation.batch.batch import Smoothed, SmootherSettings, smooth
from magfusion.estimation.data_checks.statistics import largest_mean_square
from magfusion.estimation.graph.inertial import ROWS
from magfusion.estimation.graph.state import MOTION
from magfusion.estimation.integrity.priors_of_log import _change_of, distance
from magfusion.estimation.measurements.phasors import FieldPhasors
from magfusion.estimation.posterior.residual_covariance_chain import (
    _field_rows,
    _fixed_columns,
    _inertial_rows,
    _with_priors,
)
from magfusion.estimation.posterior.residual_redundancy import _matrices
from magfusion.estimation.solve.chain import solve_chain
from magfusion.model.noise import sensor_positions
from magfusion.model.prior import prior_sqrt_covariance
from magfusion.model.samples import Log
from magfusion.model.site import BeaconSigma, Site
from magfusion.simulation.demo_site import demo_site
from magfusion.simulation.inertial import simulate_imu
from magfusion.simulation.log import simulate_fields
from magfusion.simulation.motion import random_walk_motion
from magfusion.units import DEGREE, Array

BEACONS, ROOM, NOISE = 15, np.array([8.0, 6.4, 3.2]), 2e-10  # m, T
DRAWS = 120


@pytest.mark.parametrize("noise_freedom", [30.0, np.inf])
@pytest.mark.parametrize("freedom", [6.0, 60.0])
def test_a_mean_square_exceeds_its_limit_as_often_as_it_says(
    freedom: float, noise_freedom: float
) -> None:
    """A normal approximation was exceeded a thousand times too often by a single epoch."""
    rng, count, probability = np.random.default_rng(1), 200_000, 1e-3
    ratio = rng.chisquare(freedom, count) / freedom
    if np.isfinite(noise_freedom):
        ratio /= rng.chisquare(noise_freedom, count) / noise_freedom
    limit = largest_mean_square(probability, freedom, noise_freedom)
    assert np.mean(ratio > limit) == pytest.approx(probability, rel=0.25)


def many_beacons(rng: np.random.Generator) -> Site:
    """Return a site whose survey, to 7 mm, is estimated, in fields that are bent by .8 %."""
    base = demo_site(coil_radius=None)
    sigma = BeaconSigma(np.full(3, 0.28 * DEGREE), np.full(3, 0.007), np.full(2, 0.004))
    beacons = []
    for i in range(BEACONS):
        place = rng.uniform(0.0, 1.0, 3)
        place[i % 3] = float(i % 2)  # at the walls
        own = replace(base.beacons[0], name=f"B{i}", position_world=place * ROOM, sigma=sigma)
        turn = Rotation.random(random_state=rng).as_matrix()
        beacons.append(replace(own, world_from_beacon=turn, frequency_hz=20.0 + 5.0 * i))
    return replace(base, beacons=tuple(beacons), model_error=0.008)


def drawn_changes(result: Smoothed, rng: np.random.Generator) -> Array:
    """Return changes of the calibration by drawn errors, in declared sigmas, (dimension, draws)."""
    site, poses = result.declared.site, result.states
    measured = next(m for m in result.graph.measurements if isinstance(m, FieldPhasors))
    root = measured.sqrt_information[..., :3, :3]
    phasor = np.nan_to_num(result.fields.phasor_sensor)
    turn = (poses.world_from_body @ site.platform.magnetometer.body_from_sensor)[result.epoch]
    place = sensor_positions(site, poses)[result.epoch] / site.model_error_length
    phasor_world = np.einsum("nij,ncj->nci", turn, phasor)
    fields, still = [], []
    for _ in range(DRAWS):
        matrix = 0.008 / np.sqrt(3.0) * _matrices(rng, place, BEACONS, smooth=False)[:, 0]
        bent = np.einsum("nki,nckl,ncl->nci", turn, matrix[:, site.owner], phasor_world)
        parts = np.stack([bent.real, bent.imag], axis=2)
        parts += NOISE * rng.standard_normal(parts.shape)
        fields.append(np.einsum("ncij,ncpj->ncpi", root, parts).reshape(*phasor.shape[:2], 6))
        still.append(rng.standard_normal((result.graph.epochs - 1, ROWS)))
    known = result.graph, result.estimate
    columns = _fixed_columns(result.graph, ())
    normal = _with_priors(*known, 0, DRAWS)
    for rows in _inertial_rows(*known, columns, still):
        normal.add(rows.epoch, rows.own, rows.after, rows.border, rows.right)
    for piece, _ in _field_rows(*known, columns, fields):
        piece.added_to(normal)
    by_errors = solve_chain(normal.chain(), MOTION, covariance=False).border[0, :, 1:]
    spread = prior_sqrt_covariance(site, result.blocks)
    prior = spread @ spread.T
    moved = result.calibration_response
    gain = np.eye(len(prior)) - (result.calibration_cov - moved @ moved.T) @ np.linalg.inv(prior)
    by_prior = gain @ spread @ rng.standard_normal((len(prior), DRAWS))
    return (by_errors + by_prior) / np.sqrt(np.diagonal(prior))[:, None]


@pytest.mark.slow
def test_a_calibration_moves_as_far_as_its_test_expects() -> None:
    """With two modes for each of fifteen beacons the mean was 1.1, the tails ten times too many."""
    rng = np.random.default_rng(5)
    site = many_beacons(rng)
    motion = random_walk_motion(rng, 30.0, np.array([0.25 * ROOM, 0.75 * ROOM]), 0.9)
    imu = simulate_imu(motion, site.platform.imu, site.gravity, 100.0, 30.0, rng).samples
    at = motion.trajectory(np.arange(0.3, 29.7, 0.4))
    log = Log("walk", 0, "test", imu=imu, fields=simulate_fields(site, at, NOISE, rng))
    result = smooth(log, site, SmootherSettings(tune=False, loss=None))
    changes = drawn_changes(result, rng)
    _, cov = _change_of(result)
    for kind in ("position", "rotation", "log_moment"):
        blocks = [b for b in result.blocks if b.parameter.kind == kind]
        tests = [distance(change, cov, blocks) for change in changes.T]
        assert 0.85 < np.mean([square / freedom for square, freedom, _ in tests]) < 1.05, kind
        every = [distance(change, cov, [b])[2] for b in blocks for change in changes.T]
        assert 0.004 < np.mean(np.array(every) < np.log(0.01)) < 0.015, kind
