"""Online orientation: a state at every inertial sample, without delay."""

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.errors import InputError
from magfusion.estimation.data_checks.stamps import GAP
from magfusion.estimation.graph.state import ACCEL_BIAS as OWN_ACCEL_BIAS
from magfusion.estimation.graph.state import GYRO_BIAS as OWN_GYRO_BIAS
from magfusion.estimation.graph.state import MOTION, POSITION, ROTATION, VELOCITY
from magfusion.estimation.online_integrity.judgement import JudgedState, Judgement
from magfusion.estimation.orientation.filter import OrientationFilter
from magfusion.estimation.orientation.layout import ACCEL_BIAS, GYRO_BIAS, TURN, Orientation
from magfusion.estimation.orientation.remarks import current_findings, doubts, position_open
from magfusion.estimation.orientation.stretch import (
    STEP,
    OrientationStretch,
    corrected_rate,
    stretches,
)
from magfusion.model.field import skew
from magfusion.model.parameters import initial_calibration
from magfusion.model.site import MotionModel, Site
from magfusion.units import Array

WAIT = 0.3  # s; maximum wait of inertial samples for those of the field
ANYWHERE = 100.0  # m; one sigma of an undetermined position
TIMING = 0.002  # s; possible delay of the stamps of inertial samples


class OrientationNavigator:
    """Estimates the orientation at each sample as it arrives.

    `changed`: times of changes of the field that the model did not explain (s). Raises InputError
    where the site has no Earth field.
    """

    def __init__(self, site: Site) -> None:
        self.site = site
        self.filter = OrientationFilter(site)
        self.changed: list[float] = []
        self.distortion: dict[str, float] = {}
        self.rival_chi_square: float | None = None
        self._imu = np.zeros((0, 7))
        self._recent = np.zeros((0, 7))
        self._field = np.zeros((0, 4))
        self._edge = float("nan")
        self._last_field_time = -np.inf
        self._propagated: Array | None = None
        self._propagated_to = float("nan")
        self._pending: list[JudgedState] = []
        self._calibration = initial_calibration(site, 0.0)

    @property
    def started(self) -> bool:
        """Whether there is a state."""
        return self.filter.state is not None

    def add_imu(self, time: Array, gyro_body: Array, accel_body: Array) -> None:
        """Add inertial samples: times (k,), rates and specific forces (k, 3)."""
        stamps = time + self.site.platform.imu.time_offset
        rows = np.column_stack([stamps, gyro_body, accel_body])
        newest = self._newest_inertial
        _refuse_unsorted(rows[:, 0], newest, "inertial samples")
        self._imu = np.concatenate([self._imu, rows])
        self._propagate(rows)
        self._advance()

    def add_magnetometer(self, time: Array, measured_sensor: Array) -> None:
        """Add raw samples of the magnetometer: times (k,), fields (k, 3) (T)."""
        _refuse_unsorted(time, self._last_field_time, "samples of the magnetometer")
        rows = np.column_stack([time, measured_sensor])
        self._field = np.concatenate([self._field, rows])
        self._last_field_time = float(time[-1])
        self._advance()

    def take(self) -> list[JudgedState]:
        """Return the states made since the last call, one per sample."""
        built, self._pending = self._pending, []
        return built

    @property
    def _newest_inertial(self) -> float:
        if len(self._imu):
            return float(self._imu[-1, 0])
        return -np.inf if np.isnan(self._edge) else self._edge

    def _advance(self) -> None:
        while len(self._imu) > 1:
            first = float(self._imu[0, 0])
            broken = not np.isnan(self._edge) and first - self._edge > GAP
            start = first if np.isnan(self._edge) or broken else self._edge
            end, newest = start + STEP, float(self._imu[-1, 0])
            if newest <= end or (self._last_field_time < end and newest < end + WAIT):
                return
            count = max(int(np.searchsorted(self._imu[:, 0], end + 1e-9, side="right")), 1)
            self._work_in(count, float("nan") if broken else self._edge)

    def _work_in(self, count: int, begin: float) -> None:
        rows, self._imu = self._imu[:count], self._imu[count:]
        motion = self.site.platform.motion
        recent = np.concatenate([self._recent, rows])
        self._recent = recent[recent[:, 0] >= rows[-1, 0] - motion.rest_span]
        rests = np.full(len(rows), _rested(self._recent, motion))
        parts = (rows[:, 0], rows[:, 1:4], rows[:, 4:7], rests, self._field[:, 0])
        for stretch in stretches(*parts, self._field[:, 1:], begin):
            self._take(stretch)
        self._edge = float(rows[-1, 0])
        self._field = self._field[np.searchsorted(self._field[:, 0], self._edge, side="right") :]

    def _take(self, stretch: OrientationStretch) -> None:
        update = self.filter.take(stretch)
        if update.changed:
            self.changed.append(update.state.time)
        first = self._propagated is None
        self._propagated, self._propagated_to = update.state.world_from_body, update.state.time
        if first:
            self._store(update.state, update.state.world_from_body, update.state.time)
        for row in self._imu:
            self._turn(row)

    def _propagate(self, rows: Array) -> None:
        if self._propagated is None or self.filter.state is None:
            return
        for row in rows:
            self._turn(row)
            assert self._propagated is not None
            self._store(self.filter.state, self._propagated, float(row[0]))

    def _turn(self, row: Array) -> None:
        state = self.filter.state
        assert state is not None
        assert self._propagated is not None
        rate = corrected_rate(state, row[1:4], row[4:7])
        step = rate * min(float(row[0]) - self._propagated_to, GAP)
        self._propagated = self._propagated @ Rotation.from_rotvec(step).as_matrix()
        self._propagated_to = float(row[0])

    def _store(self, state: Orientation, attitude: Array, time: float) -> None:
        cov = motion_cov(state, attitude, time - state.time, self.site.platform.imu.gyro_noise)
        findings = (*doubts(cov[ROTATION, ROTATION], attitude), position_open())
        start_time = self.changed[-1] if self.changed else None
        findings += current_findings(self.filter, time, start_time)
        self._pending.append(
            JudgedState(
                time=time,
                world_from_body=attitude,
                position_world=np.zeros(3),
                velocity_world=state.velocity_world,
                accel_bias_body=state.accel_bias,
                gyro_bias_body=state.gyro_bias,
                calibration=self._calibration,
                cov=cov,
                judgement=Judgement(findings),
            )
        )


