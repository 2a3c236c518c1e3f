"""Which epoch of the input queue comes next: fields, a window, another measurement, or none."""

from collections.abc import Callable
from typing import NamedTuple

from magfusion.estimation.graph.same_epoch import SAME_TIME
from magfusion.estimation.graph.state import State
from magfusion.estimation.online.navigator_settings import NavigatorSettings
from magfusion.estimation.online.queue.arrivals import Arrivals
from magfusion.model.samples import FieldSamples


class NextEpoch(NamedTuple):
    """An epoch whose data have all arrived."""

    time: float  # (s)
    samples: FieldSamples | None = None  # None where it may have a window


class TooLate(NamedTuple):
    """Measurements that are not after the newest state, by reason and number."""

    reason: str
    number: int = 1


def next_epoch(
    arrived: Arrivals,
    state: State,
    settings: NavigatorSettings,
    needs_separate: Callable[[State], bool],
) -> NextEpoch | TooLate | None:
    """Take the next epoch after a state out of the queue; None where its data are incomplete.

    `needs_separate`: as of `Arrivals.next_window`.
    """
    now, delay = state.time, settings.delay
    arrived.receive(state, delay)
    inertial, other = arrived.awaited - delay, arrived.others.next
    if other <= now + SAME_TIME:
        return TooLate("measurement too late", len(arrived.others.take(other)))
    if other <= inertial and other < arrived.next_field - SAME_TIME:
        return NextEpoch(other)
    centre = arrived.next_window(state, needs_separate)
    if centre is not None:
        return NextEpoch(centre) if centre > now else TooLate("window too late")
    if arrived.due(inertial):
        samples = arrived.fields.pop(0)
        time = float(samples.time[0])
        if time > now:
            return NextEpoch(time, samples)
        arrived.static.pop(time, None)
        return TooLate("field too late")
    if not arrived.window_to_come and inertial - now >= settings.longest_step:
        return NextEpoch(now + settings.longest_step)
    return None
