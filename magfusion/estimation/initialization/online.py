"""The first state of an online estimator, smoothed from the data received so far."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from dataclasses import fields as fields_of
from typing import NamedTuple

import numpy as np

from magfusion.errors import EstimationError, InputError
from magfusion.estimation.batch.batch import Smoothed, SmootherSettings, smooth
from magfusion.estimation.batch.hypothesis_selection import AMBIGUOUS_CHI_SQUARE
from magfusion.estimation.batch.log_graph import overlap
from magfusion.estimation.batch.settings import EstimatorSettings
from magfusion.estimation.data_checks.disturbing_lines import with_disturbing_lines
from magfusion.estimation.data_checks.stream_buffer import Buffer
from magfusion.estimation.demodulation.beacon_selection import may_wait, select_strongest
from magfusion.estimation.demodulation.demodulation import demodulated
from magfusion.estimation.demodulation.separate_demodulation import each_alone
from magfusion.estimation.demodulation.several_demodulation import demodulated_several, same_windows
from magfusion.estimation.graph.state import POSITION, ROTATION, State
from magfusion.estimation.initialization.among_many import among_all, score_among_all
from magfusion.estimation.initialization.handover import last_state
from magfusion.estimation.integrity.correction import Correction, corrections
from magfusion.estimation.integrity.fault_isolation import diagnosed
from magfusion.estimation.integrity.judge import judged_with_score
from magfusion.estimation.integrity.magnetometer_exclusion import agreed_smoothed
from magfusion.estimation.integrity.released_fault import ReleasedFault
from magfusion.estimation.integrity.score import Score
from magfusion.model.detection_range import are_many
from magfusion.model.marks import Marks
from magfusion.model.samples import FieldSamples, ImuSamples, Log, StaticFields, Waveform
from magfusion.model.site import Site
from magfusion.model.trust import Finding, Trust, Verdict
from magfusion.receiver.cycles import cycle_of, cycles, joins
from magfusion.receiver.joint import joint_settings
from magfusion.receiver.receivers import receiver_of, windowed
from magfusion.receiver.slots import has_schedule
from magfusion.receiver.turn import on_clock, turn_of
from magfusion.receiver.windows import LockinSettings
from magfusion.units import Array

MIN_DIAGNOSED = 5.0  # s; of data, about a whole start: in less, every cause is as likely
START_RATE_HZ = 20.0  # of the cycles of a slotted tracker that a start uses


@dataclass(frozen=True, eq=False)
class OnlineStart:
    """Start of an online estimator."""

    state: State
    waveform: Waveform | None  # samples for the receiver's start; None where phasors are received
    rival_chi_square: float | None  # chi square of the rival above that of this start
    trust: Trust = field(default_factory=Trust)  # test results of the smoothed beginning
    score: Score | None = None  # of the estimates of the smoothed beginning
    # turn, shift: increase of the uncertainty of attitude (rad) and position (m), one sigma an axis
    turn: float = 0.0
    shift: float = 0.0
    # receiver settings where undeclared lines are to be fitted
    extra_lines: LockinSettings | None = None
    # the same of several magnetometers, by their names
    lines: Mapping[str, LockinSettings] = field(default_factory=dict)
    # variance of estimated parameters, by name, due to considered ones
    shared_offsets: Mapping[str, Array] = field(default_factory=dict)
    # degrees of freedom of the estimated noise of each beacon's fields
    noise_freedom: Mapping[str, float] = field(default_factory=dict)
    # magnetometers not used for the start, as they are inconsistent with the others
    excluded: tuple[str, ...] = ()
    # their findings, or that magnetometers are inconsistent and the cause is ambiguous
    findings: tuple[Finding, ...] = ()
    # what may be wrong with the site, the most likely first
    corrections: tuple[Correction, ...] = ()

    @property
    def ambiguous(self) -> bool:
        """Whether a mirrored start explains the data nearly as well."""
        rival = self.rival_chi_square
        return rival is not None and rival < AMBIGUOUS_CHI_SQUARE


@dataclass(frozen=True)
class NoStart:
    """Reason why the data give no state yet."""

    reason: str = "Record longer."  # one or more sentences
    # test results of the smoothed beginning, where these are the reason
    trust: Trust = field(default_factory=Trust)
    corrections: tuple[Correction, ...] = ()  # as of `OnlineStart`


def find_online_start(
    site: Site,
    imu: ImuSamples,
    waveform: Buffer,
    fields: list[FieldSamples],
    static: list[StaticFields],
    until: float,
    settings: EstimatorSettings,
    marks: Marks | None = None,
    waveforms: Mapping[str, Waveform] | None = None,
    *,
    diagnose: bool = True,
) -> OnlineStart | NoStart:
    """Return the state at the last epoch before a time; or the reason why there is none.

    Parameters
    ----------
    fields : list of FieldSamples
        One epoch each; used where present.
    static : list of StaticFields
        Of the same epochs as ``fields``.
    until : float
        (s)
    marks : Marks, optional
        Times at which each coil was driven, where the site's slots are marked.
    waveforms : mapping, optional
        The samples of several magnetometers until then, each on its own clock.
    diagnose : bool
        Whether to look for mistakes of the site where a start is doubtful.
    """
    if not fields:
        receiver = receiver_of(site, settings.lockin)
        receiver.check()
        if settings.earth:
            windowed(receiver)
    wave = Waveform(*waveform.rows(), marks, site.platform.magnetometer.axes)
    whole = [s for s in fields if s.time[0] <= until]
    several = {} if waveforms is None else waveforms
    log = Log(
        name="the beginning",
        epoch_ns=0,
        source="online",
        imu=imu,
        recorded_imu=_recorded(site, imu),
        clock_rate=site.platform.magnetometer.clock_rate,
        clock_offset=site.platform.magnetometer.clock_offset,
        waveform=None if fields or several else wave.rows(wave.time <= until),
        fields=FieldSamples.joined(whole) if whole else None,
        static=_joined_static(static, whole) if whole and static else None,
        inertial=site.platform.inertial,
        waveforms=several,
    )
    try:
        result = _smoothed(log, site, settings)
    except (EstimationError, InputError) as error:
        reason = f"{error}."
    except (RuntimeError, np.linalg.LinAlgError):
        reason = "The measurements do not determine the motion in one direction."
    else:
        given = result.trust, result.causes
        possible = _possible(log, site, settings, *given) if diagnose else ()
        if result.trust.verdict is Verdict.FAILED:
            return NoStart(result.trust.reasons[0].text, result.trust, possible)
        return replace(_start_of(result, log, site, settings.lockin), corrections=possible)
    failed = Trust((Finding("no_solution", reason, Verdict.FAILED),))
    return NoStart(reason, corrections=_possible(log, site, settings, failed) if diagnose else ())


def _recorded(site: Site, imu: ImuSamples) -> ImuSamples | None:
    """Return inertial samples with the errors that the site declares; None if it has none."""
    intrinsics = site.platform.imu_intrinsics
    if intrinsics is None:
        return None
    return ImuSamples(imu.time, *intrinsics.recorded(imu.gyro_body, imu.accel_body))


def _possible(
    log: Log,
    site: Site,
    settings: EstimatorSettings,
    trust: Trust,
    causes: tuple[ReleasedFault, ...] = (),
) -> tuple[Correction, ...]:
    """Return what may be wrong with the site, the most likely first."""
    span = float(np.ptp(log.imu.time)) if len(log.imu) else 0.0
    if trust.verdict is Verdict.TRUSTWORTHY or span < MIN_DIAGNOSED or site.platform.further:
        return ()
    return tuple(
        corrections(site, trust.reasons, causes, diagnosed(log, site, trust, settings.lockin))
    )


class _Beginning(NamedTuple):
    """The smoothed beginning."""

    # log, site: without the excluded magnetometers
    log: Log
    site: Site
    # result, honest: of the estimator, and with sigmas increased by the tests
    result: Smoothed
    honest: Smoothed
    state: State
    trust: Trust
    score: Score | None
    excluded: tuple[Finding, ...]  # reasons of excluded magnetometers
    causes: tuple[ReleasedFault, ...]  # as of `magfusion.estimation.integrity.judge.JudgedResult`


def _smoothed(log: Log, site: Site, settings: EstimatorSettings) -> _Beginning:
    """Smooth the beginning and test it."""
    if log.waveforms and are_many(site):  # selected by detection
        log = replace(log, fields=demodulated_several(log, site, settings.lockin).fields)
    elif may_wait(site) and log.fields is None and not _needs_samples(site, settings):
        # All tones together, so that those left for later do not leak into the others.
        log = replace(log, fields=demodulated(log, site, settings.lockin).fields, waveform=None)
    if log.waveform is not None and has_schedule(site) and joins(site, log.waveform.marks):
        log = _of_cycles(log, log.waveform, site, settings)
    requested = {f.name: getattr(settings, f.name) for f in fields_of(EstimatorSettings)}
    how = SmootherSettings(loss="huber", **requested)
    log, some = select_strongest(log, site)
    log, remaining, result, excluded = agreed_smoothed(smooth(log, some, how), log, some, how)
    honest, trust, score, causes = judged_with_score(result, log, site)
    state = last_state(result, result.considered)
    if result.calibration.site.undetected or site.platform.further:
        state, score = _among_all(state, score, result, site, settings)
    return _Beginning(log, remaining, result, honest, state, trust, score, excluded, causes)


def _needs_samples(site: Site, settings: EstimatorSettings) -> bool:
    """Return whether phasors alone do not contain what an estimator uses of the samples."""
    return settings.earth or joint_settings(site, settings.lockin) is not None


def _start_of(
    estimate: _Beginning, detected: Log, site: Site, given: LockinSettings | None
) -> OnlineStart:
    """Return the start from a smoothed beginning.

    `detected`: the recorded beginning, of all magnetometers. `given`: requested lock-in settings.
    """
    result = estimate.result
    kept = [sensor.name for sensor in estimate.site.platform.magnetometers]
    lined = given is not None and len(given.lines_hz) > 0
    others = given if lined else with_disturbing_lines(detected, site, given)
    return OnlineStart(
        estimate.state,
        detected.waveform,
        result.rival_chi_square,
        estimate.trust,
        estimate.score,
        *_wider(result, estimate.honest),
        None if others is given else others,
        _lines_of_each(detected, site, given) if detected.waveforms else {},
        {b.name: np.sum(result.calibration_response[b.columns] ** 2, 1) for b in result.blocks},
        noise_freedom(result),
        tuple(sensor.name for sensor in site.platform.magnetometers if sensor.name not in kept),
        estimate.excluded,
    )


def noise_freedom(result: Smoothed) -> dict[str, float]:
    """Return the degrees of freedom of each beacon's estimated noise; nothing if it is declared.

    The pose of an epoch takes six of its numbers, or half where they are few.
    """
    if not result.noise:
        return {}
    known = np.isfinite(result.residual).all(axis=2)
    channels = np.sum(known, axis=1, keepdims=True)
    each = np.where(known, 6.0 * (1.0 - 1.0 / np.maximum(channels, 2)), 0.0)
    shared = overlap(result.fields) if len(result.fields) > 1 else 1.0
    total: dict[str, float] = {}
    for (name, _), own in zip(result.fields.channels, np.sum(each, axis=0).tolist(), strict=False):
        total[name] = total.get(name, 0.0) + own / shared
    return {name: freedom for name, freedom in total.items() if freedom > 0.0}


def _among_all(
    state: State, score: Score | None, result: Smoothed, site: Site, settings: EstimatorSettings
) -> tuple[State, Score | None]:
    """Return a state and its score among all beacons and magnetometers, detected or not."""
    state = among_all(state, (*result.blocks, *result.considered), site, settings)
    if score is not None and result.calibration.site.undetected:
        score = score_among_all(score, result.blocks, site, settings)
    return state, score


def _lines_of_each(log: Log, site: Site, given: LockinSettings | None) -> dict[str, LockinSettings]:
    """Return the receiver settings of the magnetometers that have undeclared lines to be fitted."""
    lockin, result = same_windows(site, given), dict[str, LockinSettings]()
    for name, own, alone in each_alone(log, site):
        lined = with_disturbing_lines(own, alone, lockin)
        if lined is not None and lined is not lockin:
            result[name] = lined
    return result


def _of_cycles(log: Log, waveform: Waveform, site: Site, settings: EstimatorSettings) -> Log:
    """Return the phasors of a slotted tracker, one epoch per cycle, limited to those of a start."""
    receiver = receiver_of(site, settings.lockin)
    _, result = receiver.whole(waveform, log.imu)
    if site.platform.magnetometer.lacking:  # its slots remain separate epochs
        cycle = cycle_of(result, site)
        every = _every(int(cycle[-1]) + 1, result.time)
        return replace(log, waveform=None, fields=result.rows((cycle[-1] - cycle) % every == 0))
    known = on_clock(log.imu, site.platform.imu.time_offset)
    epochs = cycles(result, turn_of(known, site), site)
    every = _every(len(epochs), epochs.time)
    rows = slice((len(epochs) - 1) % every, None, every)
    return replace(log, waveform=None, fields=epochs.rows(rows))


def _every(count: int, time: Array) -> int:
    """Return the stride of the cycles that a start uses."""
    if count < 2:
        raise InputError("magnetometer: no two cycles of time slots are usable; record longer")
    return max(1, int(count / (START_RATE_HZ * float(np.ptp(time)) + 1.0)))


def _wider(result: Smoothed, honest: Smoothed) -> tuple[float, float]:
    """Return the tests' increase of the last state's sigmas of rotation and position."""
    assert result.states.pose_cov is not None
    assert honest.states.pose_cov is not None
    added = honest.states.pose_cov[-1] - result.states.pose_cov[-1]
    largest = [np.max(np.linalg.eigvalsh(added[part, part])) for part in (ROTATION, POSITION)]
    turn, shift = np.sqrt(np.maximum(largest, 0.0))
    return float(turn), float(shift)


def _joined_static(parts: list[StaticFields], fields: list[FieldSamples]) -> StaticFields | None:
    """Return the static fields of the epochs; None where an epoch has none."""
    known = {float(part.time[0]): part for part in parts}
    wanted = [known.get(float(s.time[0])) for s in fields]
    result = [part for part in wanted if part is not None]
    if len(result) < len(wanted):
        return None
    return StaticFields(
        time=np.concatenate([p.time for p in result]),
        measured_sensor=np.concatenate([p.measured_sensor for p in result]),
        cov=np.concatenate([p.cov for p in result]),
    )
