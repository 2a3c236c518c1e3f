"""Whether the estimators report what happens to the beacons in a drift test, and nothing else."""

from typing import NamedTuple

from magfusion.estimation.online_integrity.settlement import SETTLEMENT
from magfusion.jobs.drift_conditions import endurance_config
from magfusion.jobs.drift_world import Reported, WorldRun, WorldTask
from magfusion.results.drift import Criterion, Verdict
from magfusion.results.figures import Figure
from magfusion.units import HOUR


class Event(NamedTuple):
    """What happens to one beacon."""

    begin: float  # s
    within: float  # in which it is to be reported (s)
    what: str
    code: str | None = None  # of the finding; None for any


def event_of(task: WorldTask) -> Event | None:
    """Return what happens to one beacon in a world, if anything does."""
    events = endurance_config(task.condition, task.hours, task.drive, task.clock_rate).events
    if events.exchange is not None:
        return Event(events.exchange.time, HOUR, "the exchange")
    if events.settlement is not None and not events.settlement.whole:
        return Event(0.0, 24.0 * HOUR, "the settlement", SETTLEMENT)
    return None


def judge_events(runs: list[WorldRun]) -> tuple[list[Figure], list[Criterion]]:
    """Return what was reported, and the judgement of it."""
    event = event_of(runs[0].task)
    false = [f for run in runs for f in run.reported if not _has_happened(f, run, event)]
    lines = [f"{f.time / HOUR:.2f} h: {f.code}: {f.text}" for run in runs for f in run.reported]
    figures = [Figure("reported", lines), Figure("false_findings", len(false))]
    criteria = [_of_false(false, runs[0].task.condition)]
    if event is not None:
        after = [_delay(run, event) for run in runs]
        hours = ["never" if t is None else f"{t / HOUR:.2f}" for t in after]
        figures.append(Figure("reported_after_h", hours))
        criteria.append(_of_delays(after, event, runs[0].task.hours))
    return figures, criteria


def _has_happened(one: Reported, run: WorldRun, event: Event | None) -> bool:
    return event is not None and one.beacons == (run.event_beacon,) and one.time >= event.begin


def _of_false(false: list[Reported], condition: str) -> Criterion:
    verdict: Verdict = "fail" if false else "pass"
    sentence = "nothing is reported that did not happen"
    if false:
        first = min(false, key=lambda one: one.time)
        sentence = (
            f"{len(false)} findings are wrong, first after {first.time / HOUR:.2f} h: {first.text}"
        )
    if condition == "common-settlement":
        sentence += " (a settlement of all beacons moves the pose with them: not observable)"
    return Criterion("false_findings", verdict, sentence)


def _delay(run: WorldRun, event: Event) -> float | None:
    """Return how long after the event a finding named its beacon (s)."""
    right = [one for one in run.reported if event.code in (None, one.code)]
    times = [
        one.time - event.begin
        for one in right
        if run.event_beacon in one.beacons and one.time >= event.begin
    ]
    return min(times, default=None)


def _of_delays(after: list[float | None], event: Event, hours: float) -> Criterion:
    known = [t for t in after if t is not None]
    in_time = len(known) == len(after) and max(known) <= event.within
    verdict: Verdict = "pass" if in_time else "fail"
    if not in_time and hours * HOUR < event.begin + event.within:
        verdict = "undecided"
    worst = f"{max(known) / HOUR:.2g} h at most" if known else "never"
    sentence = (
        f"{event.what} is reported in {len(known)} of {len(after)} worlds, after {worst}; limit"
        f" {event.within / HOUR:g} h"
    )
    return Criterion("event_reported", verdict, sentence)
