"""Initial positions and attitudes for a fix of one epoch, without a prior guess.

Positions come from attitude-independent quantities: the Gram matrix of a beacon's phasors gives its
range exactly, and its direction up to the mirror images of the dipole.  Attitudes come from Wahba's
problem over all phasors at each position.
"""

from itertools import combinations, product

import numpy as np

from magfusion.model.ground import range_of_strength, sphere
from magfusion.model.parameters import Calibration, initial_calibration, predict_channels
from magfusion.model.site import Beacon, Site
from magfusion.units import MU0_OVER_4PI, TINY, Array, BoolArray, ComplexArray

AROUND = 96  # directions of a beacon in conducting ground
AZIMUTHS = 16  # on the cone that an unknown drive phase leaves open
ALTERNATIONS = 4  # between attitude and drive phases


def beacon_directions(beacon: Beacon, phasor: ComplexArray) -> tuple[Array, Array]:
    """Return directions and ranges from a beacon consistent with its phasors at any attitude.

    `phasor` (n, tones, 3) (T), in any axes. Returns `direction_beacon` (n, candidates, 3): unit
    vectors; `distance` (n, candidates) (m).
    """
    if beacon.conductivity:
        return _directions_in_ground(beacon, phasor)
    if beacon.synchronised or len(beacon.tones) == 1:
        return _directions(beacon, phasor)
    result = [_directions(beacon, one) for one in _polarities(beacon, phasor)]
    return np.concatenate([f[0] for f in result], 1), np.concatenate([f[1] for f in result], 1)


def _polarities(beacon: Beacon, phasor: ComplexArray) -> list[ComplexArray]:
    """Return phasors with each tone's phase removed, for every polarity against the first tone.

    If a single coil drives a tone, its phasor is a real vector times a phase factor.
    """
    declared = np.angle(np.sum(beacon.excitation, axis=0))
    lag = 0.5 * np.angle(np.sum(phasor**2, axis=-1)) - declared
    reverted = phasor * np.exp(-1j * lag)[..., None]
    signs = product((1.0, -1.0), repeat=len(beacon.tones) - 1)
    return [reverted * np.array([1.0, *others])[:, None] for others in signs]


def _directions(beacon: Beacon, phasor: ComplexArray) -> tuple[Array, Array]:
    drive = beacon.moments_beacon.T @ beacon.excitation  # (3, tones)
    moments = np.concatenate([drive.real, drive.imag], axis=1)
    measured = np.concatenate([phasor.real, phasor.imag], axis=1)  # (n, 2 tones, 3)
    residual, size, right = np.linalg.svd(moments, full_matrices=True)
    rank = int(np.sum(size > 1e-3 * size[0]))
    if rank == 1:
        direction = np.broadcast_to(sphere(48), (len(phasor), 48, 3))
    else:
        # Columns: field of a unit moment along each of the principal drive axes.
        unit = np.swapaxes(measured, 1, 2) @ right[:rank].T / size[:rank]
        gram = np.swapaxes(unit, 1, 2) @ unit
        power, axes = np.linalg.eigh(gram)
        if rank == 3:
            along = axes[:, :, -1] @ residual.T
            direction = np.stack([along, -along], axis=1)
        else:
            direction = _planar_directions(beacon, power, axes, residual)
    seen = 3.0 * direction[..., None] * (direction @ moments)[..., None, :] - moments
    strength = np.sqrt(np.sum(seen**2, axis=(-1, -2)))
    total = np.sqrt(np.sum(measured**2, axis=(1, 2)))[:, None] + TINY
    return direction, np.asarray(np.cbrt(MU0_OVER_4PI * strength / total))


def _directions_in_ground(beacon: Beacon, phasor: ComplexArray) -> tuple[Array, Array]:
    """Return directions all around, each with the range that matches the phasors' amplitude.

    With a phase lag there is no Gram matrix of real fields; but along any direction the field
    decreases with range.
    """
    direction = sphere(AROUND)
    distance = range_of_strength(beacon, phasor, direction)
    return np.broadcast_to(direction, (*distance.shape, 3)), distance


