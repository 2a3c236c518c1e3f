"""Tones half a hertz apart: what short windows tell of all of them together."""

from dataclasses import replace

import many_beacons
import numpy as np
import pytest
from derivatives import central_difference, relative_to_group
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from magfusion.estimation.batch.batch import Smoothed, smooth
from magfusion.estimation.demodulation.close_tones import _of_channels
from magfusion.estimation.graph.state import MOTION, State, States, states_in
from magfusion.estimation.integrity.judge import judge_result
from magfusion.estimation.integrity.smoothed_separation import separate_smoothed
from magfusion.estimation.measurements.joint_phasors import JointPhasors
from magfusion.estimation.measurements.phasors import FieldPhasors
from magfusion.estimation.online.navigator import Navigator
from magfusion.estimation.online.navigator_settings import NavigatorSettings
from magfusion.estimation.online.restored import restored
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.model.trust import Verdict
from magfusion.receiver.joint import NODES, JointDesign, joint_settings, long_windows
from magfusion.receiver.windows import default_settings

BOX_WORLD = np.array([[2.0, 2.0, 0.9], [10.0, 6.0, 1.4]])  # m
RATE_HZ = 600.0
LIMIT = float(chdtri(6, 1e-6))


def room(spacing: float = 0.5) -> Site:
    """Return six beacons in a room of 12 by 8 m."""
    rng = np.random.default_rng(11)
    site = many_beacons.building(rng, 3, 2, many_beacons.spaced_hz(spacing))
    moved = tuple(
        replace(
            b, position_world=b.position_world * [0.12, 0.13, 1.0], frequency_hz=70.0 + spacing * k
        )
        for k, b in enumerate(site.beacons)
    )
    return replace(site, beacons=moved)


@pytest.fixture(scope="module")
def log() -> Log:
    return many_beacons.walked(room(), 0.15, BOX_WORLD, RATE_HZ, 3)


@pytest.fixture(scope="module")
def smoothed(log: Log) -> Smoothed:
    return smooth(log, room())


def joint_of(result: Smoothed) -> JointPhasors:
    (estimate,) = [m for m in result.graph.measurements if isinstance(m, JointPhasors)]
    return estimate


def one(result: Smoothed, row: int) -> tuple[JointPhasors, States]:
    joint = joint_of(result).rows(slice(row, row + 1))
    return joint, states_in(result.estimate.values).rows(joint.epoch)


def test_only_close_tones_are_told_together() -> None:
    site = room()
    assert joint_settings(room(5.0), None) is None
    assert joint_settings(site, default_settings(site)) is None
    assert joint_settings(replace(site, beacons=site.beacons[:1]), None) is None
    settings = joint_settings(site, None)
    assert settings is not None
    assert settings.window == settings.step < default_settings(site).window


def test_why_close_tones_are_not_told_together_is_said() -> None:
    site = room()
    two = site.platform.with_magnetometers(
        (site.platform.magnetometer, replace(site.platform.magnetometer, name="second"))
    )
    one = replace(site.platform, magnetometer=replace(site.platform.magnetometer, axes="z"))
    assert long_windows(site, None) == ()
    for platform, why in ((two, "several magnetometers"), (one, "fewer axes than three")):
        (finding,) = long_windows(replace(site, platform=platform), None)
        assert finding.verdict is Verdict.TRUSTWORTHY
        assert why in finding.text
        assert long_windows(replace(room(5.0), platform=platform), None) == ()


