"""The job that navigates along a log as if it were live: states as first estimated."""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from magfusion.errors import EstimationError, InputError
from magfusion.estimation.data_checks.data_quality import BRIDGED_CODES, recorded
from magfusion.estimation.data_checks.disturbing_lines import with_disturbing_lines
from magfusion.files.checkpoint import claim_checkpoint, run_key
from magfusion.files.row_file import RowFile, claim_rows
from magfusion.files.site import load_site
from magfusion.files.standard_streams import binary_output, until_closed
from magfusion.jobs.live import StateSink, state_sinks
from magfusion.jobs.navigate_rests import run_at_rest
from magfusion.jobs.navigate_settings import NavigateSettings
from magfusion.jobs.rates import refuse_rate
from magfusion.jobs.record_source import live_records
from magfusion.jobs.replay import PIECE, Replay, feed, paced
from magfusion.jobs.settings import Command
from magfusion.jobs.state_rows import CURRENT, LAGGED, PROPAGATED, StateRows, row_columns
from magfusion.model.progress import Report, quiet
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.model.trust import Trust
from magfusion.model.without_imu import as_recorded, require_motion_prior
from magfusion.results.figures import Figures, heading
from magfusion.results.verdict import trust_figures

if TYPE_CHECKING:
    from magfusion.estimation.online.navigator import Navigator, NavigatorSettings
    from magfusion.estimation.online_integrity.judgement import JudgedState
    from magfusion.jobs.checkpoint import CheckpointWriter
    from magfusion.jobs.navigate_results import NavigateResults

MAX_EPOCH = 60.0  # s; of a phasor that belongs to a state of now


def run(
    settings: NavigateSettings, output: Path, given: set[str], report: Report = quiet
) -> Figures | None:
    """Navigate along a log or stream; see `run_navigate` and `run_stream`."""
    if settings.at_rest:
        return run_at_rest(settings, output, given, report)
    if settings.is_live:
        _run_pipe(settings, given)
        return None
    from magfusion.jobs.without_beacons import refuse_without_beacons, without_beacons

    job = settings.job(output)
    if without_beacons(job):
        from magfusion.jobs.orientation import run_orientation

        refuse_without_beacons(given)
        return run_orientation("navigate", job, settings.rates, back=False, report=report)
    if given & {"form", "keep_going"}:
        raise InputError("--keep-going and --format require a stream; give - instead of a log")
    return run_navigate(settings, output, report)


def _run_pipe(settings: NavigateSettings, given: set[str]) -> None:
    from magfusion.jobs.stream import StreamSettings, navigate_records

    site_path = settings.live_site(given)
    site = load_site(site_path, without=True, several=True)
    if not site.beacons:
        from magfusion.jobs.orientation import run_orientation_stream
        from magfusion.jobs.without_beacons import refuse_without_beacons

        refuse_without_beacons(given)
        with until_closed():
            records = live_records(settings, site, sys.stderr)
            streams = (binary_output(), sys.stderr)
            run_orientation_stream(site, records, settings.keep_going, *streams)
        return
    chosen = StreamSettings(
        settings.navigator(settings.job(Path())),
        settings.form,
        settings.keep_going,
        settings,
        settings.checkpoint,
        settings.every,
        settings.resume,
        settings.where,
    )
    with until_closed():
        records = live_records(settings, site, sys.stderr)
        navigate_records(site_path, chosen, records, binary_output(), sys.stderr)


def run_navigate(settings: NavigateSettings, output: Path, report: Report = quiet) -> Figures:
    """Navigate along a log: trajectories, refined site, report and recording."""
    from magfusion.jobs.inputs import named, read_job
    from magfusion.jobs.navigate_results import motion_of, write_navigated
    from magfusion.jobs.result_directory import claim, found_in, refuse_failed
    from magfusion.jobs.written import CHECKPOINT
    from magfusion.results.report import write_report

    job, claimed = settings.job(output), claim(output, "navigate")
    navigator = settings.navigator(job)
    place = job.output / CHECKPOINT if settings.checkpoint is None else settings.checkpoint
    for path in (job.output / CHECKPOINT, place):
        claim_rows(_rows_path(path))
        if path != place or not settings.resume:
            claim_checkpoint(path)
    # As of a stream: the beacons that will be detected are not known beforehand.
    log, site = read_job(
        job,
        fewer=True,
        amplitudes=True,
        several=True,
        reread=True,
        lockin=navigator.lockin,
        select_beacons=False,
        report=report,
    )
    log = as_recorded(log)  # the navigator corrects the samples, as it does those of a stream
    if log.waveforms:  # of which it makes the phasors, too
        log = replace(log, fields=None)
    refuse_rate(job.log_path, log, settings.rates)
    with named(job.log_path):
        require_motion_prior(site)
    navigator = replace(navigator, lockin=with_disturbing_lines(log, site, navigator.lockin))
    _refuse_phasors(job.log_path, log, settings)
    with state_sinks(settings, site, log.epoch_ns, sys.stderr) as sinks:
        built = _make_parent(place)
        run = _open_run(settings, navigator, log, site, place, sinks)
        try:
            with named(job.log_path):
                _advance(run, settings, report)
            figures, trust, results = _results(run)
            with claimed as whole:
                directory = found_in(whole, trust)
                if results is not None:
                    write_navigated(directory, log, results)
                write_report(whole, figures, None if results is None else motion_of(log, results))
        except (InputError, EstimationError):
            _clear(run, place, built)
            raise
        finally:
            run.rows.close()
    if settings.checkpoint is not None:
        _clear(run, place, built)
    refuse_failed(job.log_path, job.output, trust)
    return figures


