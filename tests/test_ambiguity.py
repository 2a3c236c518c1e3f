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
    free = np.array([not b.synchronised for b in site.beacons])
    phase = np.random.default_rng(3).uniform(-np.pi, np.pi, len(free)) * free
    drives = Drives(phase, np.zeros(len(free)))
    samples = simulate_fields(site, truth, SIGMA, np.random.default_rng(2), drives)
    cov = np.broadcast_to(SIGMA**2 * np.eye(3), samples.phasor_cov.shape)
    return replace(samples, phasor_cov=cov.copy())


def known_attitude(truth):
    """Return a prior that knows the attitude to a milliradian, and nothing of the position."""
    cov = np.diag([1e-6] * 3 + [1e4] * 3)
    return replace(truth, pose_cov=np.broadcast_to(cov, (len(truth), 6, 6)).copy())


def told_of(site, *, attitude=False, tilt=False):
    truth = poses()
    options = {"prior": known_attitude(truth)} if attitude else {}
    if tilt:
        options["gravity"] = Gravity(truth.world_from_body[:, 2], np.full(COUNT, 1e-3))
    fixes = fix_epochs(
        seen(site, truth), initial_calibration(site, 0.0), survey_error=False, **options
    )
    return fixes, relations(fixes, site)


def open_labels(told):
    """Return the labels of best and open rivals of each epoch, as a set."""
    kept = told.is_open | (told.kind == Kind.BEST)
    return [frozenset(row[keep]) for row, keep in zip(told.label, kept, strict=True)]


def share(told, *labels):
    """Return the share of epochs that have these labels and no other."""
    return np.mean([row == frozenset(labels) for row in open_labels(told)])


@pytest.mark.parametrize("knows", ["attitude", "tilt"])
def test_one_beacon_and_the_tilt_leave_the_opposite_side(knows):
    _, told = told_of(floor(1), **{knows: True})
    assert np.all(np.sum(told.is_open, axis=1) == 1)
    assert share(told, "best", "mirror A") == 1.0
    found = ambiguities(told)
    assert found.epochs[Kind.MIRROR] == COUNT
    (sentence,) = found.open
    assert sentence.startswith(f"In {COUNT} of {COUNT} epochs the pose on the opposite side of")


def test_one_beacon_alone_leaves_four_poses():
    _, told = told_of(floor(1))
    assert share(told, "best", "mirror A", "half_turn A", "plane A") == 1.0
    found = ambiguities(told)
    for kind in ("mirror", "half_turn", "plane"):
        assert found.epochs[Kind(kind)] == COUNT
    assert len(found.open) == 3
    assert found.settled == []


def test_one_beacon_of_unknown_phase_leaves_the_azimuth_open():
    _, told = told_of(floor(1, synchronised=False))
    assert np.all(told.azimuth == "A")
    assert set(told.label[told.is_open]) <= {"azimuth A", "mirror A"}
    found = ambiguities(told)
    assert found.epochs[Kind.AZIMUTH] == COUNT
    assert any("any azimuth about beacon A" in sentence for sentence in found.open)


def test_one_beacon_of_unknown_phase_and_known_attitude_leave_the_opposite_side():
    _, told = told_of(floor(1, synchronised=False), attitude=True)
    assert np.all(told.azimuth == "")
    assert set(told.label[told.is_open]) == {"mirror A"}
    assert np.mean(np.sum(told.is_open, axis=1) == 1) > 0.98


@pytest.mark.parametrize("synchronised", [True, False])
@pytest.mark.parametrize("count", [2, 3])
def test_two_beacons_and_the_attitude_leave_one_pose(count, synchronised):
    _, told = told_of(floor(count, synchronised), attitude=True)
    assert not np.any(told.is_open)
    found = ambiguities(told)
    assert found.open == []
    assert found.epochs == {}


@pytest.mark.parametrize("count", [2, 3])
def test_two_beacons_of_known_phase_leave_one_pose_and_say_what_ruled_the_others_out(count):
    fixes, told = told_of(floor(count))
    assert not np.any(told.is_open)
    lost = np.isfinite(fixes.cost) & (fixes.cost - fixes.cost[:, :1] > OPEN)
    assert np.array_equal(told.settled != "", lost)
    assert set(told.settled[lost]) == {"the other beacons"}
    (sentence,) = ambiguities(told).settled
    assert "the other beacons ruled out" in sentence
    assert "mirrored in the plane of the beacons" in sentence


@pytest.mark.parametrize("tilt", [False, True])
@pytest.mark.parametrize("count", [2, 3])
def test_coplanar_beacons_of_unknown_polarity_leave_two_poses(count, tilt):
    _, told = told_of(floor(count, synchronised=False), tilt=tilt)
    assert share(told, "best", "polarity") == 1.0
    assert np.all(np.sum(told.is_open, axis=1) == 1)
    (sentence,) = ambiguities(told).open
    assert "with the opposite heading explains the measurements as well" in sentence


def test_one_synchronised_beacon_settles_the_polarity():
    site = floor(2, synchronised=False)
    site = replace(site, beacons=(replace(site.beacons[0], synchronised=True), site.beacons[1]))
    _, told = told_of(site)
    assert not np.any(told.is_open)
    assert Kind.POLARITY not in told.kind


def test_gravity_is_named_where_it_ruled_a_mirror_out():
    # Weak enough for the rivals to be refined at the fields' own minimum.
    site, truth = floor(1), poses()
    weak = Gravity(truth.world_from_body[:, 2], np.full(COUNT, 0.1))
    fixes = fix_epochs(
        seen(site, truth), initial_calibration(site, 0.0), survey_error=False, gravity=weak
    )
    told = relations(fixes, site)
    assert set(told.settled[told.settled != ""]) == {"gravity"}
    ruled_out = told.label[told.settled == "gravity"]
    assert {"plane A", "half_turn A"} <= set(ruled_out)
    assert np.mean(np.isin(ruled_out, ["plane A", "half_turn A"])) > 0.95
    (sentence,) = ambiguities(told).settled
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
    told = relations(fixes, site)
    assert set(told.settled[told.settled != ""]) == {"the prior"}


def test_the_heading_alone_is_told_from_another_place():
    fixes, _ = told_of(floor(2))
    half = Rotation.from_euler("z", np.pi).as_matrix()
    rotation, position = fixes.world_from_body.copy(), fixes.position_world.copy()
    site = floor(2)
    lever = site.platform.magnetometer.position_body
    rotation[:, 1] = half @ rotation[:, 0]
    position[:, 1] = position[:, 0] + (rotation[:, 0] - rotation[:, 1]) @ lever
    cost = fixes.cost.copy()
    cost[:, 1], cost[:, 2:] = cost[:, 0], np.inf
    turned = replace(fixes, world_from_body=rotation, position_world=position, cost=cost)
    assert np.all(relations(turned, site).label[:, 1] == Kind.HEADING)
    position[:, 1] += np.array([0.3, 0.1, 0.2])
    assert np.all(relations(turned, site).label[:, 1] == Kind.ELSEWHERE)


def test_hypotheses_that_are_not_there_have_no_relation():
    fixes, told = told_of(floor(3))
    assert np.array_equal(told.kind == Kind.NONE, ~np.isfinite(fixes.cost))
    assert np.all(told.label[:, 0] == "best")
