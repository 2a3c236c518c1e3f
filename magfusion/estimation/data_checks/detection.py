"""Detection of beacons: a receiver outputs a phasor for every tone, also of an absent beacon."""

from dataclasses import replace

import numpy as np
from scipy.ndimage import binary_erosion, maximum_filter1d

from magfusion.model.noise import whitening
from magfusion.model.samples import FieldSamples
from magfusion.units import Array, BoolArray, IntArray

DETECTION_CHI_SQUARE = (
    100.0  # chi square of six components; of a log that is smoothed with the Earth field
)
DETECTION_CHI_SQUARE_ONLINE = (
    40.0  # a weak beacon helps more than a false one, which the gate rejects, costs
)


STRONG_CHI_SQUARE = (
    25.0  # times the least chi square: a beacon that is always weaker may only be far away
)


def without_silence(samples: FieldSamples) -> FieldSamples:
    """Return samples without the stretches in which a beacon that is strong elsewhere is silent.

    Its phasor there is noise and contradicts the model.  A beacon that fades with distance loses
    almost nothing.  Windows in which a beacon is switched are omitted for all beacons.
    """
    received = detected(samples, DETECTION_CHI_SQUARE_ONLINE)
    strong = detected(samples, STRONG_CHI_SQUARE * DETECTION_CHI_SQUARE_ONLINE).any(axis=0)
    silent = samples.valid & ~received & strong
    if not np.any(silent):
        return samples
    return only(samples, ~(silent | switched(samples)[:, None]))


def switched(samples: FieldSamples) -> BoolArray:
    """Return the windows in which a strong beacon may have been switched, shape (n,).

    The lock-in assumes that a tone lasts for the whole window; the spectrum of one that does not
    leaks into all other tones.  A beacon was switched where it is undetected although its amplitude
    a few windows before or after would be far above the noise there.
    """
    result = np.zeros(len(samples), dtype=bool)
    present = above_noise(samples, DETECTION_CHI_SQUARE_ONLINE) | samples.partial
    silent, reach = samples.valid & ~present, _overlapping(samples)
    power = np.where(present, np.nansum(np.abs(samples.phasor_sensor) ** 2, axis=-1), 0.0)
    near = maximum_filter1d(power, 4 * reach + 1, axis=0, mode="nearest")
    off = silent & (near * _information(samples) > STRONG_CHI_SQUARE * DETECTION_CHI_SQUARE_ONLINE)
    for channel in np.flatnonzero(off.any(axis=0)).tolist():
        rows = np.flatnonzero(samples.valid[:, channel])  # of the slots, where coils take turns
        quiet = silent[rows, channel]
        edge = off[rows, channel]
        falls = np.flatnonzero(edge[1:] & ~quiet[:-1]) + 1
        rises = np.flatnonzero(edge[:-1] & ~quiet[1:])
        begins = np.concatenate([falls - reach, rises - reach + 1])
        inside = (begins[:, None] + np.arange(2 * reach)).ravel()
        result[rows[inside[(inside >= 0) & (inside < len(rows))]]] = True
    return result


def _overlapping(samples: FieldSamples) -> int:
    """Return the number of steps between windows that do not overlap."""
    if len(samples) < 2:
        return 1
    step = float(np.median(np.diff(samples.time)))
    return int(np.ceil(np.median(samples.window) / step - 1e-6))


def _information(samples: FieldSamples) -> Array:
    """Return the mean information on a component of each phasor, shape (n, channels) (1/T^2)."""
    return np.asarray(
        np.sum(whitening(samples.phasor_cov, samples.there) ** 2, axis=(-1, -2)) / 3.0
    )


def masked_phasors(samples: FieldSamples) -> BoolArray:
    """Return which phasors could not show a beacon above the noise, shape (n, channels).

    Of those that `without_silence` drops: a beacon of its usual strength would be masked by noise,
    as in fast motion near another coil before that motion is compensated.
    """
    received = detected(samples, DETECTION_CHI_SQUARE_ONLINE)
    power = np.where(received, np.nansum(np.abs(samples.phasor_sensor) ** 2, axis=-1), np.nan)
    usual = np.nanmedian(np.where(received.any(axis=0), power, 0.0), axis=0)
    hidden = usual * _information(samples) <= DETECTION_CHI_SQUARE_ONLINE
    return np.asarray(samples.valid & ~received & hidden)


def above_noise(samples: FieldSamples, least: float) -> BoolArray:
    """Return which phasors exceed a chi square against zero, shape (n, channels)."""
    there = samples.there
    phasor = np.where(there, samples.phasor_sensor, 0.0)
    parts = np.stack([phasor.real, phasor.imag], axis=-1)
    white = whitening(samples.phasor_cov, there) @ parts
    return np.asarray(samples.valid & (np.sum(white**2, axis=(-1, -2)) > least))


def detected(samples: FieldSamples, least: float = DETECTION_CHI_SQUARE) -> BoolArray:
    """Return which phasors are of a beacon, shape (n, channels): above noise for several windows.

    A window in which a beacon stops or starts contains an unknown part of its tone, so that windows
    overlapping one without the beacon are not counted. `least`: threshold for the chi square of a
    phasor's six components against zero.
    """
    # A field perpendicular to the available axes looks like silence.
    strong = above_noise(samples, least) | samples.partial
    if len(samples) < 2:
        return strong
    whole = np.ones((2 * _overlapping(samples) + 1, 1), dtype=bool)
    # A tone that an epoch does not contain has not fallen silent.
    return strong & np.asarray(binary_erosion(strong | ~samples.valid, whole, border_value=1))


def only(samples: FieldSamples, channels: BoolArray) -> FieldSamples:
    """Return samples with all other channels set to missing."""
    return replace(
        samples, phasor_sensor=np.where(channels[..., None], samples.phasor_sensor, np.nan)
    )


class DetectionFilter:
    """Track which channels are detected, epoch by epoch.

    A beacon that appears is skipped until a window is free of its silence; one that disappears is
    rejected by the gate, which predicts its field.
    """

    _detected_for: IntArray | None  # epochs in a row, by channel

    def __init__(self) -> None:
        self._detected_for = None

    def of(self, samples: FieldSamples, step: float) -> FieldSamples:
        """Return an epoch's samples without the beacons that are not detected.

        `samples`: one epoch. `step`: since the previous epoch (s).
        """
        strong, valid = detected(samples, DETECTION_CHI_SQUARE_ONLINE), samples.valid[0]
        reach = int(np.ceil(samples.window[0] / step - 1e-6))
        if self._detected_for is None:
            # The motion of a first state leaves more in a window than the noise of its phasors.
            clear = detected(samples, STRONG_CHI_SQUARE * DETECTION_CHI_SQUARE_ONLINE)
            self._detected_for = np.where(clear[0], reach, 0)
        # What an epoch does not hold (another slot's tone) has not fallen silent.
        counted = np.where(strong[0], self._detected_for + 1, 0)
        self._detected_for = np.where(valid, counted, self._detected_for)
        kept = strong & (self._detected_for > reach)
        return samples if np.all(kept) else only(samples, kept)
