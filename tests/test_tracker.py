"""The closed forms of a tracker: exact on ideal data, and paper 000 as printed shown wrong."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tracker_poses import refine_poses, unit_coupling, world_poses
from tracker_site import body_poses, in_beacon, tracker_site

from magfusion.errors import EstimationError, InputError
from magfusion.estimation.snapshot.candidates import beacon_directions
from magfusion.estimation.snapshot.likelihood import fix_epochs
from magfusion.model.antenna import antenna_of
from magfusion.model.field import predict
from magfusion.model.parameters import initial_calibration
from magfusion.model.physics.dipole import dipole_field
from magfusion.model.samples import FieldSamples
from magfusion.papers.p000_tracker.equations import (
    Correction,
    attitude_from_angles,
    bursa_wolf_matrix,
    eq_01_coupling,
    eq_05_coupling,
    eq_09_whitened,
    eq_10_coupling_as_printed,
    eq_11_attitude,
    eq_11_attitude_as_printed,
    eq_11_attitude_of_eq_10,
    euler_angles,
)
from magfusion.papers.p000_tracker.pose import locate_by_svd
from magfusion.units import DEGREE, MU0_OVER_4PI

NONE = np.zeros((3, 3))


def between_deg(result: np.ndarray, true: np.ndarray) -> np.ndarray:
    turn = np.swapaxes(true, -1, -2) @ result
    return np.asarray(Rotation.from_matrix(turn).magnitude() / DEGREE)


def ideal(number: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return H, positions and couplings of ideal antennas."""
    rng = np.random.default_rng(seed)
    attitude = Rotation.random(number, rng=rng).as_matrix()
    position = rng.standard_normal((number, 3))
    position *= rng.uniform(0.3, 0.6, (number, 1)) / np.linalg.norm(position, axis=1)[:, None]
    fields = np.swapaxes(dipole_field(position[:, None], np.eye(3)), 1, 2)
    return attitude, position, attitude @ fields


def rms(error: np.ndarray) -> float:
    return float(np.sqrt(np.mean(error**2)))


def polar(matrix: np.ndarray) -> np.ndarray:
    remaining, _, right = np.linalg.svd(matrix)
    return remaining @ right


def test_one_svd_gives_attitude_range_and_bearing_exactly() -> None:
    attitude, position, coupling = ideal(200)
    fix = locate_by_svd(coupling).nearest(position)
    np.testing.assert_allclose(fix.sensor_from_beacon, attitude, rtol=0, atol=1e-9)
    np.testing.assert_allclose(fix.position_beacon[:, 0], position, rtol=0, atol=1e-9)
    np.testing.assert_allclose(fix.position_beacon[:, 1], -position, rtol=0, atol=1e-9)
    np.testing.assert_allclose(fix.distance, np.linalg.norm(position, axis=1), rtol=1e-12)
    assert np.max(fix.residual) < 1e-12


def test_batches_of_any_shape() -> None:
    _, position, coupling = ideal(12)
    flat = locate_by_svd(coupling).nearest(position)
    grid = locate_by_svd(coupling.reshape(3, 4, 3, 3)).nearest(position.reshape(3, 4, 3))
    assert grid.position_beacon.shape == (3, 4, 2, 3)
    np.testing.assert_array_equal(grid.position_beacon.reshape(12, 2, 3), flat.position_beacon)


def test_general_antennas_are_whitened() -> None:
    rng = np.random.default_rng(1)
    attitude, position, coupling = ideal(50)
    receiver, transmitter = (np.eye(3) + 0.2 * rng.standard_normal((3, 3)) for _ in range(2))
    seen = receiver @ coupling @ transmitter
    fix = locate_by_svd(eq_09_whitened(seen, np.linalg.inv(receiver), transmitter)).nearest(
        position
    )
    np.testing.assert_allclose(fix.sensor_from_beacon, attitude, rtol=0, atol=1e-9)
    np.testing.assert_allclose(fix.position_beacon[:, 0], position, rtol=0, atol=1e-9)