def _planar_directions(beacon: Beacon, power: Array, axes: Array, residual: Array) -> Array:
    """Return the directions consistent with a two-axis beacon's Gram matrix.

    Its eigenvalues are ``(K/r^3)^2 {1, 1 + 3 s^2}``, s the sine of the angle from the normal.
    """
    least = np.maximum(power[:, 0], np.maximum(0.25 * power[:, 1], TINY))
    sine_square = np.clip((power[:, 1] / least - 1.0) / 3.0, 0.0, 1.0)
    sine, cosine = np.sqrt(sine_square)[:, None, None], np.sqrt(1.0 - sine_square)[:, None, None]
    if beacon.synchronised or len(beacon.tones) > 1:
        within = np.stack([axes[:, :, 1], -axes[:, :, 1]], axis=1)
    else:
        azimuth = 2.0 * np.pi * np.arange(AZIMUTHS) / AZIMUTHS
        circle = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1)
        within = np.broadcast_to(circle, (len(power), AZIMUTHS, 2))
    flat = sine * (within @ residual[:, :2].T)
    up = cosine * residual[:, 2]
    return np.concatenate([flat + up, flat - up], axis=1)


def positions(calibration: Calibration, phasor: ComplexArray, weight: Array, keep: int) -> Array:
    """Return the sensor positions that agree best in attitude-independent quantities.

    `phasor` (n, channels, 3) (T), calibrated axes; zero where missing. `weight` (n, channels):
    inverse variance of a component (1/T^2); zero where missing. `keep`: candidates returned for
    each epoch. Returns (n, keep, 3): of the sensor, world (m).
    """
    site = calibration.site
    result, start = [], 0
    for beacon in site.beacons:
        rows = slice(start, start + len(beacon.tones))
        direction, distance = beacon_directions(beacon, phasor[:, rows])
        spot = (
            beacon.position_world + (direction * distance[..., None]) @ beacon.world_from_beacon.T
        )
        missing = ~np.all(weight[:, rows] > 0, axis=1)
        spot[missing] = np.nan
        result.append(spot)
        start = rows.stop
    candidates = np.concatenate(result, axis=1)
    usable = np.asarray(np.isfinite(candidates).all(axis=2))
    spots = np.where(usable[..., None], candidates, 1e3)
    score = np.where(usable, _invariant_cost(calibration, spots, phasor, weight), np.inf)
    order = np.argsort(score, axis=1)[:, :keep]
    return np.take_along_axis(spots, order[..., None], axis=1)


def _invariants(phasor: ComplexArray) -> Array:
    """Return half the sum and half the difference of a phasor ellipse's squared axes."""
    power = np.sum(np.abs(phasor) ** 2, axis=-1)
    return np.stack([power, np.abs(np.sum(phasor**2, axis=-1))], axis=-1) / 2.0


def _invariant_cost(
    calibration: Calibration, sensor_world: Array, phasor: ComplexArray, weight: Array
) -> Array:
    predicted = _predicted_at(calibration, sensor_world)
    ours, others = _invariants(predicted), _invariants(phasor)[:, None]
    # Relative to amplitude the error of a squared axis is twice that of the phasor.
    variance = 1.0 / np.maximum(weight, TINY)[:, None] * 4.0 * (others[..., 0] + TINY)
    floor = 0.05**2 * others[..., 0] ** 2  # candidates are coarse
    relative = np.sum((ours - others) ** 2, axis=-1) / (floor + variance)
    return np.sum(np.where(weight[:, None] > 0, np.log1p(relative), 0.0), axis=-1)


def _predicted_at(calibration: Calibration, sensor_world: Array) -> ComplexArray:
    """Return phasors in world axes at sensor positions (n, c, 3), drive phase zero."""
    site = calibration.site
    sensor = site.platform.magnetometer
    # A body whose sensor axes are the world's; the matrix is inverted.
    world_from_body = np.broadcast_to(sensor.body_from_sensor.T, (*sensor_world.shape, 3))
    body = sensor_world - sensor.body_from_sensor.T @ sensor.position_body
    still = initial_calibration(site, 0.0)
    time = np.zeros(sensor_world.shape[:-1])
    measured = predict_channels(still, time, world_from_body, body)
    return measured @ np.linalg.inv(sensor.matrix).T


def wahba(correlation: Array) -> Array:
    """Return the rotations that maximise ``trace(R^T correlation)``, shape (..., 3, 3)."""
    residual, _, right = np.linalg.svd(correlation)
    sign = np.ones(correlation.shape[:-1])
    sign[..., 2] = np.linalg.det(residual) * np.linalg.det(right)
    return (residual * sign[..., None, :]) @ right


