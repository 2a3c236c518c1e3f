"""Calibration parameters: one object per kind, and the tangent vector that they form.

`PARAMETERS` lists all of them; fix, smoother, filter, reports and files iterate over it or over
blocks selected from it.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

import numpy as np

from magfusion.model.channel_effects import axis_factors, responded
from magfusion.model.parameters.aiding import AIDING_CLOCK as AIDING_CLOCK
from magfusion.model.parameters.aiding import AIDING_OFFSET as AIDING_OFFSET
from magfusion.model.parameters.aiding import AIDING_POINT as AIDING_POINT
from magfusion.model.parameters.aiding import AIDING_POSITION as AIDING_POSITION
from magfusion.model.parameters.aiding import AIDING_PRESSURE as AIDING_PRESSURE
from magfusion.model.parameters.aiding import AIDING_ROTATION as AIDING_ROTATION
from magfusion.model.parameters.aiding import AIDING_SCALE as AIDING_SCALE
from magfusion.model.parameters.aiding import AidingParameter as AidingParameter
from magfusion.model.parameters.beacon import BEACON_POSITION as BEACON_POSITION
from magfusion.model.parameters.beacon import BEACON_ROTATION as BEACON_ROTATION
from magfusion.model.parameters.beacon import DRIFT as DRIFT
from magfusion.model.parameters.beacon import GAIN as GAIN
from magfusion.model.parameters.beacon import LOG_MOMENT as LOG_MOMENT
from magfusion.model.parameters.beacon import PHASE as PHASE
from magfusion.model.parameters.beacon import PHASE_SIGMA as PHASE_SIGMA
from magfusion.model.parameters.beacon import BeaconParameter as BeaconParameter
from magfusion.model.parameters.channels import linearize_channels as linearize_channels
from magfusion.model.parameters.channels import predict_channels as predict_channels
from magfusion.model.parameters.ground import CONDUCTIVITY as CONDUCTIVITY
from magfusion.model.parameters.parameter import CENTIMETRE as CENTIMETRE
from magfusion.model.parameters.parameter import DEGREES as DEGREES
from magfusion.model.parameters.parameter import PERCENT as PERCENT
from magfusion.model.parameters.parameter import Block as Block
from magfusion.model.parameters.parameter import Calibration as Calibration
from magfusion.model.parameters.parameter import Parameter as Parameter
from magfusion.model.parameters.parameter import ParameterUnit as ParameterUnit
from magfusion.model.parameters.parameter import StaticView as StaticView
from magfusion.model.parameters.parameter import dimension as dimension
from magfusion.model.parameters.platform import CLOCK_OFFSET as CLOCK_OFFSET
from magfusion.model.parameters.platform import CLOCK_RATE as CLOCK_RATE
from magfusion.model.parameters.platform import DECLINATION as DECLINATION
from magfusion.model.parameters.platform import MATRIX as MATRIX
from magfusion.model.parameters.platform import OFFSET as OFFSET
from magfusion.model.parameters.platform import RESPONSE_GAIN as RESPONSE_GAIN
from magfusion.model.parameters.platform import RESPONSE_PHASE as RESPONSE_PHASE
from magfusion.model.parameters.platform import SENSOR_POSITION as SENSOR_POSITION
from magfusion.model.parameters.platform import SENSOR_ROTATION as SENSOR_ROTATION
from magfusion.model.parameters.platform import STRENGTH as STRENGTH
from magfusion.model.parameters.platform import TIME_OFFSET as TIME_OFFSET
from magfusion.model.parameters.platform import MagnetometerParameter as MagnetometerParameter
from magfusion.model.parameters.subset import beacons_of as beacons_of
from magfusion.model.parameters.subset import channels_of as channels_of
from magfusion.model.parameters.subset import of_beacons as of_beacons
from magfusion.model.parameters.subset import samples_of as samples_of
from magfusion.model.parameters.subset import stretches as stretches
from magfusion.model.parameters.subset import with_undetected as with_undetected
from magfusion.model.samples import ImuSamples
from magfusion.model.site import Site
from magfusion.units import Array, ComplexArray

PARAMETERS: tuple[Parameter, ...] = (
    BEACON_ROTATION,
    BEACON_POSITION,
    LOG_MOMENT,
    PHASE,
    DRIFT,
    MATRIX,
    RESPONSE_GAIN,
    RESPONSE_PHASE,
    OFFSET,
    SENSOR_ROTATION,
    SENSOR_POSITION,
    CLOCK_OFFSET,
    TIME_OFFSET,
    CLOCK_RATE,
    AIDING_SCALE,
    AIDING_OFFSET,
    AIDING_PRESSURE,
    AIDING_CLOCK,
    AIDING_ROTATION,
    AIDING_POSITION,
    AIDING_POINT,
    CONDUCTIVITY,
    DECLINATION,
    STRENGTH,
)
GROUPS = tuple(dict.fromkeys(parameter.group for parameter in PARAMETERS))


def of_phasors(parameters: Iterable[Parameter]) -> tuple[Parameter, ...]:
    """Return the parameters that affect more than the static field."""
    return tuple(parameter for parameter in parameters if not parameter.static_only)


PHASOR_PARAMETERS = of_phasors(PARAMETERS)


def initial_calibration(
    site: Site, reference_time: float, imu_begin: float | None = None
) -> Calibration:
    """Return the declared calibration of a site.

    Parameters
    ----------
    reference_time : float
        Reference of the phases (s).
    imu_begin : float, optional
        Reference of the IMU's time offset (s); the reference time without an IMU.
    """
    return Calibration(
        site=site,
        phase=np.zeros(len(site.channels)),
        drift=np.zeros(len(site.beacons)),
        time_offset=site.platform.imu.time_offset,
        reference_time=reference_time,
        log_gain=np.zeros(len(site.channels)),
        clock_rate=site.platform.imu.clock_rate,
        imu_begin=reference_time if imu_begin is None else imu_begin,
    )


def seen_by(calibration: Calibration, sensor: int) -> Calibration:
    """Return the calibration for the measurements of one of the platform's magnetometers."""
    site = calibration.site
    if not site.platform.further:
        return calibration
    mine, one = site.of_sensor(sensor), site.platform.magnetometers[sensor]
    late = float(calibration.clock_offsets[sensor])
    frequencies_hz = site.tone_frequencies_hz
    return replace(
        calibration,
        site=replace(site, platform=site.platform.with_magnetometers((one,))),
        phase=calibration.phase[..., mine] + 2.0 * np.pi * frequencies_hz * late,
        log_gain=calibration.log_gain[..., mine],
    )


