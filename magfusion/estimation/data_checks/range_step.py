"""A magnetometer whose range or gain was switched during the log."""

from collections.abc import Iterator

import numpy as np

from magfusion.model.samples import Log, Waveform
from magfusion.model.site import Site
from magfusion.model.trust import Finding, Verdict
from magfusion.receiver.slots import has_schedule
from magfusion.units import Array

BLOCK = 0.25  # s; longer than a period of the tones, shorter than most turns
NEAR = 8  # blocks on either side, of which the static field is compared
LEAST_STEP = 0.25  # of the logarithm of the gain; ranges of instruments differ by more
LEAST_TONES = 0.25  # of the step, by which tones step as well; motion changes them meanwhile
WEIGHT = 1e7  # before the parameters that seem to change then, which it explains
CERTAIN = 6.0  # times the scatter of the static field on either side


def range_step(log: Log, site: Site | None) -> Iterator[Finding]:
    """Yield the instant at which static field and tones change by one factor, for good."""
    wave = log.vectors
    if wave is None or len(wave) < 2 or (site is not None and has_schedule(site)):
        return  # coils driven in turn change the size of the tones, too
    time, static, tones = _blocks(wave)
    if len(time) < 2 * NEAR + 2 or not np.all((static > 0.0) & (tones > 0.0)):
        return
    level, of_tones = np.log(static), np.log(tones)
    at = NEAR + int(np.argmax(np.abs(level[NEAR + 1 : -NEAR] - level[NEAR - 1 : -NEAR - 2])))
    before, after = level[at - NEAR : at], level[at + 1 : at + 1 + NEAR]
    step = float(np.median(after) - np.median(before))
    if (
        abs(step) > max(LEAST_STEP, CERTAIN * float(max(np.std(before), np.std(after))))
        and (of_tones[at + 1] - of_tones[at - 1]) / step > LEAST_TONES
    ):
        yield Finding(
            "changed",
            f"magnetometer: all its readings change by a factor of {np.exp(step):.3g} at"
            f" {time[at]:.4g} s: its range or gain was switched. Process the parts before and after"
            f" separately (--end {time[at] - BLOCK:.4g}, --start {time[at] + BLOCK:.4g}).",
            Verdict.FAILED,
            weight=WEIGHT,
        )


def _blocks(wave: Waveform) -> tuple[Array, Array, Array]:
    """Return time (s), static field (T) and size of the tones (T) of blocks, each (n,)."""
    size = max(round(BLOCK / float(np.median(np.diff(wave.time)))), 2)
    count = len(wave.time) // size
    field = wave.measured_sensor[: count * size].reshape(count, size, 3)
    time = wave.time[: count * size].reshape(count, size)
    tones = np.sqrt(np.mean(np.sum(np.diff(field, axis=1) ** 2, axis=2), axis=1))
    return np.mean(time, axis=1), np.linalg.norm(np.mean(field, axis=1), axis=1), tones