def test_the_directions_of_a_window_are_those_of_its_phasors() -> None:
    site, rng = room(), np.random.default_rng(2)
    settings = joint_settings(site, None)
    assert settings is not None
    frequencies = np.array([b.frequency_hz for b in site.beacons])
    elapsed = np.arange(-0.5 * settings.window, 0.5 * settings.window, 1.0 / RATE_HZ) + 1e-4
    design, centre = JointDesign.of(elapsed, frequencies, settings, None), 17.3
    assert design.across.shape[1] < 2 * len(frequencies) + 2
    affected = np.ones((1, len(frequencies)), dtype=bool)
    basis = _of_channels(design.tones[None], np.array([centre]), site, affected)[0]
    # A field that changes as a parabola, under the mains and a drift of the static field.
    phasor = rng.normal(size=(3, len(frequencies))) + 1j * rng.normal(size=(3, len(frequencies)))
    grown = np.polynomial.polynomial.polyval(elapsed, phasor)
    carrier = np.exp(2j * np.pi * frequencies[:, None] * (centre + elapsed))
    samples = np.sum((grown * carrier).real, axis=0)
    samples += 3.0 + 5.0 * elapsed + 2.0 * np.sin(2.0 * np.pi * 50.0 * elapsed + 0.4)
    nodes = 0.5 * settings.window * np.array(NODES)
    at_nodes = np.polynomial.polynomial.polyval(nodes, phasor).T
    parts = np.stack([at_nodes.real, at_nodes.imag], axis=-1).reshape(len(nodes), -1)
    expected = np.einsum("rkc,kc->r", basis, parts)
    assert design.across.T @ samples == pytest.approx(expected, abs=1e-9 * np.max(np.abs(expected)))
    assert np.max(np.abs(design.extra_design.T @ design.across)) < 1e-9


@pytest.mark.slow
def test_short_windows_have_the_say_and_leave_what_noise_does(smoothed: Smoothed) -> None:
    joint = joint_of(smoothed)
    (long,) = [m for m in smoothed.graph.measurements if isinstance(m, FieldPhasors)]
    assert long.excess is not None
    assert np.min(long.excess) > 1e5
    assert len(joint.time) > 10 * len(long.time)
    remaining = smoothed.graph.residual(joint, smoothed.estimate)
    # Of model error there is none in the samples, though the site declares some.
    assert 0.4 < float(np.mean(remaining**2)) < 1.1


@pytest.mark.slow
def test_derivatives_are_those_of_differences(smoothed: Smoothed) -> None:
    joint, at = one(smoothed, 9)
    rows = joint.linearize(at, smoothed.calibration, ())

    def error(step: np.ndarray) -> np.ndarray:
        turn = at.world_from_body @ Rotation.from_rotvec(step[:3]).as_matrix()
        shift = at.world_from_body[0] @ step[3:6]
        moved = States(turn, at.position_world + shift, at.velocity_world + step[6:], at.read_bias)
        return joint.error(moved, smoothed.calibration)[0, 0]

    result = central_difference(error, 9, 1e-5)
    assert rows.by_pose is not None
    assert rows.by_velocity is not None
    assert rows.error[0, 0] == pytest.approx(error(np.zeros(9)), abs=1e-9)
    for part, columns in (
        (rows.by_pose[0, 0, :, :3], slice(3)),
        (rows.by_pose[0, 0, :, 3:], slice(3, 6)),
        (rows.by_velocity[0, 0], slice(6, 9)),
    ):
        assert relative_to_group(part, result[:, columns]) < 1e-4


def test_what_is_left_out_says_nothing_and_what_is_false_is_named(smoothed: Smoothed) -> None:
    joint, at = one(smoothed, 9)
    channel = 2
    assert joint.is_predicted[0, channel]
    corrupted = np.zeros((1, joint.is_predicted.shape[1], 2))
    corrupted[0, channel] = 5e-8  # T
    whole = np.einsum(
        "nrkcp,nkc,ncp->nr",
        joint.basis.reshape(*joint.basis.shape[:3], -1, 2),
        joint.strength,
        corrupted,
    )
    false = replace(joint, measured=joint.measured + np.repeat(whole, 3, axis=1))
    own = np.arange(joint.is_predicted.shape[1]) == channel
    before = joint.without(own).error(at, smoothed.calibration)
    after = false.without(own).error(at, smoothed.calibration)
    assert np.max(np.abs(after - before)) < 1e-6 * np.max(
        np.abs(false.error(at, smoothed.calibration))
    )
    cov = np.diag(np.repeat([1e-3, 1e-2, 1e-2, 1e-3, 1e-4], 3) ** 2)
    state = State(
        float(joint.time[0]),
        at.world_from_body[0],
        at.position_world[0],
        at.velocity_world[0],
        np.zeros(3),
        np.zeros(3),
        smoothed.calibration,
        cov,
    )
    assert len(cov) == MOTION
    assert np.flatnonzero(false.distances(state, (), LIMIT) > LIMIT).tolist() == [channel]
    assert not np.any(joint.distances(state, (), LIMIT) > LIMIT)