def without_response(
    phasor: ComplexArray, calibration: Calibration
) -> tuple[ComplexArray, Calibration]:
    """Return phasors (..., channels, 3) with the response removed, and a calibration without."""
    site = calibration.site
    answer, factors = responded(site), axis_factors(site)
    if answer is None and factors is None:
        return phasor, calibration
    if answer is not None:
        phasor = phasor / np.exp(answer[0] + 1j * answer[1])[:, None]
    phasor = phasor if factors is None else phasor / factors
    plain = tuple(replace(m, response=None) for m in site.platform.magnetometers)
    return phasor, replace(
        calibration, site=replace(site, platform=site.platform.with_magnetometers(plain))
    )


def candidates(
    site: Site, parameters: Iterable[Parameter] = PARAMETERS
) -> Iterator[tuple[Parameter, str]]:
    """Yield every parameter with its owner: the beacons, then the platform, then the room."""
    kinds = tuple(parameters)
    of_beacon = [kind for kind in kinds if isinstance(kind, BeaconParameter)]
    yield from ((kind, beacon.name) for beacon in site.beacons for kind in of_beacon)
    others = [kind for kind in kinds if not isinstance(kind, BeaconParameter)]
    yield from ((kind, owner) for kind in others for owner in kind.owners(site))


def choose_blocks(
    site: Site,
    groups: Iterable[str] | None = None,
    *,
    parameters: Iterable[Parameter] = PHASOR_PARAMETERS,
) -> tuple[Block, ...]:
    """Choose the calibration parameters to estimate.

    `site`: its sigmas are the priors; a parameter with zero sigma is known and never selected.
    `groups`: any of `GROUPS`, or of the given kinds' own. None selects every parameter whose sigma
    is not negligible. `parameters`: the kinds that the measurements depend on; those of the Earth
    field are included only if it is measured. Returned in the order of the tangent vector.
    """
    wanted, kinds = None if groups is None else set(groups), tuple(parameters)
    known = dict.fromkeys([*GROUPS, *(kind.group for kind in kinds)])
    if wanted is not None and not wanted <= set(known):
        raise ValueError(f"groups must be among {tuple(known)}; got {sorted(wanted - set(known))}")

    def chosen(parameter: Parameter, sigma: float) -> bool:
        return sigma > parameter.kept_to(site) if wanted is None else parameter.group in wanted

    return _blocks(site, kinds, chosen)