def test_eq_1_has_the_minus_that_goes_with_its_matrix() -> None:
    attitude, position, coupling = ideal(5)
    distance = np.linalg.norm(position, axis=1)[:, None, None]
    printed = eq_01_coupling(MU0_OVER_4PI, attitude, position, np.eye(3))
    np.testing.assert_allclose(coupling, printed, rtol=0, atol=1e-13 * np.max(coupling))
    np.testing.assert_allclose(
        np.linalg.det(coupling * distance**3 / MU0_OVER_4PI), 2.0, rtol=1e-12
    )


@pytest.mark.parametrize("angles_deg", [(10.0, 20.0, 30.0), (170.0, -40.0, -120.0)])
def test_angles_and_attitude(angles_deg: tuple[float, float, float]) -> None:
    angles = np.array(angles_deg) * DEGREE
    np.testing.assert_allclose(euler_angles(attitude_from_angles(angles)), angles, atol=1e-14)


def test_an_arctangent_of_the_quotient_is_off_by_half_a_turn() -> None:
    """Eq 12 and 14 hold on all of the circle only with two arguments."""
    attitude = attitude_from_angles(np.array([170.0, 0.0, 10.0]) * DEGREE)
    for rotated in (attitude, attitude_from_angles(np.array([10.0, 0.0, 170.0]) * DEGREE)):
        angles = euler_angles(rotated) / DEGREE
        quotients = np.array([rotated[0, 1] / rotated[0, 0], rotated[1, 2] / rotated[2, 2]])
        wrong = np.abs(angles[[0, 2]]) > 90.0
        off = np.abs(angles[[0, 2]] - np.arctan(quotients) / DEGREE)
        np.testing.assert_allclose(off, 180.0 * wrong, atol=1e-12)


def test_eq_11_as_printed_does_not_invert_eq_10() -> None:
    rng = np.random.default_rng(2)
    attitude, position, _ = ideal(50)
    drive = np.eye(3) + 0.1 * rng.standard_normal((3, 3))
    parts = [rng.standard_normal((3, 3)) for _ in range(5)]
    gain = 1.0
    correction = Correction(
        transmitter_rotation=np.eye(3) + 0.02 * parts[0],
        transmitter_shift=0.005 * parts[1],
        receiver_rotation=np.eye(3) + 0.02 * parts[2],
        receiver_shift=0.005 * parts[3],
        ambient=0.1 * parts[4],
    )
    seen = eq_10_coupling_as_printed(gain, attitude, position, drive, correction)
    printed = eq_11_attitude_as_printed(seen, position, gain, drive, correction)
    repaired = eq_11_attitude_of_eq_10(seen, position, gain, drive, correction)
    assert np.max(np.abs(printed - attitude)) > 0.1
    np.testing.assert_allclose(repaired, attitude, rtol=0, atol=1e-12)


def test_eq_11_corrected_is_exact() -> None:
    rng = np.random.default_rng(3)
    attitude, position, coupling = ideal(50)
    receiver, transmitter = (np.eye(3) + 0.1 * rng.standard_normal((3, 3)) for _ in range(2))
    ambient = 1e-6 * rng.standard_normal((3, 1)) * np.ones(3)  # T, the same in every slot
    seen = np.linalg.inv(receiver) @ coupling @ transmitter + ambient
    result = eq_11_attitude(seen, position, receiver, transmitter, ambient)
    np.testing.assert_allclose(result, attitude, rtol=0, atol=1e-12)


def test_printed_rotations_make_it_worse_and_corrected_ones_better() -> None:
    """Rigid errors of one degree about each axis of both antennas, other ones at each pose."""
    attitude, position, coupling = ideal(20_000)
    rng = np.random.default_rng(4)
    turns = [DEGREE * rng.standard_normal((len(position), 3)) for _ in range(2)]
    sent, seen = (Rotation.from_rotvec(turn).as_matrix() for turn in turns)
    measured = np.swapaxes(seen, 1, 2) @ coupling @ sent
    sent_matrix, seen_matrix = (bursa_wolf_matrix(turn) for turn in turns)
    known = Correction(np.linalg.inv(sent_matrix), NONE, np.linalg.inv(seen_matrix), NONE, NONE)
    printed = eq_11_attitude_as_printed(measured, position, MU0_OVER_4PI, np.eye(3), known)
    corrected = eq_11_attitude(measured, position, seen_matrix, sent_matrix, NONE)
    before = rms(between_deg(locate_by_svd(measured).sensor_from_beacon, attitude))
    after = rms(between_deg(polar(printed), attitude))
    assert before == pytest.approx(2.67, abs=0.3)
    assert after == pytest.approx(4.86, abs=0.5)
    assert after > 1.7 * before
    assert rms(between_deg(corrected, attitude)) < 0.02


