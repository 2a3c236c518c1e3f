"""Motion covered by a log, and the missing motion for undetermined parameters."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.model.noise import sensor_positions
from magfusion.model.parameters import (
    BEACON_POSITION,
    BeaconParameter,
    Block,
    Calibration,
    prior_sigma,
)
from magfusion.model.samples import ImuSamples
from magfusion.model.strapdown import resting
from magfusion.model.trajectory import Trajectory
from magfusion.results.figures import DETERMINED_RATIO
from magfusion.results.observability import CalibrationObservability, parameter_names
from magfusion.units import DEGREE, Array, BoolArray

HARDLY_TURNED = 15.0  # deg, root mean square about an axis
HARDLY_MOVED = 0.5  # m, between the extremes
MIN_REST_SHARE = 0.01  # of the time
MAX_LISTED = 3
_AXES = "xyz"


@dataclass(frozen=True, eq=False)
class MotionCoverage:
    """Range of the platform's positions and attitudes."""

    nearest: Mapping[str, float]  # beacon to the sensor's minimum distance from it (m)
    # beacon to the largest angle, seen from it, between the sensor and its mean direction
    spread_deg: Mapping[str, float]
    extent_world: Array  # (3,), range of the position (m)
    # (3,), root mean square of the rotation from the mean attitude, about each axis of the body
    turned_deg: Array
    rest_share: float  # share of stationary samples


def motion_coverage(
    states: Trajectory, calibration: Calibration, imu: ImuSamples
) -> MotionCoverage:
    """Return the range of a motion.

    `imu`: used to find rests.
    """
    sensor_world = sensor_positions(calibration.site, states)[:, 0]
    nearest, spread = {}, {}
    for beacon in calibration.site.beacons:
        offset = sensor_world - beacon.position_world
        distance = np.linalg.norm(offset, axis=1, keepdims=True)
        mean = np.mean(offset / distance, axis=0)
        cosine = (offset / distance) @ (mean / max(float(np.linalg.norm(mean)), 1e-12))
        nearest[beacon.name] = float(np.min(distance))
        spread[beacon.name] = float(np.max(np.arccos(np.clip(cosine, -1.0, 1.0))) / DEGREE)
    rotated = Rotation.from_matrix(states.world_from_body)
    motion = calibration.site.platform.motion
    still = resting(imu.time, imu.gyro_body, imu.accel_body, motion=motion)
    away = (rotated.mean().inv() * rotated).as_rotvec() / DEGREE
    return MotionCoverage(
        nearest=nearest,
        spread_deg=spread,
        extent_world=np.ptp(states.position_world, axis=0),
        turned_deg=np.sqrt(np.mean(away**2, axis=0)),
        rest_share=float(np.mean(still)),
    )


def missing_motion(
    covered: MotionCoverage,
    calibration: Calibration,
    blocks: tuple[Block, ...],
    coverage: CalibrationObservability,
) -> list[str]:
    """Return sentences on the motion that would determine open parameters, except gauges."""
    open_ = _open(calibration, blocks, coverage)
    out = [_of_beacon(covered, b.name, open_.get(b.name, [])) for b in calibration.site.beacons]
    out += [_of_turning(covered, blocks, coverage), _of_extent(covered, blocks, coverage)]
    if covered.rest_share < MIN_REST_SHARE:
        out.append(
            "The platform was never stationary: the IMU's biases, and with them the vertical, are"
            " only determined by its motion; add stops of some seconds, in several attitudes."
        )
    return [sentence for sentence in out if sentence]


def _is_open(coverage: CalibrationObservability, columns: slice) -> BoolArray:
    """Return which parameters of a block the log does not determine, apart from gauges."""
    return np.nan_to_num(coverage.ratio_but_for_gauge[columns]) > DETERMINED_RATIO


def _open(
    calibration: Calibration, blocks: tuple[Block, ...], coverage: CalibrationObservability
) -> dict[str, list[str]]:
    """Return each beacon's undetermined parameters with their sigmas, weakest first."""
    names, prior = parameter_names(blocks, calibration), prior_sigma(blocks)
    listed: dict[str, list[tuple[float, str]]] = {}
    for block in blocks:
        parameter = block.parameter
        if not (isinstance(parameter, BeaconParameter) and parameter.declared):
            continue
        rows = np.arange(block.columns.start, block.columns.stop)
        for row in rows[_is_open(coverage, block.columns)]:
            name, unit, scale = names[row]
            ratio = float(coverage.ratio_but_for_gauge[row])
            short = name.replace(f" of beacon {block.owner}", "")
            text = f"{short} ({ratio * prior[row] / scale:.2g} {unit})"
            listed.setdefault(block.owner, []).append((ratio, text))
    return {owner: [text for _, text in sorted(rows)[::-1]] for owner, rows in listed.items()}


def _of_beacon(covered: MotionCoverage, name: str, open_: list[str]) -> str:
    if not open_:
        return ""
    more = f" and {len(open_) - MAX_LISTED} more" if len(open_) > MAX_LISTED else ""
    return (
        f"The platform was never closer than {covered.nearest[name]:.1f} m to beacon {name}, within"
        f" {covered.spread_deg[name]:.0f} deg of one direction from it: not determined are"
        f" {', '.join(open_[:MAX_LISTED])}{more}; pass it closer, and on another side."
    )


def _of_turning(
    covered: MotionCoverage, blocks: tuple[Block, ...], coverage: CalibrationObservability
) -> str:
    hardly = np.flatnonzero(covered.turned_deg < HARDLY_TURNED)
    waiting = [
        block.parameter.by_turning
        for block in blocks
        if block.parameter.by_turning and np.any(_is_open(coverage, block.columns))
    ]
    if not waiting or not len(hardly):
        return ""
    axes = " and ".join(_AXES[k] for k in hardly)
    angles = ", ".join(f"{covered.turned_deg[k]:.0f}" for k in hardly)
    return (
        f"Rotation about {axes} of the body was small ({angles} deg rms), so that"
        f" {' and '.join(waiting)} cannot be determined; rotate it about all three axes."
    )


def _of_extent(
    covered: MotionCoverage, blocks: tuple[Block, ...], coverage: CalibrationObservability
) -> str:
    """Return the axes of little motion, if positions of beacons along them are undetermined."""
    waiting = np.zeros(3, dtype=bool)
    for block in blocks:
        if block.parameter == BEACON_POSITION:
            waiting |= _is_open(coverage, block.columns)
    hardly = np.flatnonzero(waiting & (covered.extent_world < HARDLY_MOVED))
    if not len(hardly):
        return ""
    listed = ", ".join(f"{100.0 * covered.extent_world[k]:.0f} cm along {_AXES[k]}" for k in hardly)
    return f"The platform moved by only {listed}: positions of beacons are open; move farther."
