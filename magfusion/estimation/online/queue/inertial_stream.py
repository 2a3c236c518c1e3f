"""Inertial samples as they arrive: their clock, a sensor that freezes, and substitutes in gaps."""

import numpy as np

from magfusion.estimation.data_checks.freeze import Freeze
from magfusion.estimation.data_checks.stream_buffer import Buffer
from magfusion.estimation.graph.preintegration import RATE_SPAN
from magfusion.estimation.graph.state import MOTION, State
from magfusion.estimation.online.queue.imu_gap_filler import ImuGapFiller
from magfusion.model.parameters import CLOCK_RATE, TIME_OFFSET, Block
from magfusion.model.samples import ImuSamples
from magfusion.units import Array

OFFSET_STALE = 1e-4  # s; at a radian a second, six thousandths of a degree


class InertialStream:
    """The inertial samples of a platform, each by its own stamp."""

    buffer: Buffer  # rates and specific forces of the body
    filler: ImuGapFiller  # substitutes for missing samples
    offset: float  # added to the stamps for the log's clock (s)
    usual: float | None  # sampling interval (s), once there is a state
    frozen: int  # samples that are dropped because a sensor is frozen
    _gyro: Freeze
    _accel: Freeze

    def __init__(self, offset: float) -> None:
        self.buffer, self.filler = Buffer("imu", 6), ImuGapFiller()
        self.offset, self.usual = offset, None
        self.frozen, self._gyro, self._accel = 0, Freeze(), Freeze()

    def add(self, stamps: Array, gyro_body: Array, accel_body: Array, *, measured: bool) -> None:
        """Add samples; of measured ones those of a frozen sensor are left out."""
        rows = np.hstack([np.atleast_2d(gyro_body), np.atleast_2d(accel_body)])
        self.buffer.add(stamps, rows)
        if not measured:
            return
        for instrument, own in ((self._gyro, rows[:, :3]), (self._accel, rows[:, 3:])):
            for after, until in instrument.stretches(stamps, own):
                self.frozen += self.buffer.leave_out(after, until)

    @property
    def newest(self) -> float:
        """Newest stamp (s)."""
        return self.buffer.newest

    @property
    def reached(self) -> float:
        """Time of the newest sample on the log's clock (s)."""
        return self.buffer.newest + self.offset

    @property
    def frozen_since(self) -> float | None:
        """Time since which a sensor is frozen (s), on the log's clock; None where none is."""
        start_time = [one.frozen_since for one in (self._gyro, self._accel) if one.is_frozen]
        return min(start_time) + self.offset if start_time else None

    def measured(self, begin: float = -np.inf, end: float = np.inf) -> ImuSamples:
        """Return the samples between two stamps, with both neighbours."""
        time, rows = self.buffer.between(begin, end)
        return ImuSamples(time, rows[:, :3], rows[:, 3:])

    def filled(self, begin: float, end: float) -> ImuSamples:
        """Return the samples between two stamps, with substitutes for missing ones."""
        return self.filler.among(self.measured(begin, end), begin, end)

    def is_filled(self, begin: float, end: float) -> bool:
        """Return whether there are substitutes between two stamps."""
        return self.filler.covers(begin, end)

    def rate_body(self, time: float) -> Array:
        """Return the mean rate (3,) (rad/s) about a time (s) on the log's clock."""
        stamp = time - self.offset
        imu = self.filled(stamp - RATE_SPAN / 2, stamp + RATE_SPAN / 2)
        return np.asarray(np.mean(imu.gyro_body, axis=0)) if len(imu) else np.zeros(3)

    def begin(self, state: State) -> None:
        """Apply the time offset of a first state."""
        self.offset = float(state.calibration.imu_offset(np.array(state.time)))
        self.usual = float(np.median(np.diff(self.buffer.rows()[0])))

    def reapply_offset(self, state: State, blocks: tuple[Block, ...]) -> float:
        """Apply the time offset learnt since; return the change (s).

        A state belongs to its stamp on the IMU's clock; with another offset the same state is a
        little earlier or later (s) on the log's clock.
        """
        lag = float(state.calibration.imu_offset(np.array(state.time))) - self.offset
        if abs(lag) < OFFSET_STALE:
            return 0.0
        by_state, run = np.zeros(len(state.cov)), state.time - state.calibration.imu_begin
        for parameter, _, columns, _ in blocks:
            if parameter == TIME_OFFSET:
                by_state[MOTION + columns.start] = 1.0
            elif parameter == CLOCK_RATE:
                by_state[MOTION + columns.start] = run
        if not np.any(by_state):
            return 0.0
        sigma = float(np.sqrt(by_state @ state.cov @ by_state))
        if abs(lag) < 2.0 * sigma:
            return 0.0
        self.offset += lag
        return lag

    def discard_before(self, time: float, reach: float) -> None:
        """Keep only the samples from so long before a state (s) on."""
        self.buffer.discard_before(time - reach, time - self.offset - 1.0)
        self.filler.discard_before(time - reach)
