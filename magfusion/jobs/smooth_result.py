"""The result of a smoothed log: assessed, with its figures, and written."""

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from magfusion.estimation.batch.batch import Smoothed, SmootherSettings, smooth
from magfusion.estimation.batch.self_survey import Placement
from magfusion.estimation.integrity.aiding_causes import aiding_diagnosis, compared_smoothed
from magfusion.estimation.integrity.change_detection import changed_beacon, explained_throughout
from magfusion.estimation.integrity.correction import (
    Correction,
    continued,
    corrections,
    spread_with_rivals,
)
from magfusion.estimation.integrity.fault_isolation import (
    diagnosed,
    with_changed_beacons,
    with_explaining_cause,
)
from magfusion.estimation.integrity.judge import judged_with_score
from magfusion.estimation.integrity.score import Score
from magfusion.estimation.integrity.smoothed_exclusion import (
    excluded_to_the_end,
    separated_smooth,
    states_between,
    states_judged,
    with_long_exclusions,
)
from magfusion.estimation.integrity.steel_map import SteelMap, map_steel
from magfusion.estimation.integrity.steel_test import STEEL, declared_site, steel_explains
from magfusion.estimation.online_integrity.open_roll import (
    comparable,
    roll_findings,
    with_open_roll,
)
from magfusion.estimation.solve.memory import give_back_memory
from magfusion.files.site import save_site
from magfusion.files.steel_map import STEEL_MAP, write_steel_map
from magfusion.files.trajectory_table import write_trajectory
from magfusion.files.tum import write_tum
from magfusion.jobs.failure import reason_of
from magfusion.jobs.result_directory import found_in
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.model.trust import Finding, Risk, StateTrust, Trust, Verdict
from magfusion.results.axes import axis_figures, survey_frame
from magfusion.results.errors import TrajectoryErrors, trajectory_errors
from magfusion.results.figures import ErrorColumn, Figure, Figures, Section, heading
from magfusion.results.page_motion import MotionPage
from magfusion.results.recording import write_recording
from magfusion.results.recording_steel import steel_figures
from magfusion.results.refinement import result_site
from magfusion.results.report import (
    compared_with_truth,
    error_figures,
    open_figures,
    placement_figures,
    smoothed_figures,
    where_found,
    write_report,
)
from magfusion.results.verdict import level_figures, trust_figures
from magfusion.units import Array, Rate

OF_STEEL = ("noise_tuned", "field_residuals")  # codes of findings that steel explains


@dataclass(frozen=True, eq=False)
class Finished:
    """A smoothed log with its verdict.

    Parameters
    ----------
    site : Site
        As declared, or corrected.
    states : StateTrust
        Of each of its states.
    figures : Figures
        Without those of the truth.
    corrections : list of Correction
        What may be wrong with the site, where something is.
    continued : Correction, optional
        That of a corrected site, which is not large enough.
    steel : SteelMap, optional
        Of the steel near the path, where it is used.
    """

    site: Site
    result: Smoothed
    trust: Trust
    states: StateTrust
    figures: Figures
    errors: TrajectoryErrors | None
    corrections: list[Correction] = field(default_factory=list)
    continued: Correction | None = None
    steel: SteelMap | None = None


