"""Sites in which a mistake is undone."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.estimation.integrity.change_detection import SinceBias
from magfusion.estimation.integrity.fault_candidates import (
    SAMPLE_RATE,
    STRETCH,
    TILT,
    TYPICAL_TILT,
    FaultCandidate,
)
from magfusion.estimation.integrity.released_fault import ReleasedFault
from magfusion.model.field import skew
from magfusion.model.imu_intrinsics import ImuIntrinsics
from magfusion.model.parameters import (
    PHASE,
    Block,
    Calibration,
    Parameter,
    candidates,
    initial_calibration,
    placed,
)
from magfusion.model.parameters.beacon import BeaconParameter
from magfusion.model.parameters.inertial import (
    ACCEL_BIAS,
    ACCEL_SCALE,
    GRAVITY,
    GYRO_ALIGNMENT,
    GYRO_BIAS,
    GYRO_G_SENSITIVITY,
    GYRO_SCALE,
)
from magfusion.model.site import Beacon, Site
from magfusion.units import Array

PER_CENT = 0.01
EYE, NOTHING = np.eye(3), np.zeros((3, 3))
STEP_DURATION = 1.0  # s, in which a bias of one step is within the sigma of its random walk
NO_GRAVITY = 1e-3  # m/s^2, that a site declares where gravity was removed from the data


def with_intrinsics(
    site: Site, gyro: Array = EYE, accel: Array = EYE, g_sensitivity: Array = NOTHING
) -> Site:
    """Return a site whose IMU has further errors: matrices, and g-sensitivity of the gyro."""
    known = site.platform.imu_intrinsics or ImuIntrinsics()
    further = ImuIntrinsics(
        known.gyro_matrix @ gyro,
        known.accel_matrix @ accel,
        known.gyro_g_sensitivity + known.gyro_matrix @ g_sensitivity,
    )
    return replace(site, platform=replace(site.platform, imu_intrinsics=further))


def with_magnetometer(site: Site, **changed: Any) -> Site:
    """Return a site with other attributes of its first magnetometer."""
    magnetometer = replace(site.platform.magnetometer, **changed)
    return replace(site, platform=replace(site.platform, magnetometer=magnetometer))


def with_imu(site: Site, **changed: float) -> Site:
    """Return a site with other attributes of its IMU's noise and clock."""
    imu = replace(site.platform.imu, **changed)
    return replace(site, platform=replace(site.platform, imu=imu))


def with_gravity(site: Site, gravity: float) -> Site:
    """Return a site with another gravity (m/s^2)."""
    return replace(site, gravity=max(gravity, NO_GRAVITY))


def turned_survey(site: Site, turn: Array, stretch: float = 1.0) -> Site:
    """Return a site whose beacons are turned together (3, 3), their positions stretched."""
    beacons = (
        replace(
            beacon,
            position_world=stretch * turn @ beacon.position_world,
            world_from_beacon=turn @ beacon.world_from_beacon,
        )
        for beacon in site.beacons
    )
    return replace(site, beacons=tuple(beacons))


# Those of the inertial sensors, which no estimated parameter describes.
_OF_IMU: dict[Parameter, Callable[[Site, Array], Site]] = {
    # The states estimate them: their sigmas are too small.
    GYRO_BIAS: lambda site, step: with_imu(site, gyro_bias_sigma=float(np.max(np.abs(step)))),
    ACCEL_BIAS: lambda site, step: with_imu(site, accel_bias_sigma=float(np.max(np.abs(step)))),
    GYRO_SCALE: lambda site, step: with_intrinsics(site, np.diag(1.0 + step)),
    ACCEL_SCALE: lambda site, step: with_intrinsics(site, accel=np.diag(1.0 + step)),
    GYRO_ALIGNMENT: lambda site, step: with_intrinsics(
        site, Rotation.from_rotvec(step).as_matrix()
    ),
    GYRO_G_SENSITIVITY: lambda site, step: with_intrinsics(site, g_sensitivity=step.reshape(3, 3)),
    GRAVITY: lambda site, step: with_gravity(site, site.gravity + float(step[0])),
}


def corrected_site(site: Site, fault: FaultCandidate, step: Array) -> Site:
    """Return a site with the parameters of a candidate fault moved.

    `step` (h,): of all fixed parameters, in typical errors.
    """
    if fault.code == SAMPLE_RATE:
        # What all drives drift by alike is the clock that they are compared with.
        (block, *_) = fault.blocks
        faster = float((block.sigma * step[block.columns])[0])
        rate = (1.0 + site.platform.magnetometer.clock_rate) * (1.0 + faster) - 1.0
        return with_magnetometer(site, clock_rate=rate)
    if fault.code in (TILT, STRETCH):
        size = np.linalg.lstsq(fault.combine, step, rcond=None)[0]
        turn, stretch = EYE, 1.0
        if fault.code == TILT:
            turn = Rotation.from_rotvec(TYPICAL_TILT * np.append(size, 0.0)).as_matrix()
        else:
            stretch = 1.0 + PER_CENT * float(size[0])
        return turned_survey(site, turn, stretch)
    for block in fault.blocks:
        site = _moved(site, block, block.sigma * step[block.columns])
    return site


