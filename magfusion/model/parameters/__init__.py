"""Calibration parameters: one object a kind of them, and the tangent vector that they make up.

`PARAMETERS` is the one list of them; the fix, the smoother, the filter, reports and files iterate
over it or over the blocks chosen of it.
"""

from collections.abc import Callable, Iterable, Iterator

import numpy as np

from magfusion.model.field import observe, observe_from, predict
from magfusion.model.parameters.beacon import BEACON_POSITION as BEACON_POSITION
from magfusion.model.parameters.beacon import BEACON_ROTATION as BEACON_ROTATION
from magfusion.model.parameters.beacon import DRIFT as DRIFT
from magfusion.model.parameters.beacon import GAIN as GAIN
from magfusion.model.parameters.beacon import LOG_MOMENT as LOG_MOMENT
from magfusion.model.parameters.beacon import PHASE as PHASE
from magfusion.model.parameters.beacon import PHASE_SIGMA as PHASE_SIGMA
from magfusion.model.parameters.beacon import BeaconParameter as BeaconParameter
from magfusion.model.parameters.parameter import CENTIMETRE as CENTIMETRE
from magfusion.model.parameters.parameter import DEGREES as DEGREES
from magfusion.model.parameters.parameter import PERCENT as PERCENT
from magfusion.model.parameters.parameter import Block as Block
from magfusion.model.parameters.parameter import Calibration as Calibration
from magfusion.model.parameters.parameter import Parameter as Parameter
from magfusion.model.parameters.parameter import PhasorView
from magfusion.model.parameters.parameter import SteadyView as SteadyView
from magfusion.model.parameters.parameter import Unit as Unit
from magfusion.model.parameters.platform import CLOCK_RATE as CLOCK_RATE
from magfusion.model.parameters.platform import DECLINATION as DECLINATION
from magfusion.model.parameters.platform import MATRIX as MATRIX
from magfusion.model.parameters.platform import OFFSET as OFFSET
from magfusion.model.parameters.platform import SENSOR_POSITION as SENSOR_POSITION
from magfusion.model.parameters.platform import SENSOR_ROTATION as SENSOR_ROTATION
from magfusion.model.parameters.platform import STRENGTH as STRENGTH
from magfusion.model.parameters.platform import TIME_OFFSET as TIME_OFFSET
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
    OFFSET,
    SENSOR_ROTATION,
    SENSOR_POSITION,
    TIME_OFFSET,
    CLOCK_RATE,
    DECLINATION,
    STRENGTH,
)
GROUPS = tuple(dict.fromkeys(parameter.group for parameter in PARAMETERS))


def of_phasors(parameters: Iterable[Parameter]) -> tuple[Parameter, ...]:
    """Return the parameters that are not of the steady field alone."""
    return tuple(parameter for parameter in parameters if not parameter.steady_only)


PHASOR_PARAMETERS = of_phasors(PARAMETERS)


