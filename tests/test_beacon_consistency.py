"""Beacons of one epoch that contradict each other: which one is false, and when none is clear."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from magfusion.estimation.graph.state import MOTION, State
from magfusion.estimation.measurements.phasors import FieldPhasors, field_phasors
from magfusion.estimation.online_integrity.beacon_consistency import contradicting
from magfusion.estimation.online_integrity.gate import Gate
from magfusion.estimation.online_integrity.magnetometer_watch import MagnetometerWatch
from magfusion.model.parameters import initial_calibration
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.simulation.demo_site import demo_site
from magfusion.simulation.log import simulate_fields
from magfusion.units import Array, BoolArray

SITE = demo_site(coil_radius=None)
NOISE_DENSITY = 2.5e-10  # T per root Hz
# What a minute of dead reckoning leaves (rad, m), and what an exchanged beacon is off by.
PREDICTION = np.repeat([5e-3, 0.1], 3)
EXCHANGED_POSITION, EXCHANGED_ROTATION, EXCHANGED_MOMENT = 0.02, np.deg2rad(1.0), 0.05
BEACON = np.array([[b.name for b in SITE.beacons].index(name) for name, _ in SITE.channels])
EVERY = np.ones(len(BEACON), dtype=bool)


def an_epoch(true_site: Site, rng: np.random.Generator) -> tuple[FieldPhasors, State]:
    """Return the fields of a site at a pose, and a prediction that is off by its sigmas."""
    rotation = Rotation.from_rotvec(rng.normal(0.0, 0.5, 3))
    position, error = rng.uniform((1.0, 1.0, 0.8), (3.0, 3.0, 1.6)), PREDICTION * rng.normal(size=6)
    true = Trajectory(np.array([3.0]), rotation.as_matrix()[None], position[None])
    cov = np.diag(np.concatenate([PREDICTION, np.full(MOTION - 6, 0.01)]) ** 2)
    attitude = rotation * Rotation.from_rotvec(error[:3])
    predicted = State(
        time=3.0,
        world_from_body=attitude.as_matrix(),
        position_world=position + attitude.apply(error[3:]),
        velocity_world=np.zeros(3),
        accel_bias_body=np.zeros(3),
        gyro_bias_body=np.zeros(3),
        calibration=initial_calibration(SITE, 0.0),
        cov=cov,
    )
    samples = simulate_fields(true_site, true, NOISE_DENSITY, rng)
    now, still = np.zeros(1, dtype=np.int64), np.zeros((1, 3))
    phasors = field_phasors(SITE, samples, now, true, still, np.zeros(1), 1.0)
    # As of an iterated update.
    return phasors.linearized_at(true.world_from_body[0], true.position_world[0]), predicted


def with_exchanged(site: Site, number: int, rng: np.random.Generator) -> Site:
    """Return the site with another beacon about where one was."""
    beacon = site.beacons[number]
    turn = Rotation.from_rotvec(rng.normal(0.0, EXCHANGED_ROTATION, 3))
    other = replace(
        beacon,
        position_world=beacon.position_world + rng.normal(0.0, EXCHANGED_POSITION, 3),
        world_from_beacon=beacon.world_from_beacon @ turn.as_matrix(),
        coils=tuple(
            replace(coil, moment_beacon=coil.moment_beacon * np.exp(change))
            for coil, change in zip(
                beacon.coils, rng.normal(0.0, EXCHANGED_MOMENT, len(beacon.coils)), strict=True
            )
        ),
    )
    beacons = [other if b is beacon else b for b in site.beacons]
    return replace(site, beacons=tuple(beacons))


def false_beacons(epoch: tuple[FieldPhasors, State], valid: BoolArray = EVERY) -> list[int]:
    phasors, predicted = epoch
    false = contradicting(phasors.without(~valid), predicted, (), BEACON, valid, valid)
    return np.unique(BEACON[false]).tolist()


def test_true_beacons_are_not_excluded() -> None:
    rng = np.random.default_rng(1)
    assert not any(false_beacons(an_epoch(SITE, rng)) for _ in range(300))


@pytest.mark.parametrize("number", range(4))
def test_an_exchanged_beacon_is_excluded_though_each_field_alone_is_plausible(number: int) -> None:
    rng, passed, excluded = np.random.default_rng(20 + number), 0, 0
    for _ in range(50):
        epoch = an_epoch(with_exchanged(SITE, number, rng), rng)
        alone = epoch[0].distances(epoch[1], ())
        gate = Gate(SITE.channels, (), MagnetometerWatch(SITE))
        nothing = np.zeros(len(EVERY), dtype=bool)
        gate.passed(epoch[0], epoch[1], EVERY, nothing)
        assert set(gate.refused) <= {SITE.beacons[number].name}
        passed += bool(np.all(alone < 40.0))  # chi square of six at 5e-7
        excluded += false_beacons(epoch) == [number]
    assert passed > 10
    assert excluded >= 45


def test_of_two_beacons_neither_is_excluded() -> None:
    rng, valid = np.random.default_rng(3), BEACON < 2
    epochs = [an_epoch(with_exchanged(SITE, 1, rng), rng) for _ in range(20)]
    assert not any(false_beacons(epoch, valid) for epoch in epochs)


def test_a_disturbance_of_all_fields_excludes_none() -> None:
    """As by iron near the sensor: there is no majority that agrees."""
    rng = np.random.default_rng(4)

    def disturbed(phasors: FieldPhasors) -> FieldPhasors:
        share: Array = 1.0 + rng.normal(0.0, 0.03, phasors.measured.shape)
        return replace(phasors, measured=share * phasors.measured)

    for _ in range(50):
        phasors, predicted = an_epoch(SITE, rng)
        assert not false_beacons((disturbed(phasors), predicted))


def test_a_beacon_that_the_prediction_excludes_leaves_a_majority_to_be_had() -> None:
    """Of four beacons a second one is excluded only where more than two remain."""
    rng, first = np.random.default_rng(5), BEACON != 0
    for _ in range(20):
        phasors, predicted = an_epoch(with_exchanged(SITE, 2, rng), rng)
        false = contradicting(phasors.without(~first), predicted, (), BEACON, EVERY, first)
        assert not np.any(false)