def corrected_by(site: Site, cause: ReleasedFault) -> Site:
    """Return a site with the parameters of a cause corrected.

    Where the estimated positions of beacons have shown a tilt, gravity levels what remains of it
    about the middle of the beacons, which the correction moves about the origin: that is added to
    the sigmas of the positions.
    """
    result = corrected_site(site, cause.fault, cause.step)
    if cause.fault.code != TILT or cause.moved.any():
        return result
    back = np.linalg.pinv(cause.fault.combine)
    tilt_cov = np.zeros((3, 3))
    tilt_cov[:2, :2] = TYPICAL_TILT**2 * back @ cause.cov @ back.T  # rad^2
    arm = skew(np.mean([beacon.position_world for beacon in site.beacons], axis=0))
    common = len(site.beacons) * np.diagonal(arm @ tilt_cov @ arm.T)

    def widened(beacon: Beacon) -> Beacon:
        known = beacon.sigma.position_world
        sigma = np.where(known > 0.0, np.sqrt(known**2 + common), 0.0)
        return replace(beacon, sigma=replace(beacon.sigma, position_world=sigma))

    return replace(result, beacons=tuple(widened(beacon) for beacon in result.beacons))


def with_bias_walk(site: Site, cause: ReleasedFault) -> Site:
    """Return a site whose IMU bias may change as a step of it did; others as declared."""
    block = cause.fault.blocks[0]
    if not isinstance(block.parameter, SinceBias):
        return site
    name = "gyro_bias_walk" if block.parameter.of == GYRO_BIAS else "accel_bias_walk"
    size = float(np.linalg.norm(block.sigma * cause.step[block.columns]))
    walk = max(size / np.sqrt(STEP_DURATION), getattr(site.platform.imu, name))
    return with_imu(site, **{name: float(f"{walk:.2g}")})


def released_blocks(fault: FaultCandidate) -> tuple[Block, ...]:
    """Return the blocks of a candidate fault if a site can declare their sigmas.

    They are of one owner, or of beacons.
    """
    blocks = fault.blocks
    whole = fault.combine.shape[1] == sum(len(block.sigma) for block in blocks)
    declarable = all(block.parameter.declared for block in blocks)
    related = _are_estimated_together(blocks)
    return blocks if whole and related and declarable and not fault.code else ()


def estimated_blocks(declared: Site, corrected: Site) -> tuple[Block, ...]:
    """Return the blocks whose values differ between two sites, if of one owner or of beacons.

    The sigma of each is the size of the difference.
    """
    before, after = (initial_calibration(site, 0.0) for site in (declared, corrected))
    blocks = []
    for parameter, owner in candidates(declared):
        step = parameter.difference(before, after, owner)
        if parameter.declared and step.any():
            sigma = np.full(len(step), np.linalg.norm(step))
            blocks.append(Block(parameter, owner, slice(0), sigma))
    return placed(blocks) if _are_estimated_together(blocks) else ()


def _are_estimated_together(blocks: Sequence[Block]) -> bool:
    of_beacons = all(isinstance(block.parameter, BeaconParameter) for block in blocks)
    return of_beacons or len({block.owner for block in blocks}) == 1


def wide_sigmas(site: Site, blocks: tuple[Block, ...], sizes: Sequence[float]) -> list[Array]:
    """Return the sigmas of parameters that were wrong by some sizes, at least as declared.

    Where several beacons are wrong, so may be what is common to them, which no log shows: that is
    as uncertain as each of them was wrong.
    """
    total: dict[Parameter, float] = {}
    for block, size in zip(blocks, sizes, strict=True):
        total[block.parameter] = float(np.hypot(total.get(block.parameter, 0.0), size))
    return [
        np.maximum(block.parameter.sigma(site, block.owner), total[block.parameter])
        for block in blocks
    ]


def with_sigmas(calibration: Calibration, blocks: tuple[Block, ...], sigmas: list[Array]) -> Site:
    """Return the site of a calibration with new sigmas, in the units of the tangent vector."""
    site = calibration.site
    if site.correlation is not None:
        own = {(block.group, block.owner, block.kind) for block in blocks}
        others = site.correlation.kept(lambda one: one[:3] not in own)
        site = replace(site, correlation=others)
    for block, sigma in zip(blocks, sigmas, strict=True):
        site = block.parameter.refined(site, calibration, block.owner, sigma)
    return site


def _moved(site: Site, block: Block, step: Array) -> Site:
    """Return a site with one block moved; unchanged where no key describes the block."""
    parameter, owner = block.parameter, block.owner
    if parameter in _OF_IMU:
        return _OF_IMU[parameter](site, step)
    if parameter == PHASE:
        return with_phases(site, {owner: step})
    moved = parameter.moved(initial_calibration(site, 0.0), owner, step)
    return parameter.refined(moved.site, moved, owner, parameter.sigma(site, owner))


def with_phases(site: Site, steps: Mapping[str, Array]) -> Site:
    """Return a site with steps (rad) of the drive phase of each tone of some beacons, by name."""
    beacons = (_in_phase(b, steps[b.name]) if b.name in steps else b for b in site.beacons)
    return replace(site, beacons=tuple(beacons))


def _in_phase(beacon: Beacon, step: Array) -> Beacon:
    """Return a beacon with steps (rad) of the drive phase of each tone."""
    tones = [
        beacon.tones.index((coil.frequency_hz or beacon.frequency_hz, coil.slot))
        for coil in beacon.coils
    ]
    coils = (
        replace(coil, phase=coil.phase + float(step[tone]))
        for coil, tone in zip(beacon.coils, tones, strict=True)
    )
    return replace(beacon, coils=tuple(coils))
