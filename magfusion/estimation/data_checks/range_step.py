"""A magnetometer whose range or gain was switched during the log."""

from collections.abc import Iterator

import numpy as np

from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.model.trust import Finding, Verdict
from magfusion.receiver.slots import has_schedule
from magfusion.units import Array

BLOCK = 0.25  # s; longer than a period of the tones, shorter than most turns
NEAR = 8  # blocks on either side, of which the static field is compared
MIN_STEP = 0.25  # of the logarithm of the gain; ranges of instruments differ by more
MIN_TONES = 0.25  # of the step, by which tones step as well; motion changes them meanwhile
NO_FIELD = 1e-15  # T; below any instrument, to keep logarithms finite
CERTAIN = 6.0  # times the scatter of the static field on either side


def range_step(log: Log, site: Site | None) -> Iterator[Finding]:
    """Yield the instant at which static field and tones change by one factor, for good."""
    wave = log.vectors
    if wave is None or len(wave) < 2 or (site is not None and has_schedule(site)):
        return  # coils driven in turn change the size of the tones, too
    size = max(round(BLOCK / float(np.median(np.diff(wave.time)))), 2)
    count = len(wave) // size
    if count < 2 * NEAR + 2:
        return
    field = wave.measured_sensor[: count * size].reshape(count, size, 3)
    level = np.log(np.maximum(np.linalg.norm(np.mean(field, axis=1), axis=1), NO_FIELD))
    at = NEAR + int(np.argmax(np.abs(level[NEAR + 1 : -NEAR] - level[NEAR - 1 : -NEAR - 2])))
    before, after = level[at - NEAR : at], level[at + 1 : at + 1 + NEAR]
    step = float(np.median(after) - np.median(before))
    of_tones = np.log(max(_tones(field[at + 1]), NO_FIELD) / max(_tones(field[at - 1]), NO_FIELD))
    if (
        abs(step) > max(MIN_STEP, CERTAIN * float(max(np.std(before), np.std(after))))
        and of_tones / step > MIN_TONES
    ):
        time = float(np.mean(wave.time[at * size : (at + 1) * size]))
        yield Finding(
            "range_switched",
            f"magnetometer: all its readings change by a factor of {np.exp(step):.3g} at"
            f" {time:.4g} s: its range or gain was switched. Process the parts before and after"
            f" separately (--end {time - BLOCK:.4g}, --start {time + BLOCK:.4g}).",
            Verdict.FAILED,
            1e3,
        )


def _tones(field_sensor: Array) -> float:
    """Return the size of alternating fields of a block (T), by the differences of its samples."""
    return float(np.sqrt(np.mean(np.sum(np.diff(field_sensor, axis=0) ** 2, axis=1))))