def test_there_are_no_protection_levels_of_beacons_told_together(smoothed: Smoothed) -> None:
    assert separate_smoothed(smoothed) is None


@pytest.mark.slow
def test_a_beacon_that_is_silent_is_not_believed() -> None:
    site = room()
    some = replace(site, beacons=site.beacons[:-1])
    quiet = many_beacons.walked(some, 0.15, BOX_WORLD, RATE_HZ, 3)
    _, alone = judge_result(smooth(quiet, some), quiet)
    _, both = judge_result(smooth(quiet, site), quiet)
    assert alone.verdict is Verdict.TRUSTWORTHY
    assert both.verdict is not Verdict.TRUSTWORTHY


@pytest.mark.slow
def test_positions_that_are_believed_are_consistent() -> None:
    site, nees = room(), []
    for seed in range(6):
        walk = many_beacons.walked(site, 0.15, BOX_WORLD, RATE_HZ, 20 + seed)
        result, trust = judge_result(smooth(walk, site), walk)
        if trust.verdict is Verdict.FAILED:  # of three long windows not every start is right
            continue
        error = many_beacons._errors(walk, result.states.time, result.states.position_world)
        body = np.einsum("nji,nj->ni", result.states.world_from_body, error)
        assert result.states.pose_cov is not None
        solved = np.linalg.solve(result.states.pose_cov[:, 3:, 3:], body[..., None])[..., 0]
        nees.append(float(np.mean(np.sum(body * solved, axis=1))))
    assert len(nees) >= 4
    # Three are due; declared model error that the samples do not have takes most of it.
    assert 0.2 < np.mean(nees) < 4.5
    assert np.max(nees) < 9.0


@pytest.mark.slow
def test_half_a_hertz_costs_no_more_than_a_fifth_of_the_error() -> None:
    worlds = [many_beacons.compared_spacing(0.5, seed).values() for seed in (1, 2)]
    for name in ("rms_m", "online_rms_m"):
        wide, close = (
            many_beacons.rms(np.array([getattr(run, name) for run in runs]))
            for runs in zip(*worlds, strict=True)
        )
        assert close < 1.2 * wide, name


@pytest.mark.slow
def test_a_navigator_of_close_tones_goes_on_from_a_checkpoint(log: Log) -> None:
    site, settings = room(), NavigatorSettings(start_duration=5.0)
    imu, wave = log.imu, log.waveform
    assert wave is not None
    half = 7.3

    def fed(navigator: Navigator, begin: float, end: float) -> list[np.ndarray]:
        for start in np.arange(begin, end, 0.1):
            a, b = np.searchsorted(imu.time, [start, start + 0.1])
            navigator.add_imu(imu.time[a:b], imu.gyro_body[a:b], imu.accel_body[a:b])
            a, b = np.searchsorted(wave.time, [start, start + 0.1])
            navigator.add_magnetometer(wave.time[a:b], wave.measured_sensor[a:b])
        return [state.position_world for state in navigator.take()]

    whole = Navigator(site, settings)
    fed(whole, 0.0, half)
    assert whole.state is not None
    again = restored(site, settings, whole.checkpoint())
    end = float(imu.time[-1])
    later, same = fed(whole, half, end), fed(again, half, end)
    assert len(later) == len(same) > 3
    assert np.array(later) == pytest.approx(np.array(same), abs=1e-9)
