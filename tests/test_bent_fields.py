"""An error that is constant in place, found in residuals: as large as it is, however smooth."""

from dataclasses import replace

import numpy as np
import pytest

from magfusion.estimation.batch.batch import smooth
from magfusion.estimation.measurements.field_error import FieldError
from magfusion.estimation.measurements.model_error import epochs_sharing_error
from magfusion.estimation.posterior.residual_redundancy import ChannelErrors, _matrices
from magfusion.estimation.posterior.variance_components import BeaconErrors, parts_of
from magfusion.model.parameters import initial_calibration
from magfusion.model.parameters.parameter import PhasorView
from magfusion.results.errors import trajectory_errors
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.disturbance import draw_bending
from magfusion.simulation.log import SimulationConfig, simulate_log
from magfusion.units import Array

LENGTH, DECLARED = 0.5, 0.005  # m, of the field
NOISE = 0.2  # of the declared error


def walk(rng: np.random.Generator, count: int) -> Array:
    """Return places of half a metre a second, ten times a second."""
    pace = np.cumsum(0.1 * rng.standard_normal((count, 3)), axis=0)
    pace = np.sin(pace) * 0.5 / np.linalg.norm(np.sin(pace), axis=1, keepdims=True)
    return np.asarray(np.cumsum(0.1 * pace, axis=0))


def errors(rng: np.random.Generator, place: Array, *, smooth: bool) -> Array:
    """Return the relative error of a unit field, (n, 6), as a share of the declared."""
    matrix = _matrices(rng, place[:, None] / LENGTH, 1, smooth=smooth)[:, 0, 0]
    return np.asarray(np.swapaxes(matrix[..., :2], 1, 2).reshape(len(place), 6))


@pytest.mark.parametrize("smooth", [False, True])
@pytest.mark.parametrize("true", [0.5, 1.0, 2.0])
def test_its_size_is_found_whether_it_is_rough_or_smooth(smooth: bool, true: float) -> None:
    """Were a smooth one taken for a rough one, it would seem two to four times smaller."""
    rng, result, shares = np.random.default_rng(6), [], []
    for _ in range(6):
        place = walk(rng, 400)
        noise = NOISE * rng.standard_normal((400, 6))
        seen = true * errors(rng, place, smooth=smooth) + noise
        remaining = (
            NOISE * rng.standard_normal((400, 6)),
            errors(rng, place, smooth=False),
            errors(rng, place, smooth=True),
            np.zeros((400, 6)),
        )
        variance = np.full(400, 6 * NOISE**2), np.full(400, 6.0 / DECLARED**2)
        own = ChannelErrors(np.arange(400), seen, remaining, variance, (1.0, DECLARED))
        given = BeaconErrors([own], (1.0, DECLARED), bent=True)
        parts = parts_of([given], epochs_sharing_error(place, LENGTH), 1)[0]
        assert parts is not None
        assert parts.model is not None
        result.append(parts.model / min(parts.accepted_factor, 1.0))
        shares.append(parts.smooth)
    assert np.exp(np.mean(np.log(result))) == pytest.approx(true, rel=0.2)
    assert (np.mean(shares) > 0.5) == smooth


@pytest.mark.slow
def test_it_is_no_noise_where_a_platform_rests_and_runs() -> None:
    """With one share of all speeds in each scale, the noise seemed up to three times as large."""
    rng, draws, white, models = np.random.default_rng(6), 16, [], []
    speed = np.repeat([0.0, 0.24, 0.0, 0.24], 40)  # m between epochs
    for _ in range(12):
        heading = np.cumsum(0.3 * rng.standard_normal((160, 3)), axis=0)
        heading /= np.linalg.norm(heading, axis=1, keepdims=True)
        place = np.cumsum(speed[:, None] * heading, axis=0)

        def noise(size: float = 0.02) -> Array:
            return size * rng.standard_normal((160, 6))

        seen = errors(rng, place, smooth=True) + noise()
        of_noise = np.hstack([noise() for _ in range(draws)])
        rough, bent = (
            np.hstack([errors(rng, place, smooth=kind) for _ in range(draws)])
            for kind in (False, True)
        )
        remaining = of_noise, rough, bent, np.zeros_like(bent)
        variance = np.full(160, 6 * 0.02**2), np.full(160, 6.0 / DECLARED**2)
        own = ChannelErrors(np.arange(160), seen, remaining, variance, (1.0, DECLARED))
        given = BeaconErrors([own], (1.0, DECLARED), bent=True)
        parts = parts_of([given], epochs_sharing_error(place, LENGTH), 1)[0]
        assert parts is not None
        assert parts.model is not None
        white.append(parts.white)
        models.append(parts.model)
    assert np.exp(np.mean(np.log(white))) == pytest.approx(1.0, rel=0.1)
    assert max(white) < 1.5
    assert np.exp(np.mean(np.log(models))) == pytest.approx(1.0, rel=0.25)


def test_its_modes_are_what_bends_a_field() -> None:
    """By the simulator's own bending, which is a matrix of the place for each beacon."""
    site, rng = demo_site(coil_radius=None), np.random.default_rng(1)
    turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    field_world = rng.standard_normal((4, 1, 3)) + 1j * rng.standard_normal((4, 1, 3))
    parameter = FieldError(
        np.arange(4.0),
        np.ones((4, 1, 1)),
        np.full((4, 1, 1), 0.01),
        np.broadcast_to(turn.T, (4, 1, 3, 3)),
        np.eye(3)[None],
    )
    calibration = initial_calibration(site, 0.0)
    view = PhasorView(calibration, site.beacons[0], np.arange(4.0), field_world @ turn, None)
    columns = parameter.own_jacobian(view)
    bending = draw_bending(rng, 0.01, 1e6, 1)
    matrix = bending.matrix(np.zeros((1, 3)))[0]
    bent = (bending.bent_world(0, field_world, np.zeros((4, 3))) - field_world) @ turn
    amplitude = matrix / (0.01 / np.sqrt(3.0))
    assert columns.shape == (4, 1, 3, parameter.columns)
    assert np.max(np.abs(columns @ amplitude - bent)) < 1e-9


@pytest.mark.slow
def test_a_walk_in_bent_fields_is_honest_with_the_noise_that_is_found() -> None:
    """Ten short walks, each bent as declared: a mean NEES of 11 before, where 6 is expected."""
    site, values, factors = demo_site(coil_radius=None), [], []
    config = SimulationConfig(
        DEMO_BOX_WORLD, duration=15.0, perturb=True, random_field=site.model_error
    )
    for seed in range(10):
        log = simulate_log(site, config, np.random.default_rng(seed)).log
        result = smooth(replace(log, truth=None), site)
        assert log.truth is not None
        nees = trajectory_errors(result.states, log.truth).nees
        assert nees is not None
        values.append(float(np.mean(nees)))
        factors += [t.factor for t in result.noise if t.key == "model_error"]
    assert 2.8 < np.mean(values) < 9.0, values
    assert 0.75 < np.exp(np.mean(np.log(factors))) < 1.5
