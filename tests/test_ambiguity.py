"""Every row of the table of ambiguity groups: which poses are left, and how they are called."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from magfusion.estimation.snapshot.ambiguity import OPEN, Kind, ambiguities, relations
from magfusion.estimation.snapshot.fix import Gravity
from magfusion.estimation.snapshot.likelihood import fix_epochs
from magfusion.model.parameters import initial_calibration
from magfusion.model.trajectory import Trajectory
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.field import Drives
from magfusion.simulation.log import simulate_fields

SIGMA = 3e-10  # T, of a phasor's component
COUNT = 150
PLACES = np.array([[0.0, 0.0, 0.0], [3.0, 0.5, 0.0], [1.0, 3.0, 0.0]])


def floor(count, synchronised=True):
    """Return coplanar parallel beacons, dipoles that are known exactly."""
    site = demo_site(coil_radius=None, synchronised=synchronised)
    beacons = tuple(
        replace(b, position_world=place, world_from_beacon=np.eye(3))
        for b, place in zip(site.beacons, PLACES[:count], strict=False)
    )
    return replace(site, beacons=beacons, model_error=0.0)


def poses(seed=5):
    rng = np.random.default_rng(seed)
    attitudes = Rotation.random(COUNT, random_state=seed).as_matrix()
    return Trajectory(np.arange(float(COUNT)), attitudes, rng.uniform(*DEMO_BOX_WORLD, (COUNT, 3)))


def seen(site, truth):
    free_parameters = np.array([not b.synchronised for b in site.beacons])
    phase = np.random.default_rng(3).uniform(-np.pi, np.pi, len(free_parameters)) * free_parameters
    drives = Drives(phase, np.zeros(len(free_parameters)))
    samples = simulate_fields(site, truth, SIGMA, np.random.default_rng(2), drives)
    cov = np.broadcast_to(SIGMA**2 * np.eye(3), samples.phasor_cov.shape)
    return replace(samples, phasor_cov=cov.copy())


def known_attitude(truth):
    """Return a prior that knows the attitude to a milliradian, and nothing of the position."""
    cov = np.diag([1e-6] * 3 + [1e4] * 3)
    return replace(truth, pose_cov=np.broadcast_to(cov, (len(truth), 6, 6)).copy())


def release_gain(site, *, attitude=False, tilt=False):
    truth = poses()
    options = {"prior": known_attitude(truth)} if attitude else {}
    if tilt:
        options["gravity"] = Gravity(truth.world_from_body[:, 2], np.full(COUNT, 1e-3))
    fixes = fix_epochs(
        seen(site, truth), initial_calibration(site, 0.0), survey_error=False, **options
    )
    return fixes, relations(fixes, site)


def open_labels(reported):
    """Return the labels of best and open rivals of each epoch, as a set."""
    kept = reported.is_open | (reported.kind == Kind.BEST)
    return [frozenset(row[keep]) for row, keep in zip(reported.label, kept, strict=True)]


def share(reported, *labels):
    """Return the share of epochs that have these labels and no other."""
    return np.mean([row == frozenset(labels) for row in open_labels(reported)])


@pytest.mark.parametrize("knows", ["attitude", "tilt"])
def test_one_beacon_and_the_tilt_leave_the_opposite_side(knows):
    _, reported = release_gain(floor(1), **{knows: True})
    assert np.all(np.sum(reported.is_open, axis=1) == 1)
    assert share(reported, "best", "mirror A") == 1.0
    result = ambiguities(reported)
    assert result.epochs[Kind.MIRROR] == COUNT
    (sentence,) = result.open
    assert sentence.startswith(f"In {COUNT} of {COUNT} epochs the pose on the opposite side of")


def test_one_beacon_alone_leaves_four_poses():
    _, reported = release_gain(floor(1))
    assert share(reported, "best", "mirror A", "half_turn A", "plane A") == 1.0
    result = ambiguities(reported)
    for kind in ("mirror", "half_turn", "plane"):
        assert result.epochs[Kind(kind)] == COUNT
    assert len(result.open) == 3
    assert result.resolved == []


def test_one_beacon_of_unknown_phase_leaves_the_azimuth_open():
    _, reported = release_gain(floor(1, synchronised=False))
    assert np.all(reported.azimuth == "A")
    assert set(reported.label[reported.is_open]) <= {"azimuth A", "mirror A"}
    result = ambiguities(reported)
    assert result.epochs[Kind.AZIMUTH] == COUNT
    assert any("any azimuth about beacon A" in sentence for sentence in result.open)


def test_one_beacon_of_unknown_phase_and_known_attitude_leave_the_opposite_side():
    _, reported = release_gain(floor(1, synchronised=False), attitude=True)
    assert np.all(reported.azimuth == "")
    assert set(reported.label[reported.is_open]) == {"mirror A"}
    assert np.mean(np.sum(reported.is_open, axis=1) == 1) > 0.98


@pytest.mark.parametrize("synchronised", [True, False])
@pytest.mark.parametrize("count", [2, 3])
def test_two_beacons_and_the_attitude_leave_one_pose(count, synchronised):
    _, reported = release_gain(floor(count, synchronised), attitude=True)
    assert not np.any(reported.is_open)
    result = ambiguities(reported)
    assert result.open == []
    assert result.epochs == {}


@pytest.mark.parametrize("count", [2, 3])
def test_two_beacons_of_known_phase_leave_one_pose_and_say_what_ruled_the_others_out(count):
    fixes, reported = release_gain(floor(count))
    assert not np.any(reported.is_open)
    lost_epochs = np.isfinite(fixes.cost) & (fixes.cost - fixes.cost[:, :1] > OPEN)
    assert np.array_equal(reported.resolved != "", lost_epochs)
    assert set(reported.resolved[lost_epochs]) == {"the other beacons"}
    (sentence,) = ambiguities(reported).resolved
    assert "the other beacons ruled out" in sentence
    assert "mirrored in the plane of the beacons" in sentence


@pytest.mark.parametrize("tilt", [False, True])
@pytest.mark.parametrize("count", [2, 3])
def test_coplanar_beacons_of_unknown_polarity_leave_two_poses(count, tilt):
    _, reported = release_gain(floor(count, synchronised=False), tilt=tilt)
    assert share(reported, "best", "polarity") == 1.0
    assert np.all(np.sum(reported.is_open, axis=1) == 1)
    (sentence,) = ambiguities(reported).open
    assert "with the opposite heading explains the measurements as well" in sentence


def test_one_synchronised_beacon_settles_the_polarity():
    site = floor(2, synchronised=False)
    site = replace(site, beacons=(replace(site.beacons[0], synchronised=True), site.beacons[1]))
    _, reported = release_gain(site)
    assert not np.any(reported.is_open)
    assert Kind.POLARITY not in reported.kind


def test_gravity_is_named_where_it_ruled_a_mirror_out():
    # Weak enough for the rivals to be refined at the fields' own minimum.
    site, truth = floor(1), poses()
    weak = Gravity(truth.world_from_body[:, 2], np.full(COUNT, 0.1))
    fixes = fix_epochs(
        seen(site, truth), initial_calibration(site, 0.0), survey_error=False, gravity=weak
    )
    reported = relations(fixes, site)
    assert set(reported.resolved[reported.resolved != ""]) == {"gravity"}
    ruled_out = reported.label[reported.resolved == "gravity"]
    assert {"plane A", "half_turn A"} <= set(ruled_out)
    assert np.mean(np.isin(ruled_out, ["plane A", "half_turn A"])) > 0.95
    (sentence,) = ambiguities(reported).resolved
    assert "gravity ruled out the pose mirrored in the plane of beacon A" in sentence


def test_a_prior_is_named_where_it_decided():
    site, truth = floor(1), poses()
    cov = np.broadcast_to(0.25 * np.eye(6), (COUNT, 6, 6)).copy()
    fixes = fix_epochs(
        seen(site, truth),
        initial_calibration(site, 0.0),
        survey_error=False,
        prior=replace(truth, pose_cov=cov),
    )
    reported = relations(fixes, site)
    assert set(reported.resolved[reported.resolved != ""]) == {"the prior"}


def test_the_heading_alone_is_told_from_another_place():
    fixes, _ = release_gain(floor(2))
    half = Rotation.from_euler("z", np.pi).as_matrix()
    rotation, position = fixes.world_from_body.copy(), fixes.position_world.copy()
    site = floor(2)
    lever = site.platform.magnetometer.position_body
    rotation[:, 1] = half @ rotation[:, 0]
    position[:, 1] = position[:, 0] + (rotation[:, 0] - rotation[:, 1]) @ lever
    cost = fixes.cost.copy()
    cost[:, 1], cost[:, 2:] = cost[:, 0], np.inf
    rotated = replace(fixes, world_from_body=rotation, position_world=position, cost=cost)
    assert np.all(relations(rotated, site).label[:, 1] == Kind.HEADING)
    position[:, 1] += np.array([0.3, 0.1, 0.2])
    assert np.all(relations(rotated, site).label[:, 1] == Kind.ELSEWHERE)


def test_hypotheses_that_are_not_there_have_no_relation():
    fixes, reported = release_gain(floor(3))
    assert np.array_equal(reported.kind == Kind.NONE, ~np.isfinite(fixes.cost))
    assert np.all(reported.label[:, 0] == "best")
