"""Results of navigation along a log: trajectories with their verdicts, figures and files."""

import resource
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from magfusion.estimation.data_checks.data_quality import BRIDGED_CODES, recorded
from magfusion.estimation.data_checks.signal import Detected
from magfusion.estimation.graph.state import MOTION
from magfusion.estimation.initialization.online import NoStart
from magfusion.estimation.integrity.fault_isolation import (
    CAUSE_FIRST,
    diagnosed,
    with_corrected,
    with_explaining_cause,
)
from magfusion.estimation.integrity.hypothesis_tests import QUANTISED, coarse_steps
from magfusion.estimation.online.navigator import Navigator, NavigatorSettings
from magfusion.estimation.online_integrity.open_roll import comparable
from magfusion.files.site import save_site
from magfusion.files.site_changes import changed_keys
from magfusion.files.trajectory_table import write_trajectory
from magfusion.files.tum import write_tum
from magfusion.jobs.state_rows import CURRENT, LAGGED, PROPAGATED, STATE
from magfusion.model.parameters import dimension, initial_calibration
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.model.trust import Finding, StateTrust, Trust, Verdict
from magfusion.model.without_imu import logged
from magfusion.results.axes import Frame, axis_figures, survey_frame
from magfusion.results.errors import TrajectoryErrors
from magfusion.results.figures import (
    ErrorColumn,
    Figure,
    Figures,
    ParameterEstimate,
    Section,
    determined_figures,
    heading,
)
from magfusion.results.page_motion import MotionPage
from magfusion.results.recording import write_recording
from magfusion.results.refinement import parameter_estimates, refined_site
from magfusion.results.report import (
    compared_with_truth,
    open_figures,
    rival_figures,
    sigma_figures,
    where_found,
)
from magfusion.results.verdict import level_figures, trust_figures
from magfusion.units import Array, BoolArray

_VERDICTS = tuple(Verdict)


@dataclass(frozen=True, eq=False)
class StateSeries:
    """States of one kind, with their findings."""

    states: Trajectory
    trust: StateTrust


@dataclass(frozen=True, eq=False)
class NavigateResults:
    """Results of a run.

    `current`, `lagged`: states as first estimated, and as they left the smoother's window, if there
    is one.  Lost states have no pose and are excluded, unless all have failed. `propagated`: states
    between the epochs, if requested.
    """

    trust: Trust
    current: StateSeries
    lagged: StateSeries | None
    propagated: StateSeries | None
    errors: TrajectoryErrors | None
    innovations: dict[str, tuple[Array, Array]]
    refined: Site


def no_start(seconds: float, why: NoStart) -> Trust:
    """Return the findings of a log without a state."""
    text = f"{seconds:.3g} s of data give no state: {why.reason}"
    weight = 0.0 if why.trust.findings else 1.0
    return why.trust | Trust((Finding("no_start", text, Verdict.FAILED, weight),))


def _without_levels(states: StateTrust, navigator: Navigator) -> Trust:
    """Return why states have no protection level: a fix of an epoch begins the comparison again."""
    count, fixes = (
        int(np.sum(~np.isfinite(states.protection_level_m))),
        navigator.counts["found by a fix"],
    )
    if navigator.settings.risk is None or count == 0 or 2 * fixes < count:
        return Trust()
    text = (
        f"{count} of {len(states.protection_level_m)} states have no protection level: {fixes}"
        " poses are fixes of one epoch, as the motion before is not known well enough. Record an"
        " IMU, or use fix or smooth, which give levels."
    )
    return Trust((Finding("no_redundancy", text, Verdict.TRUSTWORTHY, 0.0),))


def _without_repeated(online: Trust, findings: tuple[Finding, ...]) -> Trust:
    """Remove findings of the beginning that also apply to the whole recording."""
    every: dict[tuple[str, str], int] = {}
    for finding in findings:
        every[_subject(finding)] = max(finding.verdict.rank, every.get(_subject(finding), 0))
    kept = tuple(f for f in online.findings if f.verdict.rank > every.get(_subject(f), -1))
    return replace(online, findings=kept)


def _subject(finding: Finding) -> tuple[str, str]:
    """Return the code, and the sensor that begins the text: numbers differ with the span."""
    return finding.code, finding.text.partition(":")[0]


def _chosen(rows: dict[str, Array], trust: Trust, kind: float) -> BoolArray:
    own: BoolArray = rows["lagged"][:, 0] == kind
    if trust.verdict is Verdict.FAILED:
        return own
    return own & (rows["verdict"][:, 0] < Verdict.FAILED.rank)