def finished(
    log: Log,
    site: Site,
    settings: SmootherSettings,
    result: Smoothed,
    risk: Risk | None,
    *,
    excess: float = 1.0,
    findings: tuple[Finding, ...] = (),
    correction: Correction | None = None,
    mapping: bool = False,
) -> Finished:
    """Assess a smoothed log.

    Parameters
    ----------
    excess : float
        Factor on the variances of its poses, from other logs.
    findings : tuple of Finding
        From other logs.
    correction : Correction, optional
        By which the site was corrected: it is the reason why the result is doubtful.
    mapping : bool
        Whether steel is mapped.
    """
    separated = separated_smooth(result, risk)
    tests = {
        name: test
        for name, onset in excluded_to_the_end(separated).items()
        if (test := changed_beacon(result, log, name, onset)) is not None
    }
    changed_by = max((test.gain for test in tests.values()), default=0.0)
    if tests and (
        explained_throughout(result, log, changed_by) or steel_explains(result, log, changed_by)
    ):
        separated, tests = separated_smooth(result, risk, excluding=False), {}
    changes = {name: test.findings[0] for name, test in tests.items()}
    give_back_memory()
    result, trust, score, causes = judged_with_score(separated.result, log)
    steel = None
    if mapping:
        result, trust, steel = _with_map(separated.result, result, trust, log)
    if correction is not None:
        result = _with_uncertainty(result, correction, score)
    trust |= Trust((*open_signs(result), *roll_findings(site)))
    result = replace(result, states=with_open_roll(result.states, site))
    if excess > 1.0 and result.states.pose_cov is not None:
        wider = excess * result.states.pose_cov
        result = replace(result, states=replace(result.states, pose_cov=wider))
    trust = with_long_exclusions(trust | separated.trust | Trust(findings))
    trust = with_changed_beacons(trust, changes)
    mapped = steel is not None and steel.is_used
    cause = None
    if correction is None and not mapped:
        cause = aiding_diagnosis(site, compared_smoothed(separated.result))
        cause = cause or diagnosed(log, site, trust, settings.lockin)
    possible = corrections(site, trust.reasons, () if changes else causes, cause)
    is_named = bool(causes) or any(f.code == "changed" for f in trust.reasons)
    if is_named and cause is not None and not cause.is_clear:
        cause = None
    trust = with_explaining_cause(trust, cause)
    if correction is not None:
        trust |= Trust((_explaining(correction.finding, trust),))
    by_state = states_judged(separated, result, trust.verdict)
    figures = (
        heading("smooth", log.name)
        | trust_figures(trust)
        | Figures(where_found("coupling", settings.coupling != "tight", settings.coupling))
    )
    figures |= smoothed_figures(result) | level_figures(by_state, len(site.beacons))
    figures |= open_figures(site)
    further = None if correction is None else continued(correction, score)
    if steel is not None:
        figures |= steel_figures(steel)
    used = steel if mapped else None
    return Finished(site, result, trust, by_state, figures, None, possible, further, used)


def map_of_steel(result: Smoothed, trust: Trust, log: Log) -> SteelMap | str:
    """Return the map of the steel near a path, or why there is none.

    `result`: whose covariance no test has widened.
    """
    other = next((f.code for f in trust.reasons if f.code not in (STEEL, *OF_STEEL)), None)
    return f"{other} is a reason for doubt, too" if other else map_steel(result, log.imu)


def _with_map(
    before: Smoothed, result: Smoothed, trust: Trust, log: Log
) -> tuple[Smoothed, Trust, SteelMap | None]:
    """Return a result and its findings with the map of steel, and the map.

    `before`: whose covariance no test has widened.
    """
    steel = map_of_steel(before, trust, log)
    if isinstance(steel, str):
        remark = Finding(STEEL, f"The steel is not mapped: {steel}.", Verdict.TRUSTWORTHY)
        return result, trust | Trust((remark,)), None
    others = tuple(f for f in trust.findings if f.code != STEEL)
    if steel.is_used:
        result, remarked = steel.applied(before), Verdict.TRUSTWORTHY
        others = tuple(replace(f, verdict=remarked) if f.code in OF_STEEL else f for f in others)
    elif len(others) == len(trust.findings):  # no reason, so that none is added
        return result, trust, steel
    trust = Trust((steel.finding(declared_site(before)), *others), trust.unverified)
    return replace(result, trust=trust), trust, steel


def _explaining(finding: Finding, trust: Trust) -> Finding:
    """Return the reason of a corrected result, without what is a reason still."""
    remaining = {reason.code for reason in trust.reasons}
    explained = tuple(code for code in finding.explained if code not in remaining)
    return replace(finding, explained=explained)


def _with_uncertainty(result: Smoothed, correction: Correction, score: Score | None) -> Smoothed:
    """Return a corrected result whose covariance has the uncertainty of the correction."""
    cov = result.states.pose_cov
    if cov is None:
        return result
    spread = spread_with_rivals(correction, score)
    states = replace(result.states, pose_cov=cov + spread)
    return replace(result, states=states)