def initial_calibration(
    site: Site, reference_time: float, imu_begin: float | None = None
) -> Calibration:
    """Return the calibration that the site declares.

    Parameters
    ----------
    reference_time : float
        Where phases hold (s).
    imu_begin : float, optional
        Where the IMU's time offset holds (s); the reference time where there is no IMU.
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


def candidates(
    site: Site, parameters: Iterable[Parameter] = PARAMETERS
) -> Iterator[tuple[Parameter, str]]:
    """Yield every parameter with its owner: beacon by beacon, then the platform, then the room."""
    kinds = tuple(parameters)
    of_beacon = [kind for kind in kinds if isinstance(kind, BeaconParameter)]
    yield from ((kind, beacon.name) for beacon in site.beacons for kind in of_beacon)
    yield from ((kind, kind.owner) for kind in kinds if not isinstance(kind, BeaconParameter))


def choose_blocks(
    site: Site,
    groups: Iterable[str] | None = None,
    *,
    parameters: Iterable[Parameter] = PHASOR_PARAMETERS,
) -> tuple[Block, ...]:
    """Choose the calibration parameters to estimate.

    Parameters
    ----------
    site : Site
        Its sigmas are the priors; a parameter whose sigma is zero is known and never chosen.
    groups : iterable of str, optional
        Any of `GROUPS`, or of the given kinds' own.  None takes every parameter whose sigma is not
        negligible.
    parameters : iterable of Parameter
        The kinds that the measurements tell of; those of the Earth field are not among them unless
        it is measured.

    Returns
    -------
    tuple of Block
        In the order of the tangent vector.
    """
    wanted, kinds = None if groups is None else set(groups), tuple(parameters)
    known = dict.fromkeys([*GROUPS, *(kind.group for kind in kinds)])
    if wanted is not None and not wanted <= set(known):
        raise ValueError(f"groups must be among {tuple(known)}; got {sorted(wanted - set(known))}")

    def chosen(parameter: Parameter, sigma: float) -> bool:
        return sigma > parameter.negligible if wanted is None else parameter.group in wanted

    return _blocks(site, kinds, chosen)


def considered_blocks(
    site: Site,
    estimated: tuple[Block, ...],
    *,
    parameters: Iterable[Parameter] = PHASOR_PARAMETERS,
) -> tuple[Block, ...]:
    """Return the parameters that are uncertain but not among those estimated."""
    known = {block.key for block in estimated}
    every = _blocks(site, parameters, lambda _parameter, _sigma: True)
    return placed(block for block in every if block.key not in known)


def placed(blocks: Iterable[Block], start: int = 0) -> tuple[Block, ...]:
    """Return blocks whose columns follow each other."""
    out = []
    for block in blocks:
        out.append(block._replace(columns=slice(start, start + len(block.sigma))))
        start += len(block.sigma)
    return tuple(out)


def _blocks(
    site: Site,
    parameters: Iterable[Parameter],
    chosen: Callable[[Parameter, float], bool],
) -> tuple[Block, ...]:
    blocks: list[Block] = []
    for parameter, owner in candidates(site, parameters):
        sigma = parameter.sigma(site, owner)
        largest = float(np.max(sigma))
        if largest > 0.0 and chosen(parameter, largest):
            # One known axis in an unknown block.
            sigma = np.maximum(sigma, 1e-6 * largest)
            blocks.append(Block(parameter, owner, slice(0), sigma))
    return placed(blocks)


def dimension(blocks: tuple[Block, ...]) -> int:
    """Return the length of the tangent vector."""
    return blocks[-1].columns.stop if blocks else 0


def prior_sigma(blocks: tuple[Block, ...]) -> Array:
    """Return the prior standard deviations, shape (dimension,)."""
    return np.concatenate([b.sigma for b in blocks]) if blocks else np.zeros(0)


def retract(calibration: Calibration, blocks: tuple[Block, ...], step: Array) -> Calibration:
    """Return the calibration moved by a tangent vector, shape (dimension,)."""
    for block in blocks:
        part = np.array(step[block.columns])  # GTSAM's vectors are read-only
        if np.any(part):
            calibration = block.parameter.moved(calibration, block.owner, part)
    return calibration


def difference(reference: Calibration, moved: Calibration, blocks: tuple[Block, ...]) -> Array:
    """Return the tangent vector that takes ``reference`` to ``moved``: the inverse of `retract`."""
    step = np.zeros(dimension(blocks))
    for block in blocks:
        step[block.columns] = block.parameter.difference(reference, moved, block.owner)
    return step


def corrected_imu(
    calibration: Calibration, blocks: tuple[Block, ...], imu: ImuSamples
) -> ImuSamples:
    """Return the inertial samples without what the calibration says is wrong with them."""
    for block in inertial_blocks(blocks):
        imu = block.parameter.corrected_imu(calibration, block.owner, imu)
    return imu


def inertial_blocks(blocks: tuple[Block, ...]) -> tuple[Block, ...]:
    """Return the blocks that correct the inertial stream."""
    return tuple(block for block in blocks if block.parameter.inertial)


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
    return gain * np.concatenate(parts, axis=-2)


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
    whole = any(not block.parameter.factor_of_phasor for block in blocks)
    elapsed = time - calibration.reference_time
    start = 0
    for beacon in site.beacons:
        rows = slice(start, start + len(beacon.tones))
        place = (beacon, site.platform.magnetometer, world_from_body, position_world)
        seen = observe(*place, phase[..., rows], twist_body) if whole else None
        phasor, pose = (
            observe_from(*place, phase[..., rows])
            if seen is None
            else (seen.phasor_sensor, seen.platform_pose)
        )
        value[:, rows] = _stacked(phasor[..., None])[..., 0]
        by_pose[:, rows] = _stacked(pose)
        view = PhasorView(calibration, beacon, elapsed, phasor, seen)
        for block in blocks:
            part = block.parameter.phasor_jacobian(view, block.owner)
            if part is not None:
                by_calibration[:, rows, :, block.columns] = _stacked(part)
        start = rows.stop
    if not np.any(calibration.log_gain):
        return value, by_pose, by_calibration
    gain = np.exp(calibration.log_gain)[..., None]
    return gain * value, gain[..., None] * by_pose, gain[..., None] * by_calibration


def _stacked(block: ComplexArray) -> Array:
    return np.concatenate([block.real, block.imag], axis=-2)