def _motion_compensated(rows: dict[str, Array], site: Site) -> Detected:
    """Return which beacons were detected at the epochs, corrected for motion in the windows."""
    own = rows["lagged"][:, 0] == CURRENT
    names = tuple(beacon.name for beacon in site.beacons)
    return Detected(rows["time"][own, 0], names, rows["heard"][own] > 0.0)


def _part(rows: dict[str, Array], own: BoolArray, site: Site) -> StateSeries | None:
    if not np.any(own):
        return None
    states = Trajectory(
        time=rows["time"][own, 0],
        world_from_body=rows["world_from_body"][own].reshape(-1, 3, 3),
        pose_cov=rows["pose_cov"][own].reshape(-1, 6, 6),
        **{name: rows[name][own] for name in tuple(STATE)[2:]},
    )
    if not site.platform.inertial:  # the prior's bias is the rate, and no bias
        states = replace(states, gyro_bias_body=None, accel_bias_body=None)
    excluded = tuple(
        tuple(b.name for b, out in zip(site.beacons, row, strict=True) if out)
        for row in rows["excluded"][own]
    )
    verdict = tuple(_VERDICTS[int(rank)] for rank in rows["verdict"][own, 0])
    level_m, level_deg = rows["levels"][own].T
    return StateSeries(states, StateTrust(verdict, level_m, level_deg, excluded))


def navigated(
    log: Log, navigator: Navigator, rows: dict[str, Array], elapsed: float
) -> tuple[Figures, NavigateResults]:
    """Return figures and results of a navigation.

    `rows`: of `row_columns`, all rows. `elapsed`: (s).
    """
    site, settings = navigator.site, navigator.settings
    log, _ = logged(log, site)
    trusted = _part(rows, _chosen(rows, navigator.summary.trust, CURRENT), site)
    poses = None if trusted is None or settings.earth else trusted.states
    released = _motion_compensated(rows, site)
    detected = recorded(
        log, site, BRIDGED_CODES, estimated=poses, beacons=True, compensated=released
    )
    findings = _without_repeated(navigator.summary.trust, detected)
    trust = findings | Trust(detected)
    parts = log, navigator.declared, trust, settings.lockin
    if not navigator.corrected:
        trust = with_explaining_cause(trust, diagnosed(*parts))
    else:
        trust = with_corrected(trust, navigator.corrected)
        # Steps were unknown as the site was corrected, which does not undo them.
        cause = None if coarse_steps(log, site) is None else diagnosed(*parts)
        if cause is not None and cause.finding.code == QUANTISED:
            trust |= Trust((replace(cause.finding, weight=2.0 * CAUSE_FIRST),))
    own = _chosen(rows, trust, CURRENT)
    current, lagged = _part(rows, own, site), None
    assert current is not None
    states = current.states
    trust |= _without_levels(current.trust, navigator)
    estimates, refined = _calibration(navigator, log.name)
    trust = _with_newest_values(trust, navigator, refined)
    errors, compared = compared_with_truth(states, comparable(log, states, site))
    compared = axis_figures(states, errors, _frame(navigator)) | compared
    figures = heading("navigate", log.name) | trust_figures(trust)
    figures |= _settings_figures(navigator.settings) | _run_figures(navigator, states) | compared
    figures |= level_figures(current.trust, len(site.beacons)) | open_figures(site)
    lagged = _part(rows, _chosen(rows, trust, LAGGED), site)
    if lagged is not None:
        figures |= Figures(Figure("lagged_epochs", len(lagged.states), section=Section.REPORT))
        remaining = comparable(log, lagged.states, site)
        figures |= compared_with_truth(lagged.states, remaining, ErrorColumn.LAGGED, "lagged_")[1]
    propagated = _part(rows, _chosen(rows, trust, PROPAGATED), site)
    if propagated is not None:
        figures |= Figures(Figure("carried_states", len(propagated.states), section=Section.REPORT))
        now = comparable(log, propagated.states, site)
        figures |= compared_with_truth(propagated.states, now, ErrorColumn.PROPAGATED, "carried_")[
            1
        ]
    latency = rows["latency"][rows["lagged"][:, 0] == CURRENT, 0]
    figures |= _update_figures(latency, elapsed)
    figures |= Figures(*estimates) | determined_figures(estimates)
    innovations = {
        beacon.name: (states.time, np.sqrt(rows["distortion"][own, i]))
        for i, beacon in enumerate(site.beacons)
    }
    return figures, NavigateResults(
        trust, current, lagged, propagated, errors, innovations, refined
    )


def _with_newest_values(trust: Trust, navigator: Navigator, refined: Site) -> Trust:
    """Return findings on what is corrected with the newest estimates as their remedies."""
    newest = changed_keys(navigator.declared, refined)
    corrected = {finding.code for finding in navigator.corrected}

    def renewed(finding: Finding) -> Finding:
        if not finding.remedy or finding.code not in corrected:
            return finding
        return replace(finding, remedy={k: newest.get(k, v) for k, v in finding.remedy.items()})

    return replace(trust, findings=tuple(map(renewed, trust.findings)))