@pytest.mark.parametrize(
    "wiring",
    [np.diag([1.0, -1.0, 1.0]), np.eye(3)[[1, 0, 2]], -np.eye(3)],
    ids=["sign of a coil", "two coils swapped", "sign of Eq 1"],
)
def test_a_wrong_wire_is_named(wiring: np.ndarray) -> None:
    _, _, coupling = ideal(4)
    coupling[2] = coupling[2] @ wiring
    with pytest.raises(EstimationError, match=r"coupling 2 .*swapped.*sign"):
        locate_by_svd(coupling)


def test_a_silent_coil_is_named() -> None:
    _, _, coupling = ideal(4)
    coupling[1, 2] = 0.0
    with pytest.raises(EstimationError, match=r"coupling 1 is singular: a coil is silent"):
        locate_by_svd(coupling)
    coupling[1, 2] = np.nan
    with pytest.raises(EstimationError, match=r"coupling 1 is not finite"):
        locate_by_svd(coupling)


def test_a_flat_beacon_is_refused() -> None:
    site = tracker_site(np.random.default_rng(0))
    flat = replace(site.beacons[0], coils=site.beacons[0].coils[:2])
    with pytest.raises(InputError, match=r"beacon T: its moments lie in one plane"):
        unit_coupling(flat, np.zeros((4, 2, 3), complex), np.eye(3))


def test_phasors_of_a_beacon_give_the_poses_of_the_body() -> None:
    """Phases, general moments and matrix, mounting and lever arm; the coils' centres coincide."""
    rng = np.random.default_rng(5)
    site = tracker_site(rng, gain=0.1, tilt=0.1, centre=0.0)
    beacon, sensor = site.beacons[0], site.platform.magnetometer
    attitude, place = body_poses(site, 30, rng)
    phase = np.array([0.2, -0.9, 2.5])  # rad; beyond the coils' own
    phasor = predict(beacon, sensor, attitude, place, np.broadcast_to(phase, (30, 3)))
    unit = unit_coupling(beacon, phasor, sensor.matrix, np.broadcast_to(phase, (30, 3)))
    fix = locate_by_svd(unit).nearest(in_beacon(site, attitude, place)[1])
    found_attitude, found_place = world_poses(site, beacon, fix)
    np.testing.assert_allclose(found_attitude[:, 0], attitude, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found_place[:, 0], place, rtol=0, atol=1e-9)
    opposite = np.abs(predict(beacon, sensor, found_attitude[:, 1], found_place[:, 1]))
    np.testing.assert_allclose(opposite, np.abs(phasor), rtol=0, atol=1e-9 * np.max(opposite))


def test_the_gram_matrix_of_the_general_fix_agrees() -> None:
    rng = np.random.default_rng(6)
    site = tracker_site(rng, gain=0.1, tilt=0.1, centre=0.0)
    beacon, sensor = site.beacons[0], site.platform.magnetometer
    attitude, place = body_poses(site, 30, rng)
    phasor = predict(beacon, sensor, attitude, place)
    fix = locate_by_svd(unit_coupling(beacon, phasor, sensor.matrix))
    direction, distance = beacon_directions(beacon, phasor @ np.linalg.inv(sensor.matrix).T)
    np.testing.assert_allclose(distance[:, 0], fix.distance, rtol=1e-9)
    ours = fix.nearest(direction[:, 0]).position_beacon
    np.testing.assert_allclose(direction * distance[..., None], ours, rtol=0, atol=1e-9)