def open_signs(result: Smoothed) -> tuple[Finding, ...]:
    """Return findings on omitted amplitudes."""
    if not result.open_signs:
        return ()
    given = result.open_signs + int(np.sum(result.fields.valid))
    text = (
        f"{result.open_signs} of {given} amplitudes are too close to zero near the trajectory to"
        " have a known sign; they are omitted."
    )
    return (Finding("sign_open", text, Verdict.TRUSTWORTHY),)


def with_errors(
    done: Finished,
    log: Log,
    placed: tuple[Placement, ...] = (),
    fixed: tuple[Site, SmootherSettings] | None = None,
) -> Finished:
    """Return a result with its errors against the truth, where there is one.

    `fixed`: with which the log is smoothed again, the survey fixed, to show the gain of estimating
    it.
    """
    result = done.result
    own = comparable(log, result.states, result.declared.site)
    errors, compared = compared_with_truth(result.states, own)
    frame = survey_frame(result.calibration, result.blocks)
    figures = done.figures | axis_figures(result.states, errors, frame) | compared
    figures |= placement_figures(placed, result.calibration.site)
    if errors is not None and not placed and fixed is not None:
        figures |= _fixed_survey_figures(log, *fixed, result)
    return replace(done, figures=figures, errors=errors)


def write_finished(whole: Path, log: Log, done: Finished, *, rate: Rate) -> None:
    """Write all files of a smoothed log: to `FAILED` for that verdict."""
    result, by_state = done.result, done.states
    if not log.inertial:  # the prior's bias is the rate, and no bias
        states = replace(result.states, gyro_bias_body=None, accel_bias_body=None)
        result = replace(result, states=states)
    refined, innovations = result_site(result, log.name), _innovations(result)
    if done.steel is not None:
        refined = done.steel.on(refined)
    written = result.states
    if rate != "field":
        from magfusion.estimation.batch.between_epochs import at_rate

        written = at_rate(done.result, log, rate)
    if not log.inertial:
        written = replace(written, gyro_bias_body=None, accel_bias_body=None)
    directory = found_in(whole, done.trust)
    write_tum(written, directory / "trajectory.tum", log.epoch_ns)
    rows = states_between(by_state, result.states, written)
    write_trajectory(written, directory / "trajectory.parquet", log.epoch_ns, rows)
    save_site(refined, directory / "site.yaml")
    write_recording(
        directory / "run.rrd",
        refined,
        result.states,
        truth=log.truth,
        errors=done.errors,
        innovations=innovations,
        trust=done.trust,
        states=by_state,
        steel=done.steel,
    )
    if done.steel is not None:
        voxels = done.steel.voxels
        write_steel_map(directory / STEEL_MAP, *voxels, *done.steel.polarisability)
    motion = MotionPage(refined, result.states, log.truth, done.errors, innovations, by_state)
    write_report(whole, done.figures, motion)


def _innovations(result: Smoothed) -> dict[str, tuple[Array, Array]]:
    channels = result.fields.channels
    estimate = {}
    for name in dict.fromkeys(beacon for beacon, _ in channels):
        own = result.residual[:, [beacon == name for beacon, _ in channels]]
        seen = np.isfinite(own).all(axis=(1, 2))
        if np.any(seen):
            estimate[name] = (
                result.fields.time[seen],
                np.sqrt(np.mean(own[seen] ** 2, axis=(1, 2))),
            )
    return estimate


def _fixed_survey_figures(
    log: Log, site: Site, settings: SmootherSettings, result: Smoothed
) -> Figures:
    """Return the errors with the calibration as surveyed: the gain of estimating it."""
    kept = ("phase", "time-offset")
    if all(block.group in kept for block in result.blocks):
        return Figures()
    try:
        fixed = smooth(log, site, replace(settings, estimate=kept))
    except RuntimeError as error:
        return Figures(Figure("held_failed", reason_of(error), section=Section.REPORT))
    assert log.truth is not None
    return error_figures(trajectory_errors(fixed.states, log.truth), ErrorColumn.FIXED, "held_")