def _refuse_phasors(path: Path, log: Log, settings: NavigateSettings) -> None:
    """Reject phasors that do not support the requested options, and those of whole rests."""
    if settings.earth and log.waveform is None:
        raise InputError(
            f"{path}: has only phasors, which do not contain the Earth field; give the log with"
            " magnetometer.parquet, or omit --earth"
        )
    if log.waveform is None and log.fields is not None:
        longest = float(max(log.fields.window))
        if longest > MAX_EPOCH:
            raise InputError(
                f"{path}: has whole rests, of up to {longest:.3g} s, which are known only after"
                " their end; run magfusion fix or smooth, or navigate the raw log"
            )


def _results(run: NavigateRun) -> tuple[Figures, Trust, NavigateResults | None]:
    """Return figures and verdict of a run, and its results if it has a state."""
    from magfusion.estimation.integrity.fault_isolation import diagnosed, with_explaining_cause
    from magfusion.jobs.navigate_results import navigated, no_start

    log, navigator = run.replay.log, run.navigator
    if not navigator.started:
        trust = no_start(len(run.replay) * PIECE, navigator.why_no_start)
        trust |= Trust(recorded(log, navigator.site, BRIDGED_CODES, beacons=True))
        cause = diagnosed(log, run.site, trust, navigator.settings.lockin)
        trust = with_explaining_cause(trust, cause)
        return heading("navigate", log.name) | trust_figures(trust), trust, None
    figures, results = navigated(log, navigator, run.rows.rows(), run.elapsed)
    return figures, results.trust, results


@dataclass(eq=False)
class NavigateRun:
    """Progress of a run along a log."""

    replay: Replay
    site: Site
    navigator: Navigator
    rows: StateRows
    place: Path
    kept: CheckpointWriter
    position: int
    elapsed: float
    sinks: tuple[StateSink, ...]


def _make_parent(place: Path) -> list[Path]:
    """Create the checkpoint's directory; return the created directory."""
    built = [p for p in (place.parent, *place.parent.parents) if not p.exists()]
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"{place.parent}: cannot be written ({error.strerror}); give another path"
        ) from error
    return built


def _clear(run: NavigateRun, place: Path, outputs: list[Path]) -> None:
    run.rows.close()
    place.unlink(missing_ok=True)
    run.rows.path.unlink(missing_ok=True)
    for directory in outputs:
        if not any(directory.iterdir()):
            directory.rmdir()


def _rows_path(place: Path) -> Path:
    from magfusion.jobs.written import CHECKPOINT, ROWS

    return place.with_name(ROWS if place.name == CHECKPOINT else f"{place.name}.rows")


def _open_run(
    settings: NavigateSettings,
    navigator: NavigatorSettings,
    log: Log,
    site: Site,
    place: Path,
    sinks: tuple[StateSink, ...],
) -> NavigateRun:
    from magfusion.jobs.checkpoint import CheckpointWriter, RunProgress, begin

    known = (log.imu, log.waveform, log.fields, *log.waveforms.values())
    streams = [stream for stream in known if stream is not None]
    key = run_key("navigate", site, navigator, PIECE, log.epoch_ns, streams)
    begun = begin(place, key, site, navigator, RunProgress(), resume=settings.resume)
    return NavigateRun(
        replay=Replay(log),
        site=site,
        navigator=begun.navigator,
        rows=StateRows(RowFile(_rows_path(place), row_columns(site), begun.extra.rows)),
        place=place,
        kept=CheckpointWriter(place, key, sys.stderr),
        position=begun.position,
        elapsed=begun.extra.elapsed,
        sinks=sinks,
    )


def _advance(run: NavigateRun, settings: NavigateSettings, report: Report) -> None:
    """Process the remaining pieces, and write checkpoints from time to time."""
    from magfusion.estimation.online.corrected import corrected

    began = time.perf_counter() - run.elapsed
    every, reported = max(1, round(settings.every / PIECE)), -np.inf
    for k, piece in paced(run.replay.pieces(run.position), settings.realtime):
        if k % every == 0 and k > run.position:
            _save(run, k, time.perf_counter() - began)
        running = run.navigator.started
        before = time.perf_counter()
        if run.navigator.is_after_silence(piece.arrival - PIECE):
            run.navigator = run.navigator.restarted()
        feed(run.navigator, piece)
        run.navigator = corrected(run.navigator)
        states = run.navigator.take()
        spent = (time.perf_counter() - before) / max(len(states), 1)
        for propagated in run.navigator.take_propagated():
            run.rows.add(run.navigator, propagated, np.nan, PROPAGATED)
            _publish(run, propagated)
            reported = propagated.time
        for state in states:
            # The first state is the result of a whole smoother.
            latency = spent if running else np.nan
            run.rows.add(run.navigator, state, latency, CURRENT)
            if settings.rate == "field":
                _publish(run, state)
            elif state.time > reported:  # the inertial stream is silent
                run.rows.add(run.navigator, state, np.nan, PROPAGATED)
                _publish(run, state)
                reported = state.time
        for state in run.navigator.take_lagged():
            run.rows.add(run.navigator, state, np.nan, LAGGED)
        if k % every == 0:
            report("navigating", k, len(run.replay))
    run.elapsed = time.perf_counter() - began


def _publish(run: NavigateRun, state: JudgedState) -> None:
    """Send a state to the live outputs."""
    if run.sinks:
        from magfusion.jobs.stream import state_content

        reported = state_content(run.navigator, state)
        for sink in run.sinks:
            sink.take(state, reported)


def _save(run: NavigateRun, position: int, elapsed: float) -> None:
    from magfusion.jobs.checkpoint import RunProgress

    run.kept.save(run.navigator, position, RunProgress(run.rows.settle(), elapsed))


COMMAND = Command(
    NavigateSettings, run, example="magfusion navigate log --estimator ekf -o navigated"
)
