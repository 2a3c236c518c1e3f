"""Model error is constant in place: what epochs share does not average."""

from dataclasses import replace

import numpy as np
import pytest
from example_site import mixed_site

from magfusion.estimation.batch.batch import SmootherSettings, smooth
from magfusion.estimation.measurements.model_error import (
    epochs_sharing_error,
    epochs_sharing_error_online,
)
from magfusion.estimation.measurements.phasors import field_phasors
from magfusion.model.noise import measurement_cov, model_error_cov
from magfusion.model.samples import FieldSamples
from magfusion.model.trajectory import Trajectory
from magfusion.results.errors import trajectory_errors
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import SimulationConfig, simulate_log

LENGTH = 0.5  # m


def test_epochs_at_rest_are_one_and_epochs_far_apart_are_many() -> None:
    rest = np.tile([1.0, 2.0, 3.0], (40, 1))
    assert np.allclose(epochs_sharing_error(rest, LENGTH), 40.0, rtol=1e-12, atol=0.0)
    separate = np.arange(30.0)[:, None] * [20.0, 0.0, 0.0]
    assert np.allclose(epochs_sharing_error(separate, LENGTH), 1.0, rtol=1e-9, atol=0.0)
    assert np.allclose(epochs_sharing_error(rest, 0.0), 1.0, rtol=0.0, atol=0.0)


def test_the_count_is_the_sum_of_correlations_with_all_epochs() -> None:
    rng = np.random.default_rng(0)
    place = np.cumsum(0.05 * rng.standard_normal((300, 3)), axis=0)
    exact = np.sum(np.exp(-np.linalg.norm(place[:, None] - place, axis=2) / LENGTH), axis=1)
    result = epochs_sharing_error(place, LENGTH)
    assert np.max(np.abs(result / exact - 1.0)) < 0.1  # epochs of an eighth of a metre are counted
    # A second visit averages nothing: twice the epochs, each counting half.
    again = epochs_sharing_error(np.tile(place, (2, 1)), LENGTH)
    assert np.allclose(again, 2.0 * np.tile(result, 2), rtol=1e-9, atol=0.0)


def test_online_the_count_is_that_of_a_straight_path() -> None:
    speed, step = 0.5, 0.2
    path = np.arange(-400, 401)[:, None] * [speed * step, 0.0, 0.0]
    exact = np.sum(np.exp(-np.linalg.norm(path, axis=1) / LENGTH))
    assert epochs_sharing_error_online(speed, step, LENGTH) == pytest.approx(exact, rel=1e-6)
    assert epochs_sharing_error_online(0.0, step, LENGTH) == pytest.approx(
        100.0, rel=0.01
    )  # twenty seconds
    assert epochs_sharing_error_online(100.0, step, LENGTH) == pytest.approx(1.0, rel=0.01)
    assert epochs_sharing_error_online(speed, step, 0.0) == 1.0


def test_epochs_that_share_their_model_error_have_the_information_of_one() -> None:
    """The mean of N equal errors has the variance of one; that of their noise, a part of N."""
    site, count = replace(demo_site(), model_error=0.01), 50
    phasor = np.full((count, len(site.channels), 3), 1e-6 + 5e-7j)
    noise = np.broadcast_to(1e-18 * np.eye(3), (*phasor.shape, 3))
    time = 0.2 * np.arange(count)
    samples = FieldSamples(time, np.full(count, 0.2), site.channels, phasor, noise)
    still = np.tile([2.0, 2.0, 1.0], (count, 1))
    poses = Trajectory(time, np.tile(np.eye(3), (count, 1, 1)), still)
    epoch, rate = np.arange(count), np.zeros((count, 3))
    shared = epochs_sharing_error(still, LENGTH)
    measured = field_phasors(
        site, samples, epoch, poses, rate, np.zeros(len(epoch)), 1.0, shared_by=shared
    )
    root = measured.sqrt_information[:, 0, :3, :3]
    mean_cov = np.linalg.inv(np.sum(np.swapaxes(root, 1, 2) @ root, axis=0))
    expected = 1e-18 / count * np.eye(3) + model_error_cov(phasor[0, 0], 0.01)
    assert np.allclose(mean_cov, expected, rtol=1e-9, atol=0.0)
    # An epoch alone is what it was: an outlier is one no less.
    alone = measured.alone().sqrt_information[0, 0, :3, :3]
    single = 1e-18 * np.eye(3) + model_error_cov(phasor[0, 0], 0.01)
    assert np.allclose(alone.T @ alone, np.linalg.inv(single), rtol=1e-9, atol=0.0)
    assert measured.excess is not None
    assert np.all(measured.excess > 30.0)


def _in_iron(seed: int, length: float) -> float:
    config = SimulationConfig(DEMO_BOX_WORLD, duration=30.0, motion="walk", iron=8, perturb=False)
    built = simulate_log(demo_site(), config, np.random.default_rng(seed))
    site = replace(demo_site(), model_error=0.01, model_error_length=length)
    assert built.log.truth is not None
    result = smooth(built.log, site, SmootherSettings(tune=False))
    nees = trajectory_errors(result.states, built.log.truth).nees
    assert nees is not None
    return float(np.mean(nees))


@pytest.mark.slow
def test_declared_iron_is_honest_where_it_counts_once() -> None:
    """Spheres of a per cent or so: white, the error of a hundred epochs would average away."""
    together = [_in_iron(seed, LENGTH) for seed in range(2)]
    white = [_in_iron(seed, 0.0) for seed in range(2)]
    assert np.mean(together) < 12.0, together
    assert np.mean(white) > 2.0 * np.mean(together), (white, together)


def test_a_tone_below_the_noise_leaves_the_weight_of_the_beacon_s_others() -> None:
    """Each coil of beacon B has a tone of its own: the others still show its distance."""
    site = mixed_site()
    start = site.channels.index(("B", 0))
    phasor = np.full((1, len(site.channels), 3), 1e-6 + 5e-7j)
    samples = FieldSamples(
        time=np.zeros(1),
        phasor_sensor=phasor,
        phasor_cov=np.broadcast_to(1e-20 * np.eye(3), (1, len(site.channels), 3, 3)),
        window=np.full(1, 0.4),
        channels=site.channels,
    )
    whole = measurement_cov(site, samples, survey_error=True)
    phasor = phasor.copy()
    phasor[0, start] = np.nan
    part = measurement_cov(site, replace(samples, phasor_sensor=phasor), survey_error=True)
    others = [start + 1, start + 2]
    before, after = (np.trace(cov[0, others], axis1=1, axis2=2) for cov in (whole, part))
    assert np.all((after > 0.5 * before) & (after < 2.0 * before))
