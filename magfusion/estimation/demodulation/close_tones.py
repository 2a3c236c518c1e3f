"""Joint measurement of close tones from the residuals of a sample prediction."""

from dataclasses import replace

import numpy as np

from magfusion.estimation.demodulation.active_beacons import ActiveBeacons
from magfusion.estimation.measurements.joint_phasors import JointPhasors, in_directions
from magfusion.model.detection_range import largest_fields, tones_of
from magfusion.model.noise import cholesky, measurement_cov, sensor_positions
from magfusion.model.parameters import Calibration, linearize_channels
from magfusion.model.quaternion import inverse, matrices, rotate
from magfusion.model.samples import FieldSamples, ImuSamples
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.receiver.admission import Windows
from magfusion.receiver.joint import NODES, JointDesigns
from magfusion.receiver.noise import not_below, smoothed_over_windows
from magfusion.receiver.turn import body_turn_of, measured_from_body
from magfusion.receiver.windows import MAX_WINDOW
from magfusion.units import Array, BoolArray, IntArray

AT_ONCE = 128  # windows whose covariances fit the cache


def joint_phasors(
    designs: JointDesigns,
    windows: Windows,
    time: Array,
    left_sensor: Array,
    states: Trajectory,
    nodes: Trajectory,
    calibration: Calibration,
    imu: ImuSamples,
    epoch: IntArray,
    rate_body: Array,
    applied_offset: Array,
    *,
    shared_by: Array | float = 1.0,
    standing: BoolArray | None = None,
    noise: Array | None = None,
) -> tuple[JointPhasors, Array]:
    """Return the joint phasors of all tones in short windows, weighted at approximate poses.

    Parameters
    ----------
    time : ndarray, shape (samples,)
        (s)
    left_sensor : ndarray, shape (samples, 3)
        Samples minus their prediction (T), measured axes.
    states : Trajectory
        Predicted, at the centres of the windows.
    nodes : Trajectory
        Predicted, at the nodes of the windows.
    imu : ImuSamples
        As from `magfusion.receiver.turn.on_clock`, without the gyro's bias.
    epoch : int ndarray, shape (n,)
        State index of each window.
    rate_body : ndarray, shape (n, 3)
        Angular rate without its bias (rad/s).
    applied_offset : ndarray, shape (n,)
        IMU time offset with which the inertial data were cut (s).
    shared_by, standing
        As of `magfusion.estimation.measurements.phasors.field_phasors`.
    noise : ndarray, shape (k, 3, 3), optional
        Sample noise of the windows before, for the average.

    Returns
    -------
    JointPhasors
    ndarray, shape (n, 3, 3)
        Sample noise estimated from each window alone (T^2).
    """
    assert states.velocity_world is not None
    site, n = calibration.site, len(windows)
    seen, tones, shown = _seen(designs, windows, time, left_sensor, imu, site)
    smooth = _averaged(shown, noise, windows, designs)
    nyquist_hz = 0.5 / float(np.median(np.diff(time)))
    declared = site.platform.magnetometer.noise_density * float(np.sqrt(nyquist_hz))
    smooth = not_below(smooth, declared)

    affected = _predicted_channels(calibration, states)
    basis = _of_channels(tones, windows.centre, site, affected)
    elapsed, shift = _at_nodes(nodes, states, site)
    value, strength = _foreseen(calibration, states, elapsed, shift, affected)
    centre = in_directions(basis, value[..., None])[..., 0]
    result = JointPhasors(
        epoch=epoch,
        time=states.time,
        measured=seen.reshape(n, -1) + centre,
        basis=basis,
        whitening=np.zeros((n, 0, 0)),
        elapsed=elapsed,
        shift_body=shift,
        strength=strength,
        rate_body=rate_body,
        applied_offset=applied_offset,
        moving=np.ones(n, dtype=bool) if standing is None else ~standing,
        is_predicted=affected,
    )
    at_centre = value.reshape(n, elapsed.shape[1], *affected.shape[1:], 6)[:, len(NODES) // 2]
    whitening = _whitening(site, states, at_centre, result, smooth, shared_by)
    return replace(result, whitening=whitening), shown


def _averaged(shown: Array, noise: Array | None, windows: Windows, designs: JointDesigns) -> Array:
    """Return the noise of windows, averaged with that of others as in `joint_phasors`."""
    if noise is not None:
        return np.asarray(np.mean(np.concatenate([noise, shown]), axis=0, keepdims=True))
    settings = designs.settings
    smooth = smoothed_over_windows(
        shown[:, None], windows.centre, settings.step, settings.noise_windows, None
    )
    return smooth[:, 0]


def _at_nodes(nodes: Trajectory, states: Trajectory, site: Site) -> tuple[Array, Array]:
    """Return the times of the nodes, and the sensor's displacement from a steady velocity there."""
    n = len(states)
    assert states.velocity_world is not None
    elapsed = nodes.time.reshape(n, -1) - states.time[:, None]
    steady = elapsed[..., None] * states.velocity_world[:, None]
    moved_world = nodes.position_world.reshape(n, -1, 3) - states.position_world[:, None] - steady
    body_from_world = np.swapaxes(states.world_from_body, 1, 2)[:, None]
    turn = body_from_world @ nodes.world_from_body.reshape(n, -1, 3, 3)
    swung = (turn - np.eye(3)) @ site.platform.magnetometer.position_body
    return elapsed, (body_from_world @ moved_world[..., None])[..., 0] + swung


def _foreseen(
    calibration: Calibration,
    states: Trajectory,
    elapsed: Array,
    shift_body: Array,
    predicted: BoolArray,
) -> tuple[Array, Array]:
    """Return the phasors at the nodes (n nodes, channels, 6), and their relative strength.

    The latter is relative to the centre, shape (n, nodes, channels).
    """
    assert states.velocity_world is not None
    n, count = elapsed.shape
    every = np.repeat(np.arange(n), count)
    turn = states.world_from_body[every]
    place = states.position_world[every] + (turn @ shift_body.reshape(-1, 3, 1))[..., 0]
    place += elapsed.reshape(-1, 1) * states.velocity_world[every]
    value, _, _ = linearize_channels(
        calibration, (), states.time[every], turn, place, detected=predicted[every]
    )
    size = np.linalg.norm(value, axis=2).reshape(n, count, -1)
    middle = size[:, count // 2][:, None]
    share = np.divide(size, middle, out=np.ones_like(size), where=middle > 0.0)
    return value, share


def _seen(
    designs: JointDesigns,
    windows: Windows,
    time: Array,
    left_sensor: Array,
    imu: ImuSamples,
    site: Site,
) -> tuple[Array, Array, Array]:
    """Return the directions of windows, the tones present, and the noise besides."""
    turn, from_body = body_turn_of(imu), measured_from_body(site)
    back = from_body @ matrices(inverse(turn(windows.centre)))
    in_body = np.linalg.inv(from_body)
    still = rotate(turn(time), in_body @ left_sensor.T).T
    seen, tones, noise = [], [], []
    for k, (first, count) in enumerate(zip(windows.first, windows.count, strict=True)):
        rows = slice(int(first), int(first + count))
        design = designs.of(time[rows] - windows.centre[k])
        field = still[rows] @ back[k].T
        seen.append(design.across.T @ field)
        tones.append(design.tones)
        others = design.extra_design.T @ field
        noise.append(others.T @ others / len(others))
    return np.array(seen), np.array(tones), np.array(noise)


def _predicted_channels(calibration: Calibration, states: Trajectory) -> BoolArray:
    """Return which channels are predicted at states, shape (n, channels)."""
    site, active_beacons = calibration.site, ActiveBeacons.of(calibration, MAX_WINDOW)
    if active_beacons.least is None:
        return np.ones((len(states), len(site.channels)), dtype=bool)
    largest = largest_fields(site, sensor_positions(site, states)[:, 0])
    affected = np.asarray(largest > active_beacons.least)
    affected[~np.any(affected, axis=1), 0] = True
    return affected


def _of_channels(by_tone: Array, centre: Array, site: Site, predicted: BoolArray) -> Array:
    """Return directions by cosines and sines in terms of real and imaginary parts of phasors."""
    tones = tones_of(site)
    count = len(tones.frequencies_hz)
    angle = 2.0 * np.pi * tones.frequencies_hz * centre[:, None, None, None]
    cosine, sine = np.cos(angle), np.sin(angle)
    along, across = by_tone[..., :count], by_tone[..., count:]
    real = along * cosine - across * sine
    imaginary = -along * sine - across * cosine
    both = np.stack([real, imaginary], axis=-1)[..., tones.of_channel[: predicted.shape[1]], :]
    both = np.where(predicted[:, None, None, :, None], both, 0.0)
    return np.asarray(np.swapaxes(both.reshape(*both.shape[:3], -1), 1, 2))


def _whitening(
    site: Site,
    states: Trajectory,
    value: Array,
    result: JointPhasors,
    noise: Array,
    shared_by: Array | float,
) -> Array:
    """Return the whitening of directions: noise of the samples, and the error of the model."""
    affected, basis = result.is_predicted, result.basis
    n, directions, nodes, _ = basis.shape
    phasor = value[..., :3] + 1j * value[..., 3:]
    samples = FieldSamples(
        time=states.time,
        window=np.ones(n),
        channels=site.channels,
        phasor_sensor=np.where(affected[..., None], phasor, np.nan),
        phasor_cov=np.zeros((*affected.shape, 3, 3)),
    )
    model = measurement_cov(
        site,
        samples,
        sensor_world=sensor_positions(site, states),
        shared_by=shared_by,
        neighbours=False,
    )
    model = np.where(affected[..., None, None], np.nan_to_num(model), 0.0)
    factor = np.mean([beacon.noise_factor**2 for beacon in site.beacons])
    out = np.empty((n, 3 * directions, 3 * directions))
    for begin in range(0, n, AT_ONCE):
        rows = slice(begin, begin + AT_ONCE)
        each = basis[rows].reshape(-1, directions, nodes, affected.shape[1], 2)
        parts = np.einsum("nrkcp,nkc->ncrp", each, result.strength[rows])
        shape = parts @ np.swapaxes(parts, 2, 3)  # (n, channels, directions, directions)
        size = model[rows].reshape(len(shape), shape.shape[1], 9)
        wide = np.swapaxes(shape.reshape(*shape.shape[:2], -1), 1, 2) @ size
        wide = wide.reshape(-1, directions, directions, 3, 3)
        own = np.arange(directions)
        wide[:, own, own] += factor * noise[rows][:, None]
        cov = np.swapaxes(wide, 2, 3).reshape(-1, 3 * directions, 3 * directions)
        scale = np.sqrt(np.trace(cov, axis1=1, axis2=2) / cov.shape[1])[:, None, None]
        out[rows] = np.linalg.inv(cholesky(cov / scale**2)) / scale
    return out
