"""The gate of innovations: what it refuses, and how fast its running mean follows."""

from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from magfusion.estimation.graph.state import MOTION, State, moved
from magfusion.estimation.measurements.phasors import FieldPhasors, field_phasors
from magfusion.estimation.online_integrity.gate import Gate
from magfusion.estimation.online_integrity.magnetometer_watch import MagnetometerWatch
from magfusion.model.parameters import initial_calibration
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.simulation.demo_site import demo_site
from magfusion.simulation.log import simulate_fields
from magfusion.units import Array, BoolArray

SITE = replace(demo_site(coil_radius=None), model_error=0.0)
COMPONENTS = 6  # of the innovation of a channel


@dataclass(frozen=True, eq=False)
class Innovations:
    """The squared innovations of an epoch (channels,), in place of phasors that have them."""

    squared: Array

    def alone(self) -> "Innovations":
        return self

    def distances(self, *_: Any) -> Array:
        return self.squared

    def without(self, rejected: BoolArray) -> "Innovations":
        return Innovations(np.where(rejected, 0.0, self.squared))


def a_gate() -> Gate:
    return Gate(SITE.channels, (), MagnetometerWatch(SITE))


def a_state(site: Site, sigma: Array) -> State:
    return State(
        time=3.0,
        world_from_body=Rotation.from_rotvec([0.3, -0.2, 1.1]).as_matrix(),
        position_world=np.array([2.0, 1.5, 1.1]),
        velocity_world=np.zeros(3),
        accel_bias_body=np.zeros(3),
        gyro_bias_body=np.zeros(3),
        calibration=initial_calibration(site, 0.0),
        cov=np.diag(sigma**2),
    )


def levels(gate: Gate, squared: Array) -> Array:
    """Return the running mean of each beacon after each epoch, shape (epochs, beacons)."""
    state, every = a_state(SITE, np.ones(MOTION)), np.ones(len(SITE.channels), dtype=bool)
    out = []
    for epoch in squared:
        gate.passed(cast(FieldPhasors, Innovations(epoch)), state, every, ~every)
        out.append(list(gate.distortion.values()))
    return np.array(out)


def test_innovations_have_the_covariance_of_prediction_and_noise_together() -> None:
    """Poses are off by the claimed covariance, phasors by the declared noise: the mean is one."""
    rng, noise = np.random.default_rng(4), 2e-10  # T
    sigma = np.repeat([1e-3, 3e-3, 1e-3, 1e-3, 1e-3], 3)
    predicted, gate = a_state(SITE, sigma), a_gate()
    every = np.ones(len(SITE.channels), dtype=bool)
    exact = replace(predicted, cov=1e-24 * np.eye(MOTION))
    now, result, by_noise = np.zeros(1, dtype=np.int64), [], []
    for _ in range(250):
        true = moved(predicted, (), sigma * rng.normal(size=MOTION))
        pose = Trajectory(
            np.array([true.time]), true.world_from_body[None], true.position_world[None]
        )
        samples = simulate_fields(SITE, pose, noise, rng)
        zero = np.zeros((1, 3))
        fields = field_phasors(SITE, samples, now, pose, zero, np.zeros(1), 1.0)
        gate.passed(fields, predicted, every, ~every)
        result.append(list(gate.accepted.values()))
        by_noise.append(fields.distances(exact, ()) / COMPONENTS)
    # 1,000 channels, of which those of an epoch share the pose's error.
    assert np.mean(result) == pytest.approx(1.0, abs=0.12)
    assert np.mean(by_noise) > 2.0  # alone, it is not what the innovations are


def test_a_clean_epoch_is_hardly_ever_refused_and_eight_sigma_nearly_always() -> None:
    rng, shape = np.random.default_rng(5), (2500, len(SITE.channels))
    clean, seldom, mostly = (a_gate() for _ in range(3))
    levels(clean, rng.chisquare(COMPONENTS, shape))
    assert sum(clean.counts.values()) == 0
    levels(seldom, rng.noncentral_chisquare(COMPONENTS, 4.0**2, shape))
    assert sum(seldom.counts.values()) < 0.1 * np.prod(shape)
    levels(mostly, rng.noncentral_chisquare(COMPONENTS, 8.0**2, shape))
    assert sum(mostly.counts.values()) > 0.95 * np.prod(shape)


def test_noise_estimated_from_few_epochs_refuses_no_more() -> None:
    """By twenty degrees of freedom, 3 % of variances are estimated at less than half."""
    rng, freedom, starts, epochs = np.random.default_rng(7), 20.0, 300, 30
    shape = (starts, epochs, len(SITE.channels))
    squared = rng.chisquare(COMPONENTS, shape)
    squared *= freedom / rng.chisquare(freedom, (starts, 1, 1))
    refused = []
    for estimated in ({}, dict.fromkeys([b.name for b in SITE.beacons], freedom)):
        gates = [a_gate() for _ in range(starts)]
        for gate, own in zip(gates, squared, strict=True):
            gate.begin(estimated)
            levels(gate, own)
        refused.append(sum(sum(gate.counts.values()) for gate in gates))
    known, of_freedom = refused
    assert known > 20
    assert of_freedom <= 3


def test_the_distortion_is_a_mean_of_some_forty_epochs() -> None:
    """It scatters by a tenth about one, and follows what changes in 45 epochs."""
    rng, beacons = np.random.default_rng(6), len(SITE.channels)
    declared = levels(a_gate(), rng.chisquare(COMPONENTS, (4000, beacons)))[200:]
    assert np.mean(declared) == pytest.approx(1.0, abs=0.02)
    # Of 40 epochs of six components: the root of 2 / 240.
    assert np.std(declared) == pytest.approx(0.091, abs=0.01)
    gate = a_gate()
    levels(gate, np.full((100, beacons), float(COMPONENTS)))
    rising = levels(gate, np.full((60, beacons), 4.0 * COMPONENTS))[:, 0]  # noise doubles
    assert rising[0] < 1.3
    assert 0.85 < (rising[44] - 1.0) / 3.0 < 0.95