def attitudes(
    calibration: Calibration,
    sensor_world: Array,
    phasor: ComplexArray,
    weight: Array,
    free_parameters: BoolArray,
    up_sensor: Array | None,
    up_weight: Array | None,
) -> tuple[Array, Array]:
    """Solve Wahba's problem at each candidate position.

    `sensor_world` (n, c, 3) (m). `phasor` (n, channels, 3) (T), calibrated axes.
    `weight` (n, channels) (1/T^2). `free_parameters` (channels,): channels whose drive phase is
    unknown. `up_sensor`, `up_weight` (n, 3) and (n,): direction of the specific force at rest, and
    its weight (1/rad^2). Returns `world_from_sensor` (n, c, 3, 3); `phase` (n, c, channels) (rad);
    zero where it is known.
    """
    world = _predicted_at(calibration, sensor_world)
    measured, share = phasor[:, None], weight[:, None]
    base = np.zeros((*sensor_world.shape[:2], 3, 3))
    if up_sensor is not None and up_weight is not None:
        base[..., 2, :] += (up_weight[:, None] * up_sensor)[:, None]
    base = base + _correlation(world, measured, np.where(free_parameters, 0.0, share))
    phase = np.zeros((*sensor_world.shape[:2], len(free_parameters)))
    if not np.any(free_parameters):
        return wahba(base), phase
    power = np.where(free_parameters, share * np.sum(np.abs(measured) ** 2, axis=-1), 0.0)
    # The ellipse's normal does not depend on the drive phase; a flat ellipse has none.
    normals = [_normal(b) for b in (world, np.broadcast_to(measured, world.shape))]
    spread = np.broadcast_to(power, world.shape[:-1])
    aligned = base + np.einsum("nclx,ncly,ncl->ncxy", *normals, spread)
    aligned = aligned + _between_tones(calibration.site, world, measured, power)
    for _ in range(ALTERNATIONS):
        rotation = wahba(aligned)
        seen = world @ rotation
        lag = np.angle(np.sum(np.conj(seen) * measured, axis=-1))
        phase = np.where(free_parameters, lag, 0.0)
        rotated = world * np.exp(1j * phase)[..., None]
        aligned = base + _correlation(rotated, measured, np.where(free_parameters, share, 0.0))
    return wahba(aligned), phase


def _normal(phasor: ComplexArray) -> Array:
    """Return the normal of each phasor's ellipse, of length one for a circle, zero for a line."""
    power = 0.5 * np.sum(np.abs(phasor) ** 2, axis=-1, keepdims=True)
    return np.cross(phasor.real, phasor.imag) / (power + TINY)


def _between_tones(site: Site, world: ComplexArray, measured: ComplexArray, power: Array) -> Array:
    """Correlate the planes of single-coil tones, which do not depend on the phases either."""
    one_coil = np.concatenate([np.count_nonzero(b.excitation, axis=0) == 1 for b in site.beacons])
    out = np.zeros((*world.shape[:2], 3, 3))
    for pair in combinations(np.flatnonzero(one_coil & np.any(power > 0, axis=(0, 1))), 2):
        ours, others = (_plane(_long_axis(p[..., list(pair), :])) for p in (world, measured))
        weight = np.sqrt(np.prod(power[..., list(pair)], axis=-1))
        out += weight[..., None, None] * ours[..., :, None] * others[..., None, :]
    return out


def _long_axis(phasor: ComplexArray) -> Array:
    """Return the direction of the long axis of a phasor's ellipse, of either sign."""
    turn = np.exp(-0.5j * np.angle(np.sum(phasor**2, axis=-1, keepdims=True)))
    axis = np.real(phasor * turn)
    return axis / (np.linalg.norm(axis, axis=-1, keepdims=True) + TINY)


def _plane(axes: Array) -> Array:
    """Return the normal of two axes (..., 2, 3), independent of their signs; short if uncertain."""
    a, b = axes[..., 0, :], axes[..., 1, :]
    return np.cross(a, b) * np.sum(a * b, axis=-1, keepdims=True)


def _correlation(world: ComplexArray, measured: ComplexArray, weight: Array) -> Array:
    share = np.broadcast_to(weight, world.shape[:-1])
    paired = np.broadcast_to(measured, world.shape)
    return np.einsum("nclx,ncly,ncl->ncxy", world, np.conj(paired), share).real
