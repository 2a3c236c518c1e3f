"""A magnetometer whose range or gain was switched during the log."""

from collections.abc import Iterator

import numpy as np

from magfusion.model.samples import Log, Waveform
from magfusion.model.site import Site
from magfusion.model.trust import Finding, Verdict
from magfusion.receiver.slots import has_schedule
from magfusion.units import Array

BLOCK = 0.25  # s; longer than a period of tones that are driven, shorter than most turns
NEAR = 8  # blocks on either side, of which the static field is compared
LEAST_STEP = 0.25  # of the logarithm of the gain; ranges of instruments differ by more
ALIKE = 0.2  # of the same; by which beacons at a metre change within a block or two
CERTAIN = 6.0  # times the scatter of the static field on either side


def range_step(log: Log, site: Site | None) -> Iterator[Finding]:
    """Yield the instant at which static field and tones change by one factor, for good."""
    wave = log.vectors
    if wave is None or len(wave) < 2 or (site is not None and has_schedule(site)):
        return  # a beacon in turn changes the size of the tones, too
    time, static, tones = _levels(wave)
    count = len(time)
    if count < 2 * NEAR + 1 or not (np.all(static > 0.0) and np.all(tones > 0.0)):
        return
    log_static, log_tones = np.log(static), np.log(tones)
    steps = np.abs(log_static[2:] - log_static[:-2])
    at = int(np.argmax(steps)) + 1
    before, after = slice(max(at - NEAR, 0), at), slice(at + 1, at + 1 + NEAR)
    if len(log_static[before]) < NEAR or len(log_static[after]) < NEAR:
        return
    step = float(np.median(log_static[after]) - np.median(log_static[before]))
    scatter = max(float(np.std(log_static[part])) for part in (before, after))
    sudden = float(log_static[at + 1] - log_static[at - 1])
    of_tones = float(log_tones[at + 1] - log_tones[at - 1])
    if (
        abs(step) > max(LEAST_STEP, CERTAIN * scatter)
        and abs(sudden - step) < ALIKE
        and abs(of_tones - step) < ALIKE
    ):
        yield Finding(
            "changed",
            f"magnetometer: all its readings change by a factor of {np.exp(step):.3g} at"
            f" {time[at]:.4g} s: its range or gain was switched. Process the parts before and after"
            f" separately (--end {time[at] - BLOCK:.4g}, --start {time[at] + BLOCK:.4g}).",
            Verdict.FAILED,
            1e3,
        )


def _levels(wave: Waveform) -> tuple[Array, Array, Array]:
    """Return time (s), static field and size of the tones (T) of blocks, each of shape (n,)."""
    size = max(int(round(BLOCK / float(np.median(np.diff(wave.time))))), 2)
    count = len(wave.time) // size
    field = wave.measured_sensor[: count * size].reshape(count, size, -1)
    time = wave.time[: count * size].reshape(count, size)
    static = np.linalg.norm(np.mean(field, axis=1), axis=1)
    tones = np.sqrt(np.mean(np.sum(np.diff(field, axis=1) ** 2, axis=2), axis=1))
    return np.mean(time, axis=1), static, tones
