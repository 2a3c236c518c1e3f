"""Calibration parameters: which are estimated, their priors, and how they move a site.

A site's calibration lives in one tangent vector, the same for the fix, the smoother and the
filter: a beacon's rotation in beacon axes and its position in world axes, log-moments, drive phase
and drift, magnetometer matrix, the sensor's rotation in sensor axes and its position in body axes,
and the IMU's time offset; where the Earth field is measured, it and the magnetometer's offset too.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from magfusion.observation import Observation, observe, observe_from, predict
from magfusion.site import Beacon, Site
from magfusion.site_moves import (
    MICROTESLA,
    beacon_difference,
    earth_difference,
    magnetometer_difference,
    moved_beacon,
    moved_earth,
    moved_magnetometer,
)
from magfusion.units import Array, ComplexArray

GROUPS = ("beacons", "moments", "phase", "magnetometer", "extrinsics", "time-offset", "earth")

PHASE_SIGMA = 1e2  # rad; wide enough to be no information
DRIFT_SIGMA = 2e-5  # relative; ordinary crystal oscillators
# What a building's iron makes of the declared Earth field, outside of steel halls and machines.
DECLINATION_SIGMA = np.deg2rad(3.0)
STRENGTH_SIGMA = 0.02  # of its size, horizontal and vertical part alike
_BY_PHASOR = ("phase", "drift", "gain")  # kinds whose Jacobian is the phasor but for a factor

# A survey this good is held at its declared values; what it may still be wrong by is considered in
# the covariance of the result.
NEGLIGIBLE = {
    "position": 2e-3,  # m
    "rotation": 1.75e-3,  # rad
    "log_moment": 2e-3,
    "matrix": 1e-3,
    "offset": 5e-3,  # uT
    "time_offset": 1e-4,  # s
    "phase": 0.0,
    "drift": 0.0,
    "declination": 0.0,
    "strength": 0.0,
}


class Block(NamedTuple):
    """One named part of the tangent vector, e.g. the position of beacon A."""

    group: str
    owner: str
    kind: str
    columns: slice
    sigma: Array

    @property
    def name(self) -> str:
        """E.g. ``A.position`` or ``magnetometer.matrix``."""
        return f"{self.owner}.{self.kind}"


@dataclass(frozen=True, eq=False)
class Calibration:
    """Current values of everything that can be estimated besides the trajectory.

    Parameters
    ----------
    site : Site
    phase : ndarray, shape (channels,)
        Drive phase of each channel at ``reference_time`` beyond the coils' own (rad).
    drift : ndarray, shape (beacons,)
        Relative error of each beacon's clock.
    time_offset : float
        The IMU's sample stamped t was taken at t + time_offset (s).
    reference_time : float
        Where ``phase`` holds (s).
    log_gain : ndarray, shape (channels,)
        Logarithm of what each channel's phasor is larger by than the site says.

    ``phase`` and ``log_gain`` may have one row for each pose.
    """

    site: Site
    phase: Array
    drift: Array
    time_offset: float
    reference_time: float
    log_gain: Array

    def drive_phase(self, time: Array) -> Array:
        """Return the phase of every channel at the given times, shape (..., channels) (rad)."""
        owner = [i for i, b in enumerate(self.site.beacons) for _ in b.tones]
        frequencies = np.concatenate([b.tone_frequencies_hz for b in self.site.beacons])
        rate = 2.0 * np.pi * frequencies * self.drift[owner]
        return np.asarray(self.phase + (time[..., None] - self.reference_time) * rate)


def initial_calibration(site: Site, reference_time: float) -> Calibration:
    """Return the calibration that the site declares."""
    return Calibration(
        site=site,
        phase=np.zeros(len(site.channels)),
        drift=np.zeros(len(site.beacons)),
        time_offset=site.platform.imu.time_offset,
        reference_time=reference_time,
        log_gain=np.zeros(len(site.channels)),
    )


def _candidates(site: Site, earth: bool) -> Iterable[tuple[str, str, str, Array]]:
    for beacon in site.beacons:
        yield "beacons", beacon.name, "rotation", beacon.sigma.rotation_beacon
        yield "beacons", beacon.name, "position", beacon.sigma.position_world
        yield "moments", beacon.name, "log_moment", beacon.sigma.log_moment
        if not beacon.synchronised:
            yield "phase", beacon.name, "phase", np.full(len(beacon.tones), PHASE_SIGMA)
            yield "phase", beacon.name, "drift", np.array([DRIFT_SIGMA])
    sigma = site.platform.magnetometer.sigma
    yield "magnetometer", "magnetometer", "matrix", sigma.matrix.ravel()
    if earth:
        yield "magnetometer", "magnetometer", "offset", sigma.offset / MICROTESLA
    yield "extrinsics", "sensor", "rotation", sigma.rotation_sensor
    yield "extrinsics", "sensor", "position", sigma.position_body
    yield "time-offset", "imu", "time_offset", np.array([site.platform.imu.time_offset_sigma])
    if earth and site.earth_field_world is not None:
        size = float(np.linalg.norm(site.earth_field_world)) / MICROTESLA
        yield "earth", "earth", "declination", np.array([DECLINATION_SIGMA])
        yield "earth", "earth", "strength", np.full(2, STRENGTH_SIGMA * size)


def choose_blocks(
    site: Site, groups: Iterable[str] | None = None, *, earth: bool = False
) -> tuple[Block, ...]:
    """Choose the calibration parameters to estimate.

    Parameters
    ----------
    site : Site
        Its sigmas are the priors; a parameter whose sigma is zero is known and never chosen.
    groups : iterable of str, optional
        Any of `GROUPS`.  None takes every parameter whose sigma is not negligible.
    earth : bool
        Whether the Earth field is measured: it and the magnetometer's offset may then be chosen.

    Returns
    -------
    tuple of Block
        In the order of the tangent vector.
    """
    wanted = None if groups is None else set(groups)
    if wanted is not None and not wanted <= set(GROUPS):
        raise ValueError(f"groups must be among {GROUPS}; got {sorted(wanted - set(GROUPS))}")

    def chosen(group: str, kind: str, sigma: float) -> bool:
        return sigma > NEGLIGIBLE[kind] if wanted is None else group in wanted

    return _blocks(site, chosen, earth)


def held_blocks(
    site: Site, estimated: tuple[Block, ...], *, earth: bool = False
) -> tuple[Block, ...]:
    """Return the parameters that are uncertain but not among those estimated."""
    # Not by name alone: a beacon may be called sensor.
    known = {block[:3] for block in estimated}
    every = _blocks(site, lambda _group, _kind, _sigma: True, earth)
    free = [block for block in every if block[:3] not in known]
    start, out = 0, []
    for block in free:
        out.append(block._replace(columns=slice(start, start + len(block.sigma))))
        start += len(block.sigma)
    return tuple(out)


def _blocks(
    site: Site, chosen: Callable[[str, str, float], bool], earth: bool
) -> tuple[Block, ...]:
    blocks: list[Block] = []
    start = 0
    for group, owner, kind, sigma in _candidates(site, earth):
        largest = float(np.max(sigma))
        if largest > 0.0 and chosen(group, kind, largest):
            columns = slice(start, start + len(sigma))
            # One known axis in an unknown block.
            blocks.append(Block(group, owner, kind, columns, np.maximum(sigma, 1e-6 * largest)))
            start += len(sigma)
    return tuple(blocks)


def dimension(blocks: tuple[Block, ...]) -> int:
    """Return the length of the tangent vector."""
    return blocks[-1].columns.stop if blocks else 0


def prior_sigma(blocks: tuple[Block, ...]) -> Array:
    """Return the prior standard deviations, shape (dimension,)."""
    return np.concatenate([b.sigma for b in blocks]) if blocks else np.zeros(0)


def retract(calibration: Calibration, blocks: tuple[Block, ...], step: Array) -> Calibration:
    """Return the calibration moved by a tangent vector, shape (dimension,)."""
    site, phase, drift = calibration.site, calibration.phase.copy(), calibration.drift.copy()
    time_offset, log_gain = calibration.time_offset, calibration.log_gain.copy()
    names = [b.name for b in site.beacons]
    for block in blocks:
        part = np.array(step[block.columns])  # GTSAM's vectors are read-only
        if not np.any(part):
            continue
        if block.kind == "time_offset":
            time_offset += float(part[0])
        elif block.group in ("magnetometer", "extrinsics"):
            site = moved_magnetometer(site, block.kind, part)
        elif block.group == "earth":
            site = moved_earth(site, block.kind, part)
        elif block.kind == "phase":
            phase[[owner == block.owner for owner, _ in site.channels]] += part
        elif block.kind == "gain":
            log_gain[[owner == block.owner for owner, _ in site.channels]] += part
        elif block.kind == "drift":
            drift[names.index(block.owner)] += float(part[0])
        else:
            index = names.index(block.owner)
            moved = moved_beacon(site.beacons[index], block.kind, part)
            site = replace(site, beacons=(*site.beacons[:index], moved, *site.beacons[index + 1 :]))
    return replace(
        calibration,
        site=site,
        phase=phase,
        drift=drift,
        time_offset=time_offset,
        log_gain=log_gain,
    )


def difference(reference: Calibration, moved: Calibration, blocks: tuple[Block, ...]) -> Array:
    """Return the tangent vector that takes ``reference`` to ``moved``: the inverse of `retract`."""
    step = np.zeros(dimension(blocks))
    for block in blocks:
        if block.kind == "time_offset":
            value: Array = np.array([moved.time_offset - reference.time_offset])
        elif block.group in ("magnetometer", "extrinsics"):
            value = magnetometer_difference(reference.site, moved.site, block.kind)
        elif block.group == "earth":
            value = earth_difference(reference.site, moved.site, block.kind)
        else:
            value = _beacon_difference(reference, moved, block)
        step[block.columns] = value
    return step


def _beacon_difference(old: Calibration, new: Calibration, block: Block) -> Array:
    index = [b.name for b in old.site.beacons].index(block.owner)
    if block.kind == "drift":
        return np.asarray(new.drift[[index]] - old.drift[[index]])
    mine = [owner == block.owner for owner, _ in old.site.channels]
    if block.kind == "phase":
        return np.asarray(new.phase[mine] - old.phase[mine])
    if block.kind == "gain":
        return np.asarray((new.log_gain - old.log_gain)[mine][:1])
    return beacon_difference(old.site.beacons[index], new.site.beacons[index], block.kind)


def predict_channels(
    calibration: Calibration, time: Array, world_from_body: Array, position_world: Array
) -> ComplexArray:
    """Return the phasors of every channel, shape (..., channels, 3), measured axes (T)."""
    phase = calibration.drive_phase(time)
    site = calibration.site
    parts, start = [], 0
    for beacon in site.beacons:
        tones = slice(start, start + len(beacon.tones))
        parts.append(
            predict(
                beacon,
                site.platform.magnetometer,
                world_from_body,
                position_world,
                phase[..., tones],
            )
        )
        start = tones.stop
    gain = np.exp(calibration.log_gain)[..., None]
    return np.asarray(gain * np.concatenate(parts, axis=-2))


def linearize_channels(
    calibration: Calibration,
    blocks: tuple[Block, ...],
    time: Array,
    world_from_body: Array,
    position_world: Array,
    twist_body: Array | None = None,
) -> tuple[Array, Array, Array]:
    """Predict every channel as real numbers, with the Jacobian by pose and calibration.

    Parameters
    ----------
    calibration : Calibration
    blocks : tuple of Block
        Columns of the calibration's tangent vector.
    time : ndarray, shape (n,)
    world_from_body : ndarray, shape (n, 3, 3)
    position_world : ndarray, shape (n, 3)
    twist_body : ndarray, shape (n, 6), optional
        Needed where the time offset is among the blocks.

    Returns
    -------
    value : ndarray, shape (n, channels, 6)
        Real parts, then imaginary parts (T).
    by_pose : ndarray, shape (n, channels, 6, 6)
    by_calibration : ndarray, shape (n, channels, 6, dimension)
    """
    phase = calibration.drive_phase(time)
    site, n = calibration.site, len(time)
    channels = len(site.channels)
    value = np.empty((n, channels, 6))
    by_pose = np.empty((n, channels, 6, 6))
    by_calibration = np.zeros((n, channels, 6, dimension(blocks)))
    whole = any(block.kind not in _BY_PHASOR for block in blocks)
    elapsed = time - calibration.reference_time
    start = 0
    for beacon in site.beacons:
        rows = slice(start, start + len(beacon.tones))
        view = (beacon, site.platform.magnetometer, world_from_body, position_world)
        seen = observe(*view, phase[..., rows], twist_body) if whole else None
        phasor, pose = (
            observe_from(*view, phase[..., rows])
            if seen is None
            else (seen.phasor_sensor, seen.platform_pose)
        )
        value[:, rows] = _stacked(phasor[..., None])[..., 0]
        by_pose[:, rows] = _stacked(pose)
        for block in blocks:
            part = (
                _block_jacobian(beacon, site, block, seen)
                if block.kind not in _BY_PHASOR and seen is not None
                else _by_phasor(beacon, block, phasor, elapsed)
            )
            if part is not None:
                by_calibration[:, rows, :, block.columns] = _stacked(part)
        start = rows.stop
    if not np.any(calibration.log_gain):
        return value, by_pose, by_calibration
    gain = np.exp(calibration.log_gain)[..., None]
    return gain * value, gain[..., None] * by_pose, gain[..., None] * by_calibration


def _stacked(block: ComplexArray) -> Array:
    return np.concatenate([block.real, block.imag], axis=-2)


def _block_jacobian(
    beacon: Beacon, site: Site, block: Block, seen: Observation
) -> ComplexArray | None:
    """Return the columns of a block, shape (n, tones, 3, columns); None where it has no bearing."""
    if block.group in ("beacons", "moments"):
        return None if block.owner != beacon.name else _own(beacon, block, seen)
    if block.group == "earth" or block.kind == "offset":
        return None  # no part of a phasor
    if block.kind == "matrix":
        return seen.matrix
    if block.kind == "time_offset":
        if seen.time_offset is None:
            raise ValueError("twist_body must be given where the time offset is estimated")
        return seen.time_offset[..., None]
    if block.kind == "rotation":
        return seen.body_from_sensor[..., :3]
    mounting = site.platform.magnetometer.body_from_sensor
    return np.asarray(seen.body_from_sensor[..., 3:] @ mounting.T)


def _own(beacon: Beacon, block: Block, seen: Observation) -> ComplexArray:
    if block.kind == "rotation":
        return seen.beacon_pose[..., :3]
    if block.kind == "position":
        return np.asarray(seen.beacon_pose[..., 3:] @ beacon.world_from_beacon.T)
    return seen.log_moments


def _by_phasor(
    beacon: Beacon, block: Block, phasor: ComplexArray, elapsed: Array
) -> ComplexArray | None:
    if block.owner != beacon.name:
        return None
    if block.kind == "gain":
        return phasor[..., None]
    if block.kind == "phase":
        return np.asarray(1j * phasor[..., None] * np.eye(len(beacon.tones))[:, None, :])
    rate = 2.0 * np.pi * beacon.tone_frequencies_hz[:, None] * elapsed[:, None, None]
    return np.asarray((1j * phasor * rate)[..., None])