def test_the_likelihood_agrees_with_the_closed_form() -> None:
    """With 60 dB of noise: within a few per cent of one another's error, as both should be."""
    rng = np.random.default_rng(7)
    site = tracker_site(rng, centre=0.0)
    beacon, sensor = site.beacons[0], site.platform.magnetometer
    attitude, place = body_poses(site, 60, rng)
    phasor = predict(beacon, sensor, attitude, place)
    position = in_beacon(site, attitude, place)[1]
    sigma = 1e-3 * MU0_OVER_4PI / np.linalg.norm(position, axis=1) ** 3
    noise = rng.standard_normal((2, *phasor.shape))
    phasor = phasor + sigma[:, None, None] * (noise[0] + 1j * noise[1])
    cov = np.broadcast_to(sigma[:, None, None, None] ** 2 * np.eye(3), (60, 3, 3, 3)).copy()
    samples = FieldSamples(np.arange(60.0), np.ones(60), site.channels, phasor, cov)
    fixes = fix_epochs(samples, initial_calibration(site, 0.0), survey_error=False)
    unit = unit_coupling(beacon, phasor, sensor.matrix)
    closed, _ = world_poses(site, beacon, locate_by_svd(unit))
    separate = between_deg(fixes.world_from_body[:, 0], closed[:, 0])
    error = between_deg(closed[:, 0], attitude)
    assert rms(separate) < 0.5 * rms(error)
    assert rms(between_deg(fixes.world_from_body[:, 0], attitude)) == pytest.approx(
        rms(error), rel=0.1
    )


def test_refined_poses_know_the_centres() -> None:
    rng = np.random.default_rng(8)
    site = tracker_site(rng, centre=3e-3)
    antenna = antenna_of(site.beacons[0], site.platform.magnetometer)
    attitude, place = body_poses(site, 30, rng)
    true = in_beacon(site, attitude, place)
    phasor = predict(site.beacons[0], site.platform.magnetometer, attitude, place)
    unit = unit_coupling(site.beacons[0], phasor, site.platform.magnetometer.matrix)
    start = locate_by_svd(unit).nearest(true[1])
    begin = np.swapaxes(start.sensor_from_beacon, 1, 2)
    coupling = np.swapaxes((phasor * np.exp(-0.3j * np.arange(3))[:, None]).real, 1, 2)
    result = refine_poses(antenna, coupling, begin, start.position_beacon[:, 0])
    assert rms(between_deg(begin, true[0])) > 0.1
    np.testing.assert_allclose(result[0], true[0], rtol=0, atol=1e-9)
    np.testing.assert_allclose(result[1], true[1], rtol=0, atol=1e-9)


def test_the_general_fix_knows_the_centres_too() -> None:
    """Through `observe`, without the tracker's closed form; noise as good as none."""
    rng = np.random.default_rng(10)
    site = tracker_site(rng, centre=3e-3)
    attitude, place = body_poses(site, 12, rng)
    phasor = predict(site.beacons[0], site.platform.magnetometer, attitude, place)
    cov = np.broadcast_to(1e-22 * np.eye(3), (12, 3, 3, 3)).copy()  # T^2
    samples = FieldSamples(np.arange(12.0), np.ones(12), site.channels, phasor, cov)
    fixes = fix_epochs(samples, initial_calibration(site, 0.0), survey_error=False)
    np.testing.assert_allclose(fixes.position_world[:, 0], place, rtol=0, atol=1e-7)
    assert np.max(between_deg(fixes.world_from_body[:, 0], attitude)) < 1e-5


def test_a_runaway_is_no_pose() -> None:
    _, position, coupling = ideal(3)
    site = tracker_site(np.random.default_rng(9))
    antenna = antenna_of(site.beacons[0], site.platform.magnetometer)
    wrong = np.broadcast_to(np.eye(3), (3, 3, 3))
    with pytest.raises(EstimationError, match="does not converge"):
        refine_poses(antenna, coupling, wrong, 3.0 * position[::-1], iterations=2)


