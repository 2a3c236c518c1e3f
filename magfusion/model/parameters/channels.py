"""The phasors of every channel of a site, with their Jacobian by pose and calibration.

Beacons of one form are evaluated together: for one epoch that costs as much as one beacon.
"""

from collections.abc import Iterator
from itertools import pairwise, product
from typing import Any, NamedTuple

import numpy as np

from magfusion.model.channel_effects import axis_factors
from magfusion.model.coil_field import Sources, alone, side_by_side
from magfusion.model.field import observe, observe_from, predict
from magfusion.model.once import once_a_site
from magfusion.model.parameters.beacon import BeaconParameter
from magfusion.model.parameters.parameter import Block, Calibration, PhasorView, dimension
from magfusion.model.parameters.subset import channels_of, of_beacons, stretches
from magfusion.model.receive_coils import Observation
from magfusion.model.site import Beacon, Site
from magfusion.units import Array, BoolArray, ComplexArray


class _Group(NamedTuple):
    """Beacons that are evaluated together; results have a leading axis of them."""

    source: Sources
    beacons: tuple[Beacon, ...]
    tones: tuple[slice, ...]  # channels of each

    def of(self, by_channel: Array) -> Array:
        """Select their channels, shape (..., channels), in the form for the evaluation."""
        own = [by_channel[..., tones] for tones in self.tones]
        return np.stack(own) if len(own) > 1 else own[0]

    def each(self, evaluated: Observation) -> Iterator[Observation]:
        """Yield the observation of each beacon."""
        if len(self.beacons) == 1:
            yield evaluated
            return
        for k in range(len(self.beacons)):
            own: dict[str, Any] = {
                n: None if v is None else v[k] for n, v in vars(evaluated).items()
            }
            yield Observation(**own)

    def with_axis(self, evaluated: ComplexArray) -> ComplexArray:
        """Return the result with a leading axis of beacons, also for a single one."""
        return evaluated if len(self.beacons) > 1 else evaluated[None]


@once_a_site
def _side_by_side(site: Site) -> list[_Group]:
    return _groups(site)


@once_a_site
def _each_alone(site: Site) -> list[_Group]:
    return _groups(site, neighbours=False)


def _groups(site: Site, *, neighbours: bool = True) -> list[_Group]:
    """Return the beacons of a site in as few groups as their forms allow, or one per group."""
    end = np.cumsum([len(beacon.tones) for beacon in site.beacons]).tolist()
    tones = [slice(*ends) for ends in pairwise([0, *end])]
    sources = (
        side_by_side(site)
        if neighbours
        else [((k,), alone(beacon)) for k, beacon in enumerate(site.beacons)]
    )
    return [
        _Group(source, tuple(site.beacons[k] for k in rows), tuple(tones[k] for k in rows))
        for rows, source in sources
    ]


def predict_channels(
    calibration: Calibration, time: Array, world_from_body: Array, position_world: Array
) -> ComplexArray:
    """Return the phasors of every channel, shape (..., channels, 3), measured axes (T)."""
    phase, site = calibration.drive_phase(time), calibration.site
    poses = world_from_body, position_world
    shape = np.broadcast_shapes(
        world_from_body.shape[:-2], position_world.shape[:-1], phase.shape[:-1]
    )
    out = np.empty((*shape, len(site.channels), 3), dtype=np.complex128)
    others = world_from_body.ndim == 3 and position_world.ndim == 2
    groups = _side_by_side(site) if others else _each_alone(site)
    for sensor, magnetometer in enumerate(site.platform.magnetometers):
        mine = site.of_sensor(sensor)
        for group in groups:
            phasor = predict(group.source, magnetometer, *poses, group.of(phase[..., mine]))
            for tones, own in zip(group.tones, group.with_axis(phasor), strict=True):
                out[..., mine, :][..., tones, :] = own
    factors = axis_factors(site)
    out = out if factors is None else factors * out
    return np.asarray(calibration.gain_at(time)[..., None] * out)


