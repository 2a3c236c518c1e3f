"""Candidate faults of what an estimator does not estimate: every fixed parameter.

Besides the calibration parameters of the site there are some that no site declares, of the inertial
sensors: for those the score of `magfusion.estimation.integrity.score` is the only test.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from magfusion.estimation.measurements.steel import SteelModes
from magfusion.model.ground import conductivity_of
from magfusion.model.parameters import (
    AIDING_CLOCK,
    AIDING_OFFSET,
    AIDING_POINT,
    AIDING_POSITION,
    AIDING_PRESSURE,
    AIDING_ROTATION,
    AIDING_SCALE,
    BEACON_POSITION,
    BEACON_ROTATION,
    CLOCK_OFFSET,
    CLOCK_RATE,
    CONDUCTIVITY,
    DECLINATION,
    DRIFT,
    LOG_MOMENT,
    MATRIX,
    OFFSET,
    PARAMETERS,
    PERCENT,
    PHASE,
    RESPONSE_GAIN,
    RESPONSE_PHASE,
    SENSOR_POSITION,
    SENSOR_ROTATION,
    STRENGTH,
    TIME_OFFSET,
    BeaconParameter,
    Block,
    MagnetometerParameter,
    Parameter,
    candidates,
    placed,
)
from magfusion.model.parameters.inertial import (
    ACCEL_BIAS,
    ACCEL_SCALE,
    GRAVITY,
    GYRO_ALIGNMENT,
    GYRO_BIAS,
    GYRO_G_SENSITIVITY,
    GYRO_SCALE,
    INERTIAL,
)
from magfusion.model.perturbation import skew
from magfusion.model.site import Site
from magfusion.units import DEGREE, Array

# Typical error of an installation that nobody measured, in the unit of the tangent vector.
TYPICAL: dict[Parameter, float] = {
    BEACON_ROTATION: DEGREE,
    BEACON_POSITION: 0.01,
    LOG_MOMENT: 0.01,
    PHASE: DEGREE,
    DRIFT: 1e-6,
    MATRIX: 0.01,
    RESPONSE_GAIN: 0.01,
    RESPONSE_PHASE: DEGREE,
    OFFSET: 0.1,
    SENSOR_ROTATION: DEGREE,
    SENSOR_POSITION: 0.01,
    TIME_OFFSET: 1e-3,
    DECLINATION: DEGREE,
    STRENGTH: 0.5,
    GYRO_BIAS: 0.01,
    ACCEL_BIAS: 0.1,
    GYRO_SCALE: 0.01,
    ACCEL_SCALE: 0.01,
    GYRO_ALIGNMENT: DEGREE,
    GYRO_G_SENSITIVITY: 2e-4,
    GRAVITY: 0.01,
    CLOCK_OFFSET: 1e-4,
    CLOCK_RATE: 1e-5,
    CONDUCTIVITY: 0.1,
    AIDING_SCALE: 0.01,
    AIDING_OFFSET: 0.1,
    AIDING_PRESSURE: 1.0,
    AIDING_CLOCK: 0.01,
    AIDING_ROTATION: DEGREE,
    AIDING_POSITION: 0.05,
    AIDING_POINT: 0.05,
}

# What no site declares and every instrument has: scales and axes of a MEMS, where in its case the
# accelerometer is and how it is turned there.  It is no mistake unless the poses err by it.
TOLERANCE: dict[Parameter, float] = {
    GYRO_SCALE: 0.01,
    ACCEL_SCALE: 0.01,
    GYRO_ALIGNMENT: DEGREE,
    GYRO_G_SENSITIVITY: 3e-4,
    GRAVITY: 0.01,
    CLOCK_RATE: 2e-6,
    SENSOR_ROTATION: 0.1 * DEGREE,
    SENSOR_POSITION: 0.004,
}

# Largest error that is no mistake: the size of a housing and its mounting, the latency of a bus.
USUAL: dict[Parameter, float] = TOLERANCE | {
    SENSOR_ROTATION: 0.4 * DEGREE,
    SENSOR_POSITION: 0.015,
    AIDING_CLOCK: 0.02,
}

# What is larger is another mistake: a unit, an axis, gravity.
MAX_SIZE: dict[Parameter, float] = {
    GYRO_BIAS: 0.5,
    ACCEL_BIAS: 1.5,
    GYRO_ALIGNMENT: 20.0 * DEGREE,
    AIDING_POSITION: 3.0,  # of a vehicle
}


# Of the finding that calls it in question; as in `magfusion.model.trust.CODES`.
CODE: dict[Parameter, str] = {
    BEACON_ROTATION: "beacon_pose",
    BEACON_POSITION: "beacon_pose",
    LOG_MOMENT: "moments",
    PHASE: "phase",
    DRIFT: "beacon_clock",
    MATRIX: "magnetometer_matrix",
    RESPONSE_GAIN: "magnetometer_response",
    RESPONSE_PHASE: "magnetometer_response",
    OFFSET: "magnetometer_offset",
    SENSOR_ROTATION: "mounting",
    SENSOR_POSITION: "lever_arm",
    TIME_OFFSET: "time_offset",
    DECLINATION: "earth_field",
    STRENGTH: "earth_field",
    GYRO_BIAS: "imu_bias",
    ACCEL_BIAS: "imu_bias",
    GYRO_SCALE: "gyro_scale",
    ACCEL_SCALE: "accel_scale",
    GYRO_ALIGNMENT: "imu_axes",
    GYRO_G_SENSITIVITY: "gyro_g_sensitivity",
    GRAVITY: "gravity",
    CLOCK_OFFSET: "magnetometer_clock",
    CLOCK_RATE: "imu_clock",
    CONDUCTIVITY: "ground",
    AIDING_SCALE: "aiding_scale",
    AIDING_OFFSET: "aiding_offset",
    AIDING_PRESSURE: "aiding_offset",
    AIDING_CLOCK: "aiding_clock",
    AIDING_ROTATION: "aiding_mounting",
    AIDING_POSITION: "aiding_lever_arm",
    AIDING_POINT: "aiding_point",
}

LEVER_ARM = "the lever arm of the magnetometer"
TILT, STRETCH, SAMPLE_RATE = "survey_tilt", "survey_scale", "sample_rate"
FIELD_SCALE, EPOCH_SHIFT = "field_scale", "epoch_shift"
TYPICAL_SHIFT = 1e-3  # s, of stamps against the drives: a driver's or a bus's delay
# How often it is wrong, relative to what one beacon or one sensor is declared as: a whole survey is
# seldom tilted, and gyros seldom are that bad.
RARE = 0.1
RARELY_WRONG: tuple[Parameter, ...] = (GYRO_ALIGNMENT, GYRO_G_SENSITIVITY, GRAVITY, AIDING_POINT)
TYPICAL_TILT = 0.5 * DEGREE  # of a survey by a level; a beacon alone is turned by more


class FaultCandidate(NamedTuple):
    """Parameters that one mistake would have wrong together."""

    name: str  # in words
    blocks: tuple[Block, ...]  # among those that are fixed
    # (dimension, columns), directions that are tried, of all that is fixed, in units of what is
    # typical
    combine: Array
    code: str = ""  # of its finding; otherwise that of the first block's parameter
    odds: float = 1.0  # prior, relative to the usual

    @property
    def finding_code(self) -> str:
        """Code of its finding."""
        return self.code or CODE[self.blocks[0].parameter]


def fixed_blocks(site: Site, estimated: tuple[Block, ...], *, static: bool) -> tuple[Block, ...]:
    """Return every parameter that is not estimated, with its typical error for a sigma.

    `static`: whether the static field is measured.
    """
    known = {block.key for block in estimated}
    every = (*PARAMETERS, *INERTIAL)
    if not site.platform.inertial:
        # What moves steadily need not be where the platform's axes are declared.
        of_imu = (TIME_OFFSET, CLOCK_RATE, SENSOR_ROTATION, SENSOR_POSITION)
        every = tuple(p for p in PARAMETERS if p not in of_imu)
    if not conductivity_of(site):
        every = tuple(p for p in every if p != CONDUCTIVITY)
    if not site.platform.further:  # the log's clock is that of the only one
        every = tuple(p for p in every if p != CLOCK_OFFSET)
    kinds = [p for p in every if static or not p.static_only]
    return placed(
        Block(kind, owner, slice(0), np.full(len(kind.sigma(site, owner)), TYPICAL[kind]))
        for kind, owner in candidates(site, kinds)
        if (kind, owner) not in known
    )


def fault_candidates(site: Site, fixed: tuple[Block, ...]) -> Iterator[FaultCandidate]:
    """Yield what one mistake would have wrong: a block, or several of a kind."""
    size = fixed[-1].columns.stop if fixed else 0

    def together(name: str, chosen: list[Block]) -> FaultCandidate:
        columns = np.concatenate([np.arange(size)[b.columns] for b in chosen])
        return FaultCandidate(name, tuple(chosen), np.eye(size)[:, columns])

    for block in fixed:
        if not isinstance(block.parameter, SteelModes):  # `steel_test` has those
            odds = RARE if block.parameter in RARELY_WRONG else 1.0
            yield together(display_name(block), [block])._replace(odds=odds)
    poses = {b.name: f"the pose of beacon {b.name}" for b in site.beacons}
    sets = {
        f"the positions of {_beacons(site)}": (BEACON_POSITION,),
        f"the attitudes of {_beacons(site)}": (BEACON_ROTATION,),
        f"the moments of {_beacons(site)}": (LOG_MOMENT,),
    }
    several = [(name, [b for b in fixed if b.parameter in kinds]) for name, kinds in sets.items()]
    mounted = [b for b in fixed if b.parameter in (SENSOR_ROTATION, SENSOR_POSITION)]
    for owner in dict.fromkeys(block.owner for block in mounted):
        own = [block for block in mounted if block.owner == owner]
        several.insert(0, (f"the mounting and the lever arm of {_sensor(owner)}", own))
    surveyed = [b for b in fixed if b.parameter in (BEACON_ROTATION, BEACON_POSITION)]
    several += [(text, [b for b in surveyed if b.owner == name]) for name, text in poses.items()]
    yield from (together(name, blocks) for name, blocks in several if len(blocks) > 1)
    yield from _common(site, fixed, size)
    if site.platform.inertial and len(surveyed) == 2 * len(site.beacons):
        blocks = tuple(surveyed)
        tilt = survey_tilt(site, blocks, size)
        yield FaultCandidate("the vertical of the survey", blocks, tilt, TILT, RARE)
    places = tuple(b for b in surveyed if b.parameter == BEACON_POSITION)
    if len(places) == len(site.beacons) > 1:
        stretch = survey_scale(site, places, size)
        yield FaultCandidate("the scale of the survey", places, stretch, STRETCH)


def _common(site: Site, fixed: tuple[Block, ...], size: int) -> Iterator[FaultCandidate]:
    """Yield what would have one number of all beacons wrong by the same amount."""
    # That of the magnetometer has the same effect.
    scale = f"the scale of the fields of {_beacons(site)}"
    kinds: dict[str, tuple[Parameter, str]] = {scale: (LOG_MOMENT, FIELD_SCALE)}
    if not site.platform.further:
        kinds["the sampling rate of the magnetometer"] = (DRIFT, SAMPLE_RATE)
    for name, (parameter, code) in kinds.items():
        own = tuple(b for b in fixed if b.parameter == parameter)
        if len(own) > 1:
            common = np.zeros((size, 1))
            for block in own:
                common[block.columns] = 1.0
            yield FaultCandidate(name, own, common, code)
    phases = tuple(block for block in fixed if block.parameter == PHASE)
    if len(phases) > 1:
        yield FaultCandidate(
            "the epoch of the drive phases", phases, epoch_shift(site, phases, size), EPOCH_SHIFT
        )


def epoch_shift(site: Site, phases: tuple[Block, ...], size: int) -> Array:
    """Return the effect on all drive phases of stamps that are late, shape (size, 1).

    A unit is a typical delay, `TYPICAL_SHIFT`.
    """
    out = np.zeros((size, 1))
    beacons = {beacon.name: beacon for beacon in site.beacons}
    for block in phases:
        turns = 2.0 * np.pi * beacons[block.owner].tone_frequencies_hz
        out[block.columns, 0] = turns * TYPICAL_SHIFT / block.sigma
    return out


def survey_tilt(site: Site, surveyed: tuple[Block, ...], size: int) -> Array:
    """Return the effect of tilting the whole survey about world x and y, shape (size, 2).

    A unit is a typical tilt; gravity and the Earth field stay.
    """
    tilt_world, out = TYPICAL_TILT * np.eye(3)[:, :2], np.zeros((size, 2))
    beacons = {beacon.name: beacon for beacon in site.beacons}
    for block in surveyed:
        beacon = beacons[block.owner]
        if block.parameter == BEACON_ROTATION:
            change = beacon.world_from_beacon.T @ tilt_world
        else:
            change = -skew(beacon.position_world) @ tilt_world
        out[block.columns] = change / block.sigma[:, None]
    return out


def survey_scale(site: Site, places: tuple[Block, ...], size: int) -> Array:
    """Return the effect of stretching all positions by one per cent, shape (size, 1)."""
    out = np.zeros((size, 1))
    beacons = {beacon.name: beacon for beacon in site.beacons}
    for block in places:
        out[block.columns, 0] = PERCENT.size * beacons[block.owner].position_world / block.sigma
    return out


def _beacons(site: Site) -> str:
    return "beacons " + ", ".join(beacon.name for beacon in site.beacons)


def _sensor(owner: str) -> str:
    """Return what a magnetometer is called: by its name where there are several."""
    return "the magnetometer" if owner in ("sensor", "magnetometer") else f"magnetometer {owner}"


def display_name(block: Block) -> str:
    """Return what a block is called in a sentence."""
    names = {
        SENSOR_ROTATION: "the mounting of the magnetometer",
        SENSOR_POSITION: LEVER_ARM,
        MATRIX: "the magnetometer's matrix (body iron, gains, axes)",
        RESPONSE_GAIN: "the magnetometer's gains relative to its x",
        RESPONSE_PHASE: "the magnetometer's phases relative to its x",
        OFFSET: "the magnetometer's offset",
        TIME_OFFSET: "the IMU's time offset",
        DECLINATION: "the declination of the Earth field",
        STRENGTH: "the strength of the Earth field",
        GYRO_BIAS: "the bias of the gyro",
        ACCEL_BIAS: "the bias of the accelerometer",
        GYRO_SCALE: "the scale of the gyro",
        ACCEL_SCALE: "the scale of the accelerometer",
        GYRO_ALIGNMENT: "the axes of the gyro",
        GYRO_G_SENSITIVITY: "the g-sensitivity of the gyro",
        GRAVITY: "the size of gravity",
        CLOCK_OFFSET: "the clock of the magnetometer",
        CLOCK_RATE: "the rate of the IMU's clock",
        BEACON_POSITION: "the position of beacon {owner}",
        BEACON_ROTATION: "the attitude of beacon {owner}",
        LOG_MOMENT: "the moments of beacon {owner}",
        PHASE: "the drive phase of beacon {owner}",
        DRIFT: "the clock of beacon {owner}",
        CONDUCTIVITY: "the conductivity of the ground",
    }
    own = block.owner if isinstance(block.parameter, BeaconParameter) else ""
    text = names.get(block.parameter, block.name).format(owner=own)
    if isinstance(block.parameter, MagnetometerParameter):
        return text.replace("the magnetometer", _sensor(block.owner))
    return text