def test_eq_2_to_5_are_what_is_measured_with_one_vector_in_all_columns() -> None:
    """Each slot has the field of its coil and the ambient one, in the receiver's axes."""
    attitude, position, coupling = ideal(50)
    ambient = 2e-8 * np.array([1.0, -2.0, 0.5])  # T, three axes
    slots = [coupling[:, :, k] + ambient for k in range(3)]
    measured = np.stack(slots, axis=2)
    by_axis, by_slot = np.tile(ambient[:, None], 3), np.tile(ambient, (3, 1))
    drive = np.eye(3)
    meant = eq_05_coupling(MU0_OVER_4PI, attitude, position, drive, by_axis)
    np.testing.assert_allclose(meant, measured, rtol=0, atol=1e-13 * np.max(measured))
    # As printed: A1 is what the first axis reads, and is in the first slot, on all axes.
    printed = eq_05_coupling(MU0_OVER_4PI, attitude, position, drive, by_slot)
    assert np.max(np.abs(printed - measured)) > np.max(np.abs(ambient))
    for removed, is_right in ((by_axis, True), (by_slot, False), (NONE, False)):
        found = locate_by_svd(measured - removed).sensor_from_beacon
        assert bool(rms(between_deg(found, attitude)) < 1e-6) is is_right


@pytest.mark.parametrize("cause", ["receiver turned", "transmitter off its centre"])
def test_no_matrices_of_eq_9_and_10_hold_what_they_are_for(cause: str) -> None:
    """Of ideal couplings Y Eq 10 makes Y Z + D, Z and D constant, at one distance."""
    attitude, position, _ = ideal(300)
    position *= 0.4 / np.linalg.norm(position, axis=1, keepdims=True)  # m

    def coupling(moved: np.ndarray) -> np.ndarray:
        fields = dipole_field((position - moved)[:, None], np.eye(3)) / MU0_OVER_4PI
        return attitude @ np.swapaxes(fields, 1, 2)

    plain = coupling(np.zeros(3))
    turn = Rotation.from_rotvec([0.0, 0.0, 1.0 * DEGREE]).as_matrix()
    if cause == "receiver turned":
        measured = turn @ plain
        np.testing.assert_allclose(turn.T @ measured, plain, rtol=0, atol=1e-12)  # T on the left
    else:
        measured = coupling(np.array([3e-3, 0.0, 0.0]))

    def share_left(wanted: np.ndarray) -> float:
        """Return what the best Z and D leave of the change from ideal couplings."""
        design = np.concatenate([plain, np.tile(np.eye(3), (len(plain), 1, 1))], axis=2)
        rows, values = design.reshape(-1, 6), wanted.reshape(-1, 3)
        best = np.linalg.lstsq(rows, values, rcond=None)[0]
        return float(np.linalg.norm(rows @ best - values) / np.linalg.norm(wanted - plain))

    rng = np.random.default_rng(5)
    anything = Correction(*(np.eye(3) + 0.1 * rng.standard_normal((5, 3, 3))))
    printed = eq_10_coupling_as_printed(1.0, attitude, position, np.eye(3), anything)
    assert share_left(printed) < 1e-9
    assert share_left(measured) > 0.9


def test_the_printed_correction_helps_in_neither_sense_of_its_rotations() -> None:
    """The paper does not say how R_x, R_y and R_z are counted: Q and T, or their inverses."""
    attitude, position, coupling = ideal(20_000)
    rng = np.random.default_rng(4)
    turns = [DEGREE * rng.standard_normal((len(position), 3)) for _ in range(2)]
    sent, seen = (Rotation.from_rotvec(turn).as_matrix() for turn in turns)
    measured = np.swapaxes(seen, 1, 2) @ coupling @ sent
    before = rms(between_deg(locate_by_svd(measured).sensor_from_beacon, attitude))
    after = []
    for sign in (1.0, -1.0):
        q, t = (np.linalg.inv(bursa_wolf_matrix(sign * turn)) for turn in turns)
        known = Correction(q, NONE, t, NONE, NONE)
        printed = eq_11_attitude_as_printed(measured, position, MU0_OVER_4PI, np.eye(3), known)
        after.append(rms(between_deg(polar(printed), attitude)))
    assert before == pytest.approx(2.45, abs=0.1)
    assert after == pytest.approx([4.84, 2.68], rel=0.05)
    assert min(after) > before
