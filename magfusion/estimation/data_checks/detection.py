"""Which beacons are detected: a receiver gives a phasor for every tone, also for an absent one."""

from dataclasses import replace

import numpy as np
from scipy.ndimage import binary_erosion

from magfusion.model.noise import whitening
from magfusion.model.samples import FieldSamples
from magfusion.units import BoolArray, IntArray

DETECTION_CHI_SQUARE = (
    100.0  # chi square of six components; of a log that is smoothed with the Earth field
)
DETECTION_CHI_SQUARE_ONLINE = (
    40.0  # a weak beacon is worth more than a wrong one costs, which the gate refuses
)


LOUD = 25.0  # times the least chi square: a beacon that is never so loud may only be far away


def without_silence(samples: FieldSamples) -> FieldSamples:
    """Return samples without the stretches in which a beacon is silent that is loud elsewhere.

    Its phasor is then nothing but noise, and a model that expects it is contradicted.  One that
    fades with the distance loses next to nothing by it.
    """
    heard = detected(samples, DETECTION_CHI_SQUARE_ONLINE)
    loud = detected(samples, LOUD * DETECTION_CHI_SQUARE_ONLINE).any(axis=0)
    silent = samples.valid & ~heard & loud
    return only(samples, ~silent) if np.any(silent) else samples


def drowned(samples: FieldSamples) -> BoolArray:
    """Tell which phasors no beacon would be told from noise in, shape (n, channels).

    Among those that `without_silence` leaves out: were the beacon as loud as usual there, the noise
    would hide it, as fast motion beside another coil does before it is compensated.
    """
    heard = detected(samples, DETECTION_CHI_SQUARE_ONLINE)
    power = np.where(heard, np.nansum(np.abs(samples.phasor_sensor) ** 2, axis=-1), np.nan)
    usual = np.nanmedian(np.where(heard.any(axis=0), power, 0.0), axis=0)
    share = np.sum(whitening(samples.phasor_cov, samples.there) ** 2, axis=(-1, -2)) / 3.0
    return np.asarray(samples.valid & ~heard & (usual * share <= DETECTION_CHI_SQUARE_ONLINE))


def above_noise(samples: FieldSamples, least: float) -> BoolArray:
    """Tell which phasors have more than so much of chi square against nothing, (n, channels)."""
    there = samples.there
    phasor = np.where(there, samples.phasor_sensor, 0.0)
    parts = np.stack([phasor.real, phasor.imag], axis=-1)
    white = whitening(samples.phasor_cov, there) @ parts
    return np.asarray(samples.valid & (np.sum(white**2, axis=(-1, -2)) > least))


def detected(samples: FieldSamples, least: float = DETECTION_CHI_SQUARE) -> BoolArray:
    """Tell which phasors are of a beacon, shape (n, channels): more than noise, and for longer.

    A window in which a beacon falls silent, or begins, holds a part of its tone that nothing tells;
    those that overlap a window without the beacon are therefore not of it.

    Parameters
    ----------
    least : float
        Chi square of a phasor's six components against nothing.
    """
    # What lies across the axes that a receiver has looks like silence.
    loud = above_noise(samples, least) | samples.partial
    if len(samples) < 2:
        return loud
    step = float(np.median(np.diff(samples.time)))
    reach = int(np.ceil(np.median(samples.window) / step - 1e-6))
    whole = np.ones((2 * reach + 1, 1), dtype=bool)
    # What an epoch does not hold has not fallen silent.
    return loud & np.asarray(binary_erosion(loud | ~samples.valid, whole, border_value=1))


def only(samples: FieldSamples, channels: BoolArray) -> FieldSamples:
    """Return samples with the other channels missing."""
    return replace(
        samples, phasor_sensor=np.where(channels[..., None], samples.phasor_sensor, np.nan)
    )


class DetectionFilter:
    """Follows which channels are detected, epoch by epoch.

    A beacon that appears is left out until a window contains nothing of its silence; one that
    disappears is refused by the gate, which knows what to expect of it.
    """

    _detected_for: IntArray | None  # epochs in a row, by channel

    def __init__(self) -> None:
        self._detected_for = None

    def of(self, samples: FieldSamples, step: float) -> FieldSamples:
        """Return an epoch's samples without the beacons that are not detected.

        Parameters
        ----------
        samples : FieldSamples
            One epoch.
        step : float
            Since the epoch before (s).
        """
        loud, valid = detected(samples, DETECTION_CHI_SQUARE_ONLINE), samples.valid[0]
        reach = int(np.ceil(samples.window[0] / step - 1e-6))
        if self._detected_for is None:
            self._detected_for = np.full(loud.shape[1], reach)
        # What an epoch does not hold (another slot's tone) has not fallen silent.
        counted = np.where(loud[0], self._detected_for + 1, 0)
        self._detected_for = np.where(valid, counted, self._detected_for)
        kept = loud & (self._detected_for > reach)
        return samples if np.all(kept) else only(samples, kept)
