"""Preparation of a log for smoothing: demodulated, with a new or an earlier start."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from magfusion.errors import EstimationError
from magfusion.estimation.batch.chain import Start
from magfusion.estimation.batch.gap_bridging import bridge_gaps
from magfusion.estimation.batch.hypothesis_selection import select_hypothesis
from magfusion.estimation.batch.log_graph import PreprocessedLog
from magfusion.estimation.batch.offline import begin, propagated_states, unbiased, with_rest_bias
from magfusion.estimation.batch.settings import SmootherSettings
from magfusion.estimation.data_checks.detection import detected, only
from magfusion.estimation.demodulation.demodulation import Demodulation, demodulated
from magfusion.estimation.demodulation.several_demodulation import demodulated_several
from magfusion.estimation.graph.measurement import Measurement
from magfusion.estimation.graph.same_epoch import at_epochs
from magfusion.estimation.graph.user_factors import UserFactors
from magfusion.estimation.measurements.aiding_samples import aiding_measurements
from magfusion.estimation.measurements.fixed_roll import without_roll
from magfusion.estimation.measurements.zero_velocity import quiet_before
from magfusion.estimation.snapshot.fix import Fixes
from magfusion.model.one_axis import roll_is_open
from magfusion.model.parameters import Calibration, initial_calibration
from magfusion.model.progress import Report
from magfusion.model.samples import FieldSamples, ImuSamples, Log, StaticFields
from magfusion.model.site import MotionModel, Site
from magfusion.model.trajectory import Trajectory
from magfusion.receiver.cycles import whole_cycles
from magfusion.receiver.slots import has_schedule
from magfusion.units import Array

MAX_STEP = 5.0  # s; interval of states without any field
REST_STEP = 2.0  # s; the same at rest, where each has a zero velocity
SPARSE = 2.5  # times the usual interval; a longer one is a gap


@dataclass(frozen=True, eq=False)
class WarmStart:
    """Start of a log that was smoothed before."""

    states: Trajectory  # at all its epochs, without covariance
    declared: Calibration  # its declared calibration, before it was smoothed
    start: Start  # from which the states were estimated
    # rival_chi_square, rival: as of `magfusion.estimation.batch.batch.Smoothed`
    rival_chi_square: float | None = None
    rival: Trajectory | None = None


class _Demodulated(NamedTuple):
    """A log before it has a start, with the times of its states (s), and other measurements."""

    log: Log
    demodulation: Demodulation
    samples: FieldSamples
    static: StaticFields | None
    time: Array
    calibration: Calibration
    measured: tuple[tuple[Array, Measurement], ...]
    user: UserFactors | None


def preprocess(log: Log, site: Site, settings: SmootherSettings, report: Report) -> PreprocessedLog:
    """Return a log with the start that the motion selects.

    Raises InputError where the log has no usable data; EstimationError where it has too few epochs.
    """
    report("demodulating", 0, settings.max_iterations + 3)
    detected = _demodulated(log, site, settings)
    report("finding a start", 1, settings.max_iterations + 3)
    imu, offset = detected.log.imu, detected.calibration.time_offset
    beginnings = begin(detected.samples, detected.static, detected.log, detected.calibration)
    imu = unbiased(imu, detected.samples, offset)
    starts = [
        _with_start(
            detected,
            settings,
            WarmStart(
                with_rest_bias(
                    _one_roll(
                        propagated_states(beginning.states, imu, offset, detected.time),
                        site,
                        signed=detected.samples.signed,
                    ),
                    detected.log.imu,
                    detected.calibration,
                ),
                beginning.declared,
                beginning.start,
            ),
            beginning.fixes,
        )
        for beginning in beginnings
    ]
    return bridge_gaps(select_hypothesis(starts))


def _one_roll(states: Trajectory, site: Site, *, signed: bool) -> Trajectory:
    """Return states with the roll of a platform that does not roll, where it is unobservable."""
    if not roll_is_open(site):
        return states
    return without_roll(states, site, signed=signed)


def restore_preprocessed(
    log: Log, site: Site, settings: SmootherSettings, known: WarmStart
) -> PreprocessedLog:
    """Return a log that was smoothed before, with its states of then."""
    detected = _demodulated(log, site, settings)
    rows = np.isin(known.states.time, detected.time)
    if not np.sum(rows) == len(detected.time):
        raise EstimationError(f"log {log.name} differs from the one that was smoothed before")
    own = {k: v[rows] for k, v in vars(known.states).items() if v is not None}
    at_start = replace(known, states=Trajectory(**own))
    ready = bridge_gaps(_with_start(detected, settings, at_start, None))
    if np.array_equal(ready.states.time, known.states.time):
        ready = replace(ready, states=known.states)
    return ready


def _demodulated(log: Log, site: Site, settings: SmootherSettings) -> _Demodulated:
    loose = settings.coupling == "loose"
    received = demodulated
    if log.waveforms:
        received = demodulated_several
    demodulation = received(log, site, settings.lockin)
    samples = demodulation.fields
    if loose and has_schedule(site):
        samples = whole_cycles(samples, log.imu, site)
    if len(samples) < 2:
        raise EstimationError(
            f"log {log.name} has {len(samples)} field epoch; at least 2 are needed"
        )
    begin_imu = float(log.imu.time[0])
    calibration = initial_calibration(site, float(np.mean(samples.time)), begin_imu)
    static = None
    log = replace(log, imu=calibration.on_log_rate(log.imu))
    if settings.earth:
        static, samples = demodulation.static(calibration), only(samples, detected(samples))
    between = _in_gaps(samples, log.imu, calibration.time_offset, site.platform.motion)
    measured = (*settings.measurements, *_aiding(log, calibration, samples, settings.loss))
    time = np.union1d(samples.time, between)
    if demodulation.close is not None and not loose:
        time = np.union1d(time, demodulation.close.windows.centre)
    at = []
    for stamps, measurement in measured:
        stamps = at_epochs(stamps, time)
        time = np.union1d(time, stamps)
        at.append((stamps, measurement))
    user = settings.factors
    if user is not None:
        user = replace(user, time=at_epochs(user.time, time))
        time = np.union1d(time, user.time)
    return _Demodulated(log, demodulation, samples, static, time, calibration, tuple(at), user)


def _aiding(
    log: Log, calibration: Calibration, samples: FieldSamples, loss: str | None
) -> tuple[tuple[Array, Measurement], ...]:
    """Return what the aiding sensors measured while there are states."""
    if not log.aiding:
        return ()
    imu = replace(log.imu, time=log.imu.time + calibration.time_offset)
    span = float(samples.time[0]), float(imu.time[-1])
    return aiding_measurements(log.aiding, calibration.site, imu, span, loss)


def _with_start(
    selected: _Demodulated, settings: SmootherSettings, begun: WarmStart, fixes: Fixes | None
) -> PreprocessedLog:
    loose = settings.coupling == "loose"
    blocks, considered = ((), ()) if loose else settings.blocks(selected.calibration.site)
    return PreprocessedLog(
        demodulation=selected.demodulation,
        samples=selected.samples,
        static=selected.static,
        epoch=np.searchsorted(selected.time, selected.samples.time),
        fixes=fixes if loose else None,
        start=begun.start,
        states=begun.states,
        declared=begun.declared,
        blocks=blocks,
        considered=considered,
        loss=settings.loss,
        others=selected.measured,
        user=selected.user,
        rival_chi_square=begun.rival_chi_square,
        rival=begun.rival,
    )


def _in_gaps(
    samples: FieldSamples, imu: ImuSamples, time_offset: float, motion: MotionModel
) -> Array:
    """Return the times of states where no field is measured (s), more where the IMU is quiet.

    `samples`: measured; there are none between whole rests, nor within them. `time_offset` (s).
    """
    time = samples.time
    step, out = np.diff(time), [np.zeros(0)]
    usual = 0.0 if samples.of_rests else SPARSE * float(np.median(step))
    for k in np.flatnonzero(step > max(MAX_STEP, usual)):
        inner = np.linspace(time[k], time[k + 1], int(np.ceil(step[k] / REST_STEP)) + 1)[1:-1]
        every = np.arange(1, len(inner) + 1) % int(MAX_STEP / REST_STEP) == 0
        out.append(inner[every | quiet_before(imu, inner - time_offset, motion)])
    return np.concatenate(out)
