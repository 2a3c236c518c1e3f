"""The estimator of a navigator: started at a state, propagated, and updated epoch by epoch."""

import numpy as np

from magfusion.errors import InputError
from magfusion.estimation.data_checks.freeze import imu_remarks
from magfusion.estimation.data_checks.inertial_noise import measured_noise, with_white_noise
from magfusion.estimation.graph.process_noise import calibration_process_noise
from magfusion.estimation.graph.propagation import Propagated, propagate
from magfusion.estimation.graph.same_epoch import SAME_TIME
from magfusion.estimation.graph.state import State
from magfusion.estimation.graph.user_factors import UserFactors
from magfusion.estimation.initialization.online import OnlineStart
from magfusion.estimation.online.ekf import ErrorStateFilter
from magfusion.estimation.online.epoch_update import EpochUpdate, Estimator
from magfusion.estimation.online.fixed_lag import SlidingWindow
from magfusion.estimation.online.navigator_settings import NavigatorSettings
from magfusion.estimation.online.propagated import PropagationStart
from magfusion.estimation.online.queue.arrivals import Arrivals
from magfusion.estimation.online.queue.inertial_stream import InertialStream
from magfusion.estimation.online_integrity.bank import SubsetBank
from magfusion.estimation.online_integrity.judgement import Judgement
from magfusion.model.parameters import dimension, inertial_blocks, placed
from magfusion.model.samples import FieldSamples
from magfusion.model.site import Site
from magfusion.units import Array


class RunningEstimate:
    """A filter or a sliding window with its propagation and its update.

    `estimator`: None before the first state. `estimated`, `blocks`: calibration parameters that are
    estimated, and all in the states' tangent. `process_noise`: of all blocks.
    """

    update: EpochUpdate
    _white: tuple[float, float]
    _early: list[UserFactors]

    def __init__(self, site: Site, settings: NavigatorSettings) -> None:
        self.site, self.settings = site, settings
        self.estimator: Estimator | None = None
        # In the estimator's tangent, estimated parameters precede considered ones.
        self.estimated, considered = settings.blocks(site)
        self.blocks = (*self.estimated, *placed(considered, dimension(self.estimated)))
        self._considered = dimension(considered)
        self._of_imu = self.blocks if inertial_blocks(self.blocks) else ()
        risk, bank = settings.risk, None
        # Without its only beacon nothing can be compared.
        if risk is not None and len(site.beacons) > 1:
            bank = SubsetBank(site, self.blocks, self._considered, risk)
        of_site = site, self.estimated, self.blocks
        self.update = EpochUpdate(*of_site, settings.earth, settings.lost_beyond, bank)
        self.process_noise = calibration_process_noise(site, self.blocks, self._considered)
        self._white = (site.platform.imu.gyro_noise, site.platform.imu.accel_noise)
        self._early = []

    @property
    def time(self) -> float:
        """Time of the newest estimate (s); minus infinity before the first."""
        return -np.inf if self.estimator is None else self.estimator.state.time

    def begin(self, start: OnlineStart, imu: InertialStream) -> None:
        """Start the estimator at a first state, with the white noise that the samples show."""
        model, _ = measured_noise(imu.measured(), self.site.platform.imu)
        self._white = (model.gyro_noise, model.accel_noise)
        self.start_at(start.state)

    def start_at(self, state: State) -> None:
        """Start the estimator at a state."""
        if self.settings.estimator == "ekf":
            self.estimator = ErrorStateFilter(state, self.blocks, self._considered)
            return
        window = SlidingWindow(
            state,
            self.blocks,
            self.settings.lag,
            self.process_noise,
            self._considered,
            with_white_noise(self.site, *self._white),
        )
        window.waiting, self._early = self._early, []
        self.estimator = window

    def process(
        self, time: float, samples: FieldSamples | None, arrived: Arrivals
    ) -> tuple[Propagated, Judgement]:
        """Propagate to a time (s) and process its measurements; return prediction and judgement.

        `samples`: of this epoch; None where it may have a window.
        """
        assert self.estimator is not None
        before = self.estimator.state
        if samples is None:
            arrived.fill_silence(before, time)
        predicted = self._propagated(before, time, arrived.imu)
        judgement = self.update.process_epoch(self.estimator, arrived, predicted, samples)
        gap_bridged = predicted.gap_bridged
        of_imu = imu_remarks(arrived.imu.frozen_since, before.time, time, gap_bridged=gap_bridged)
        return predicted, judgement.with_findings(*of_imu, *arrived.remarks)

    def _propagated(self, state: State, time: float, imu: InertialStream) -> Propagated:
        begin, end = state.time - imu.offset, time - imu.offset
        noise, site = self.process_noise, with_white_noise(self.site, *self._white)
        clock, blind = (imu.offset, noise, imu.usual), imu.is_filled(begin, end)
        return propagate(
            state, imu.filled(begin, end), time, site, *clock, self._of_imu, blind=blind
        )

    def propagation_start(self, imu: InertialStream) -> PropagationStart:
        """Return the newest estimate, to be propagated by every inertial sample."""
        assert self.estimator is not None
        assert imu.usual is not None
        return PropagationStart(
            self.estimator.state,
            with_white_noise(self.site, *self._white),
            self.blocks,
            self.process_noise,
            imu.offset,
            imu.usual,
        )

    # GTSAM factors of the user

    def check_factor_times(self, time: Array) -> None:
        """Refuse factors on states (s) that the estimator does not have and will not make."""
        name = ", ".join(f"{t:g}" for t in time)
        if len(time) == 0 or np.any(np.diff(time) < 2.0 * SAME_TIME):
            raise InputError(
                f"a factor is at times ({name}) that are none or too close; give one for each state"
            )
        coming = self.is_to_come(time)
        if self.settings.estimator == "ekf" and not coming:
            raise InputError(
                f"a factor is at {name} s, but the filter has only the state of one time, from now"
                " on; use the smoother, or magfusion.smooth(factors=...)"
            )
        if not coming and self._of_imu:
            raise InputError(
                f"a factor is at {name} s, but parameters of the IMU allow only one time to come;"
                " use magfusion.smooth(factors=...)"
            )
        window, lag = self.estimator, self.settings.lag
        oldest = window.oldest if isinstance(window, SlidingWindow) else -np.inf
        if time[-1] - time[0] > lag or time[0] < oldest - SAME_TIME:
            raise InputError(
                f"a factor is at {name} s, not within the smoother's lag of {lag:g} s;"
                " increase NavigatorSettings.lag, or use magfusion.smooth(factors=...)"
            )

    def is_to_come(self, time: Array) -> bool:
        """Return whether factors are on the state of one time (s) after the newest estimate."""
        return len(time) == 1 and bool(time[0] > self.time)

    def add_factors(self, factors: UserFactors) -> None:
        """Add checked factors on states of the smoother's window."""
        if self.estimator is None:
            self._early.append(factors)
        elif isinstance(self.estimator, SlidingWindow):
            self.estimator.waiting = [*self.estimator.waiting, factors]
