"""Findings of an orientation: disturbances of the field, and undetermined quantities."""

from itertools import pairwise

import numpy as np

from magfusion.estimation.orientation.filter import OrientationFilter
from magfusion.estimation.orientation.layout import LAG, OFFSET, Orientation
from magfusion.model.trust import Finding, Verdict
from magfusion.units import DEGREE, Array, BoolArray

OPEN = 20.0 * DEGREE  # rad; sigma above which a heading is undetermined
DISTURBED = 0.05  # of the field's size
REPORT_TIME = 2.0  # s; duration for which a change is reported online
MOVED = 3.0  # sigma of an offset that has changed, all components: one in a hundred thousand
LATE = 4.0  # sigma of a lag that is reported


def position_open() -> Finding:
    """Return the finding that the position is undetermined."""
    text = (
        "Position and velocity are undetermined: without beacons only the orientation is"
        " estimated. Positions are written as zero, with a sigma of 100 m."
    )
    return Finding("geometry", text, Verdict.TRUSTWORTHY, weight=0.1)


def doubts(cov_body: Array, world_from_body: Array) -> tuple[Finding, ...]:
    """Return a finding if the heading is undetermined, according to its sigma."""
    sigma = float(np.sqrt(world_from_body[2] @ cov_body @ world_from_body[2]))
    if sigma < OPEN:
        return ()
    text = (
        f"The heading has a sigma of {sigma / DEGREE:.0f} degrees: the Earth's field was disturbed"
        " or missing for too long. Move away from iron, and turn about all axes."
    )
    return (Finding("few_data", text, weight=sigma / OPEN),)


def current_findings(
    estimator: OrientationFilter, time: float, changed: float | None
) -> tuple[Finding, ...]:
    """Return the findings of an online state on the field."""
    out = []
    if changed is not None and time - changed < REPORT_TIME:
        out.append(_change(np.array([changed])))
    size = float(np.linalg.norm(estimator.earth))
    if estimator.disturbance > DISTURBED * size:
        out.append(_disturbed(estimator.disturbance, size, ""))
    return tuple(out)


def remarks(
    states: tuple[Orientation, ...], disturbance: Array, changed: Array, earth: Array
) -> tuple[Finding, ...]:
    """Return the findings of a whole log.

    `disturbance` (states,) (uT), `changed` (m,) (s). `earth` (3,): declared (uT).
    """
    time, size = np.array([s.time for s in states]), float(np.linalg.norm(earth))
    result = [position_open(), *_attached(states, changed)]
    if len(changed) and not any(f.code == "body_iron" for f in result):
        result.append(_change(changed))
    bad = disturbance > DISTURBED * size
    if np.any(bad):
        spans = ", ".join(f"{a:.0f} to {b:.0f} s" for a, b in _spans(time, bad)[:6])
        result.append(_disturbed(float(np.max(disturbance)), size, f" from {spans}"))
    last = states[-1]
    sigma = float(np.sqrt(last.cov[LAG, LAG][0, 0]))
    if abs(last.lag) > max(LATE * sigma, 1e-3):
        which = "magnetometer" if last.lag > 0.0 else "inertial sensor"
        text = (
            f"The {which} lags {1e3 * abs(last.lag):.1f} ms ({1e3 * sigma:.1f}) behind the other;"
            " this is compensated."
        )
        result.append(Finding("time_offset", text, Verdict.TRUSTWORTHY))
    return tuple(result)


def _attached(states: tuple[Orientation, ...], changed: Array) -> list[Finding]:
    """Return the findings of steps of the magnetometer's offset where the field changed."""
    result = []
    time = np.array([s.time for s in states])
    for first in _onsets(changed):
        before = states[max(0, int(np.searchsorted(time, first)) - 1)]
        after = states[min(len(states) - 1, int(np.searchsorted(time, first + 15.0)))]
        step = after.offset - before.offset
        cov = before.cov[OFFSET, OFFSET] + after.cov[OFFSET, OFFSET]
        size = float(np.linalg.norm(step))
        if size > MOVED * float(np.sqrt(np.trace(cov))):
            text = (
                f"At {first:.1f} s the magnetometer's offset changed by {size:.1f} uT: a magnet or"
                " iron was attached to the body. It is estimated from then on."
            )
            result.append(Finding("body_iron", text, Verdict.TRUSTWORTHY, weight=2.0))
    return result


def _change(changed: Array) -> Finding:
    onsets = _onsets(changed)
    times = ", ".join(f"{t:.1f}" for t in onsets[:6])
    more = f" and {len(onsets) - 6} more" if len(onsets) > 6 else ""
    text = (
        f"The field changed at {times} s{more}, inconsistent with the model: a magnet or iron is"
        " near the path or on the body. The gyroscope propagated the heading."
    )
    return Finding("earth_field", text, Verdict.TRUSTWORTHY, weight=1.5)


def _disturbed(deviation: float, size: float, when: str) -> Finding:
    text = (
        f"The field deviates from the Earth's by {deviation:.1f} uT"
        f" ({100.0 * deviation / size:.0f} %){when}: it is downweighted there."
    )
    return Finding("iron", text, Verdict.TRUSTWORTHY)


def _onsets(changed: Array) -> list[float]:
    """Return the first of each series of changes (s)."""
    return [float(t) for k, t in enumerate(changed) if k == 0 or t - changed[k - 1] > REPORT_TIME]


def _spans(time: Array, bad: BoolArray) -> list[tuple[float, float]]:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], bad, [False]]).astype(int)))
    pairs = list(pairwise(edges.tolist()))[::2]
    return [(float(time[a]), float(time[b - 1])) for a, b in pairs]