def _calibration(navigator: Navigator, name: str) -> tuple[list[ParameterEstimate], Site]:
    """Return the estimates of the calibration, and the refined site."""
    state = navigator.state(-np.inf)
    blocks, _ = navigator.settings.blocks(navigator.site)
    # Parameters that are only considered follow the estimated ones.
    own = slice(MOTION, MOTION + dimension(blocks))
    cov = state.cov[own, own]
    declared = initial_calibration(navigator.site, state.calibration.reference_time)
    estimates = parameter_estimates(declared, state.calibration, blocks, cov)
    return estimates, refined_site(state.calibration, blocks, cov, estimates, name)


def _frame(navigator: Navigator) -> Frame | None:
    """Return the uncertainty of the frame by the survey."""
    blocks, _ = navigator.settings.blocks(navigator.site)
    return survey_frame(navigator.state(-np.inf).calibration, blocks)


def _settings_figures(settings: NavigatorSettings) -> Figures:

    figures = [Figure("estimator", settings.estimator), Figure("delay_s", settings.delay, "s")]
    lag = [Figure("lag_s", settings.lag, "s")] if settings.estimator == "smoother" else []
    return Figures(*figures, *lag)


def _run_figures(navigator: Navigator, current: Trajectory) -> Figures:

    lost_epochs = navigator.summary
    assert current.pose_cov is not None
    return (
        Figures(
            Figure("epochs", len(current)),
            Figure("duration_s", float(current.time[-1] - current.time[0]), "s"),
            Figure("first_state_s", float(current.time[0]), "s"),
            where_found("lost_epochs", lost_epochs.lost_states > 0, lost_epochs.lost_states),
            where_found("lost_s", lost_epochs.lost_states > 0, lost_epochs.lost_time),
            where_found("longest_loss_s", lost_epochs.lost_states > 0, lost_epochs.longest_loss),
        )
        | rival_figures(navigator.rival_chi_square)
        | Figures(
            *(
                Figure(
                    "counted_" + reason.replace(":", "").replace(" ", "_"),
                    count,
                    label=reason,
                    refused="too late" in reason or reason.startswith("window"),
                )
                for reason, count in navigator.losses.items()
            ),
            *(
                Figure("distortion_{beacon}", level, "", beacon, label="distortion (1 expected)")
                for beacon, level in navigator.distortion.items()
            ),
        )
        | sigma_figures(current.pose_cov)
    )


def _update_figures(latency: Array, elapsed: float) -> Figures:
    """Return the time of an update, without the first state, which a smoother finds."""
    spent = [Figure("elapsed_s", elapsed, "s"), Figure("memory_mb", _memory_mb(), "MB")]
    known = 1e3 * latency[np.isfinite(latency)]
    if len(known):
        spent += [
            Figure("update_p50_ms", float(np.median(known)), "ms"),
            Figure("update_p99_ms", float(np.percentile(known, 99)), "ms"),
            Figure("update_max_ms", float(np.max(known)), "ms"),
        ]
    return Figures(*spent)


def _memory_mb() -> float | None:
    """Return the peak memory of the process; None where the system does not report it."""
    if sys.platform == "win32":
        return None
    unit = 1 << 20 if sys.platform == "darwin" else 1 << 10  # macOS reports bytes
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit


def motion_of(log: Log, results: NavigateResults) -> MotionPage:
    """Return the content of the page of a navigation."""
    current, innovations = results.current, results.innovations
    own = (results.refined, current.states, log.truth, results.errors, innovations)
    return MotionPage(*own, current.trust)


def write_navigated(directory: Path, log: Log, results: NavigateResults) -> None:
    """Write all files but the report."""
    current, lagged, propagated = results.current, results.lagged, results.propagated
    written = current if propagated is None else propagated
    write_tum(written.states, directory / "trajectory.tum", log.epoch_ns)
    path = directory / "trajectory.parquet"
    write_trajectory(written.states, path, log.epoch_ns, written.trust)
    if lagged is not None:
        path = directory / "lagged.parquet"
        write_trajectory(lagged.states, path, log.epoch_ns, lagged.trust)
    save_site(results.refined, directory / "site.yaml")
    write_recording(
        directory / "run.rrd",
        results.refined,
        current.states,
        truth=log.truth,
        errors=results.errors,
        innovations=results.innovations,
        trust=results.trust,
        states=current.trust,
        propagated=None if propagated is None else propagated.states,
    )