def motion_cov(state: Orientation, attitude: Array, ahead: float, gyro_noise: float) -> Array:
    """Return the covariance of a motion, shape (15, 15), in the layout of `State`.

    `attitude` (3, 3): world_from_body, propagated by ``ahead`` (s) from the state.
    """
    cov = np.zeros((MOTION, MOTION))
    turn = state.cov[TURN, TURN] + gyro_noise**2 * max(ahead, 0.0) * np.eye(3)
    cov[ROTATION, ROTATION] = attitude.T @ turn @ attitude
    cov[POSITION, POSITION] = ANYWHERE**2 * np.eye(3)
    by_motion = np.hstack([-skew(state.velocity_world), np.eye(3)])  # the speed turns with it
    cov[VELOCITY, VELOCITY] = by_motion @ state.cov[:6, :6] @ by_motion.T
    cov[OWN_ACCEL_BIAS, OWN_ACCEL_BIAS] = state.cov[ACCEL_BIAS, ACCEL_BIAS]
    cov[OWN_GYRO_BIAS, OWN_GYRO_BIAS] = state.cov[GYRO_BIAS, GYRO_BIAS]
    return cov


def _rested(recent: Array, motion: MotionModel) -> bool:
    """Return whether the platform has been still for the duration of a rest."""
    if len(recent) < 4 or recent[-1, 0] - recent[0, 0] < 0.9 * motion.rest_span:
        return False
    spread = np.var(recent[:, 1:], axis=0)
    quiet = np.sum(spread[:3]) < motion.rest_gyro**2
    return bool(quiet and np.sum(spread[3:]) < motion.rest_accel**2)


def _refuse_unsorted(time: Array, newest: float, what: str) -> None:
    if len(time) and (time[0] <= newest or np.any(np.diff(time) <= 0.0)):
        raise InputError(
            f"{what} go back in time (to {float(np.min(time)):.6f} s after {newest:.6f} s); send"
            " them in order, each once"
        )
