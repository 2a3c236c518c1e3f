"""Start of the smoother: the chain of hypotheses that agrees best with the motion."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.estimation.data_checks.statistics import effective_number
from magfusion.estimation.snapshot.fix import Fixes
from magfusion.model.channel_effects import of_all_sensors
from magfusion.model.parameters import Calibration
from magfusion.model.quaternion import inverse, matrices, product
from magfusion.model.samples import ImuSamples
from magfusion.model.short_repr import short_repr
from magfusion.model.site import ClockModel, Site
from magfusion.model.strapdown import mean_about, turn_from_gyro_at
from magfusion.model.trajectory import Trajectory
from magfusion.units import Array, BoolArray, IntArray

POSITION_SIGMA = 0.1  # m; added to the fixes' own, which calibration errors exceed
ROTATION_SIGMA = 0.1  # rad; and the possible contribution of the gyro's bias
LEAP_COST = 100.0  # of a jump between unrelated hypotheses: one bad epoch must not break a chain
RIVAL_COST = 1000.0  # chi square; a chain worse by more is no rival
MIN_SCATTER = 1e-4  # rad^2; of single-epoch phases, as field models are that wrong


@dataclass(frozen=True, eq=False)
class Start:
    """Initial estimate of the states."""

    __repr__ = short_repr

    states: Trajectory  # with velocity
    phase: Array  # (n, channels), drive phase of the chosen hypotheses (rad)
    chosen: IntArray  # (n,), hypothesis of each epoch
    cost: float  # chi square of the chain
    # (n,), False where the epoch alone leaves a direction of its pose unobservable
    determined: BoolArray
    leaps: int = 0  # steps between hypotheses that no motion connects


def choose_chains(
    fixes: Fixes, imu: ImuSamples, time_offset: float, site: Site
) -> tuple[Start, ...]:
    """Choose chains of hypotheses consistent with gyro, gravity and speed (Viterbi).

    `time_offset` (s). `site`: its gravity, and the motion model of its platform. Returns the best,
    then those that differ from it at most epochs and are not much worse: the mirrors of a dipole,
    between which the motion must decide.
    """
    time = imu.time + time_offset
    turn = turn_from_gyro_at(time, imu.gyro_body, fixes.time)
    unary = np.minimum(fixes.cost - np.min(fixes.cost, axis=1, keepdims=True), LEAP_COST)
    unary = unary + _gravity_cost(fixes, imu, time, site)
    unary = np.where(np.isfinite(fixes.cost), unary, np.inf)
    link = _link_cost(fixes, turn, site)
    chains: list[Start] = []
    remaining = unary.copy()
    for _ in range(fixes.cost.shape[1]):
        chosen, cost = _viterbi(remaining, link)
        fresh = all(np.mean(chosen != other.chosen) > 0.5 for other in chains)
        if not fresh or (chains and cost > chains[0].cost + RIVAL_COST):
            break
        steps = link[np.arange(len(link)), chosen[:-1], chosen[1:]]
        leaps = int(np.sum(steps >= LEAP_COST))
        chains.append(replace(start_of(fixes, chosen, cost), leaps=leaps))
        remaining[np.arange(len(fixes)), chosen] = np.inf
        spent = ~np.isfinite(remaining).any(axis=1)
        remaining[spent] = unary[spent]
    return tuple(chains)


def start_of(fixes: Fixes, chosen: IntArray, cost: float) -> Start:
    """Return the chosen hypothesis of each epoch, shape (n,), as a start."""
    rows = np.arange(len(fixes))
    position = fixes.position_world[rows, chosen]
    return Start(
        states=Trajectory(
            time=fixes.time,
            world_from_body=fixes.world_from_body[rows, chosen],
            position_world=position,
            velocity_world=_velocity(fixes.time, position),
        ),
        phase=fixes.phase[rows, chosen],
        chosen=chosen,
        cost=cost,
        determined=fixes.determined[rows, chosen],
    )


def _gravity_cost(fixes: Fixes, imu: ImuSamples, time: Array, site: Site) -> Array:
    motion = site.platform.motion
    mean_body = mean_about(time, imu.accel_body, fixes.time, motion.accel_span)
    mean_world = (fixes.world_from_body @ mean_body[:, None, :, None])[..., 0]
    error = mean_world - [0.0, 0.0, site.gravity]
    # The mean is taken in rotating body axes: little information, enough against a mirrored pose.
    return np.minimum(np.sum(error**2, axis=-1) / motion.accel_sigma**2, LEAP_COST)


def _link_cost(fixes: Fixes, turn: Array, site: Site) -> Array:
    """Return the cost of each pair of hypotheses at successive epochs, shape (n-1, h, h)."""
    dt = np.diff(fixes.time)
    step = matrices(product(inverse(turn[:, :-1]), turn[:, 1:]))
    expected = fixes.world_from_body[:-1] @ step[:, None]
    between = np.swapaxes(expected[:, :, None], -1, -2) @ fixes.world_from_body[1:, None]
    angle = Rotation.from_matrix(between.reshape(-1, 3, 3)).magnitude()
    angle = angle.reshape(between.shape[:-2])
    jump = fixes.position_world[1:, None] - fixes.position_world[:-1, :, None]
    spread = (site.platform.motion.speed_sigma * dt) ** 2 + POSITION_SIGMA**2
    rotated = (site.platform.imu.gyro_bias_sigma * dt) ** 2 + ROTATION_SIGMA**2
    cost = np.sum(jump**2, axis=-1) / spread[:, None, None] + angle**2 / rotated[:, None, None]
    return np.minimum(cost, LEAP_COST)


def _viterbi(unary: Array, link: Array) -> tuple[IntArray, float]:
    total = unary[0]
    back = np.zeros((len(unary), unary.shape[1]), dtype=np.int64)
    for k in range(1, len(unary)):
        step = total[:, None] + link[k - 1]
        back[k] = np.argmin(step, axis=0)
        total = np.min(step, axis=0) + unary[k]
    chosen = np.empty(len(unary), dtype=np.int64)
    chosen[-1] = int(np.argmin(total))
    for k in range(len(unary) - 1, 0, -1):
        chosen[k - 1] = back[k, chosen[k]]
    return chosen, float(np.min(total))


def _velocity(time: Array, position: Array) -> Array:
    if len(time) < 3:
        return np.zeros_like(position)
    return np.gradient(position, time, axis=0)


def start_phases(calibration: Calibration, time: Array, phase: Array) -> Calibration:
    """Return the calibration with drive phase and drift estimated from single-epoch phases.

    `time` (n,). `phase` (n, channels): relative to the calibration's own (rad).
    """
    new_phase, drift = calibration.phase.copy(), calibration.drift.copy()
    elapsed = time - calibration.reference_time
    start = 0
    for i, beacon in enumerate(calibration.site.beacons):
        rows = slice(start, start + len(beacon.tones))
        start = rows.stop
        if beacon.synchronised:
            continue
        frequency = float(beacon.tone_frequencies_hz[0])
        drift[i] += _dominant_drift(
            elapsed, phase[:, rows.start], frequency, calibration.site.relative_clock
        )
        rate = 2.0 * np.pi * beacon.tone_frequencies_hz * (drift[i] - calibration.drift[i])
        remaining = np.exp(1j * (phase[:, rows] - elapsed[:, None] * rate))
        new_phase[rows] += np.angle(np.sum(remaining, axis=0))
    one = new_phase[: start or None]
    return replace(calibration, phase=of_all_sensors(calibration.site, one), drift=drift)


def _dominant_drift(elapsed: Array, phase: Array, frequency_hz: float, clock: ClockModel) -> float:
    """Return the most probable clock error; phases of a weak beacon alone fit any equally well."""
    reach = max(float(np.ptp(elapsed)), 1e-3)
    largest = clock.drift_largest
    number = int(np.clip(16.0 * largest * frequency_hz * reach, 3, 20_000)) | 1
    drifts = np.linspace(-largest, largest, number)
    turns = 2.0 * np.pi * frequency_hz * elapsed
    share = np.array([abs(np.mean(np.exp(1j * (phase - drift * turns)))) for drift in drifts])
    steady = np.exp(1j * (phase - drifts[np.argmax(share)] * turns))
    scatter = steady - np.mean(steady)
    count = effective_number(np.stack([scatter.real, scatter.imag], axis=1))
    likelihood = count * np.log1p(MIN_SCATTER - share**2)
    return float(drifts[np.argmin(likelihood + (drifts / clock.drift_sigma) ** 2)])