def linearize_channels(
    calibration: Calibration,
    blocks: tuple[Block, ...],
    time: Array,
    world_from_body: Array,
    position_world: Array,
    twist_body: Array | None = None,
    detected: BoolArray | None = None,
) -> tuple[Array, Array, Array]:
    """Predict every channel as real numbers, with the Jacobian by pose and calibration.

    Parameters
    ----------
    blocks : tuple of Block
        Columns of the calibration's tangent vector.
    time : ndarray, shape (n,)
    world_from_body : ndarray, shape (n, 3, 3)
    position_world : ndarray, shape (n, 3)
    twist_body : ndarray, shape (n, 6), optional
        Needed where the time offset is among the blocks.
    detected : bool ndarray, shape (n, channels), optional
        Requested channels: a beacon without any is zero, if the epochs are close to each other.

    Returns
    -------
    value : ndarray, shape (n, channels, 6)
        Real parts, then imaginary parts (T).
    by_pose : ndarray, shape (n, channels, 6, 6)
    by_calibration : ndarray, shape (n, channels, 6, dimension)
    """
    if detected is not None:
        return _linearize_detected(
            calibration, blocks, time, world_from_body, position_world, twist_body, detected
        )
    phase, site, n = calibration.drive_phase(time), calibration.site, len(time)
    channels = len(site.channels)
    value = np.empty((n, channels, 6))
    by_pose = np.empty((n, channels, 6, 6))
    by_calibration = np.zeros((n, channels, 6, dimension(blocks)))
    whole = any(not block.parameter.factor_of_phasor for block in blocks)
    elapsed = time - calibration.reference_time
    acting = _acting(blocks, site)
    groups, factors = _side_by_side(site), axis_factors(site)
    sensors = enumerate(site.platform.magnetometers)
    for (sensor, magnetometer), group in product(sensors, groups):
        mine = site.of_sensor(sensor)
        place = group.source, magnetometer, world_from_body, position_world
        if whole:
            seen = observe(*place, group.of(phase[..., mine]), twist_body)
            phasor, pose = seen.phasor_sensor, seen.platform_pose
            observations = list[Observation | None](group.each(seen))
        else:
            phasor, pose = observe_from(*place, group.of(phase[..., mine]))
            observations = [None] * len(group.beacons)
        phasor, pose = group.with_axis(phasor), group.with_axis(pose)
        values, poses = _stacked(phasor[..., None])[..., 0], _stacked(pose)
        for k, (beacon, tones) in enumerate(zip(group.beacons, group.tones, strict=True)):
            rows = slice(mine.start + tones.start, mine.start + tones.stop)
            value[:, rows], by_pose[:, rows] = values[k], poses[k]
            view = PhasorView(calibration, beacon, elapsed, phasor[k], observations[k], sensor)
            for block in acting[beacon.name]:
                part = block.parameter.phasor_jacobian(view, block.owner)
                if part is not None:
                    by_calibration[:, rows, :3, block.columns] = part.real
                    by_calibration[:, rows, 3:, block.columns] = part.imag
    if factors is not None:
        parts = value[..., None], by_pose, by_calibration
        value, by_pose, by_calibration = (_answered(part, factors) for part in parts)
        value = value[..., 0]
    gain = calibration.gain_at(time)[..., None]
    if np.all(gain == 1.0):
        return value, by_pose, by_calibration
    return gain * value, gain[..., None] * by_pose, gain[..., None] * by_calibration


def _acting(blocks: tuple[Block, ...], site: Site) -> dict[str, list[Block]]:
    """Return the blocks that affect each beacon's phasors, by its name."""
    result: dict[str, list[Block]] = {beacon.name: [] for beacon in site.beacons}
    for block in blocks:
        if not isinstance(block.parameter, BeaconParameter):
            for own in result.values():
                own.append(block)
        elif block.owner in result:
            result[block.owner].append(block)
    return result


def _answered(stacked: Array, factors: ComplexArray) -> Array:
    """Apply the response of each axis to stacked columns (n, channels, 6, k)."""
    real, imaginary = stacked[..., :3, :], stacked[..., 3:, :]
    a, b = factors.real[:, :, None], factors.imag[:, :, None]
    return np.concatenate([a * real - b * imaginary, b * real + a * imaginary], axis=-2)


def _linearize_detected(
    calibration: Calibration,
    blocks: tuple[Block, ...],
    time: Array,
    world_from_body: Array,
    position_world: Array,
    twist_body: Array | None,
    detected: BoolArray,
) -> tuple[Array, Array, Array]:
    """Predict the channels of the detected beacons, as `linearize_channels`."""
    site, n, channels = calibration.site, len(time), len(calibration.site.channels)
    value, by_pose = np.zeros((n, channels, 6)), np.zeros((n, channels, 6, 6))
    by_calibration = np.zeros((n, channels, 6, dimension(blocks)))
    for rows, beacons in stretches(site, detected):
        if not len(beacons):
            continue
        twist = None if twist_body is None else twist_body[rows]
        place = time[rows], world_from_body[rows], position_world[rows], twist
        if len(beacons) == len(site.beacons):
            result = linearize_channels(calibration, blocks, *place)
            value[rows], by_pose[rows], by_calibration[rows] = result
            continue
        some = of_beacons(calibration, beacons)
        own, columns = _own_blocks(blocks, some.site)
        result = linearize_channels(some, own, *place)
        into = channels_of(site, beacons)
        value[rows, into], by_pose[rows, into] = result[:2]
        spread = np.zeros((*result[2].shape[:-1], by_calibration.shape[-1]))
        spread[..., columns] = result[2]
        by_calibration[rows, into] = spread
    return value, by_pose, by_calibration


def _own_blocks(blocks: tuple[Block, ...], site: Site) -> tuple[tuple[Block, ...], list[int]]:
    """Return the blocks that affect the beacons of a site, and their columns."""
    names = {beacon.name for beacon in site.beacons}
    own: list[Block] = []
    columns: list[int] = []
    for block in blocks:
        if not isinstance(block.parameter, BeaconParameter) or block.owner in names:
            start, width = len(columns), len(block.sigma)
            own.append(block._replace(columns=slice(start, start + width)))
            columns += range(block.columns.start, block.columns.stop)
    return tuple(own), columns


def _stacked(block: ComplexArray) -> Array:
    return np.concatenate([block.real, block.imag], axis=-2)