def considered_blocks(
    site: Site, estimated: tuple[Block, ...], *, parameters: Iterable[Parameter] = PHASOR_PARAMETERS
) -> tuple[Block, ...]:
    """Return the parameters that are uncertain but not among those estimated."""
    known = {block.key for block in estimated}
    every = _blocks(site, parameters, lambda _parameter, _sigma: True)
    return placed(block for block in every if block.key not in known)


def placed(blocks: Iterable[Block], start: int = 0) -> tuple[Block, ...]:
    """Assign successive columns to blocks."""
    out = []
    for block in blocks:
        out.append(block._replace(columns=slice(start, start + len(block.sigma))))
        start += len(block.sigma)
    return tuple(out)


def _blocks(
    site: Site, parameters: Iterable[Parameter], chosen: Callable[[Parameter, float], bool]
) -> tuple[Block, ...]:
    blocks: list[Block] = []
    for parameter, owner in candidates(site, parameters):
        sigma = parameter.sigma(site, owner)
        largest = float(np.max(sigma))
        if largest > 0.0 and chosen(parameter, largest):
            # A known axis within an unknown block; turns about two axes turn the third, too.
            known = 1e-3 if parameter.is_rotation else 1e-6
            sigma = np.maximum(sigma, known * largest)
            blocks.append(Block(parameter, owner, slice(0), sigma))
    return placed(blocks)


def prior_sigma(blocks: tuple[Block, ...]) -> Array:
    """Return the prior standard deviations, shape (dimension,)."""
    return np.concatenate([b.sigma for b in blocks]) if blocks else np.zeros(0)


def retract(calibration: Calibration, blocks: tuple[Block, ...], step: Array) -> Calibration:
    """Return the calibration moved by a tangent vector, shape (dimension,)."""
    if not step.any():
        return calibration
    own = np.array(step)  # GTSAM's vectors are read-only
    last = int(own.nonzero()[0][-1])  # considered parameters do not move
    numbers = own.tolist()
    steps: dict[Parameter, dict[str, Array]] = {}
    for block in blocks:
        if block.columns.start > last:
            continue
        if any(numbers[block.columns]):
            steps.setdefault(block.parameter, {})[block.owner] = own[block.columns]
    for parameter, of_owners in steps.items():
        calibration = parameter.all_moved(calibration, of_owners)
    return calibration


def difference(reference: Calibration, moved: Calibration, blocks: tuple[Block, ...]) -> Array:
    """Return the tangent vector from ``reference`` to ``moved``: the inverse of `retract`."""
    step = np.zeros(dimension(blocks))
    if moved is reference:  # as in a filter that estimates none
        return step
    of_kind: dict[Parameter, list[Block]] = {}
    for block in blocks:
        of_kind.setdefault(block.parameter, []).append(block)
    for parameter, own in of_kind.items():
        steps = parameter.all_differences(reference, moved, [block.owner for block in own])
        for block, part in zip(own, steps, strict=True):
            step[block.columns] = part
    return step


def corrected_imu(
    calibration: Calibration, blocks: tuple[Block, ...], imu: ImuSamples
) -> ImuSamples:
    """Return the inertial samples, corrected by the calibration."""
    for block in inertial_blocks(blocks):
        imu = block.parameter.corrected_imu(calibration, block.owner, imu)
    return imu


def inertial_blocks(blocks: tuple[Block, ...]) -> tuple[Block, ...]:
    """Return the blocks that correct the inertial stream."""
    return tuple(block for block in blocks if block.parameter.inertial)
