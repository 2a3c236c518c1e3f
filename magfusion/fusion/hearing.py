"""Which beacons are heard: a receiver gives a phasor for every tone, also where there is none."""

from dataclasses import replace

import numpy as np
from scipy.ndimage import binary_erosion

from magfusion.records.samples import FieldSamples
from magfusion.units import BoolArray, IntArray
from magfusion.weights import whitening

HEARD = 100.0  # chi square of six components; of a log that is smoothed with the Earth field
HEARD_ONLINE = 40.0  # a weak beacon is worth more than a wrong one costs, which the gate refuses


def heard(samples: FieldSamples, least: float = HEARD) -> BoolArray:
    """Tell which phasors are of a beacon, shape (n, channels): more than noise, and for longer.

    A window in which a beacon falls silent, or begins, holds a part of its tone that nothing tells;
    those that overlap a window without the beacon are therefore not of it.

    Parameters
    ----------
    samples : FieldSamples
    least : float
        Chi square of a phasor's six components against nothing.
    """
    root = whitening(samples.phasor_cov, samples.valid)
    phasor = np.nan_to_num(samples.phasor_sensor)[..., None]
    square = np.abs(root @ phasor.real) ** 2 + np.abs(root @ phasor.imag) ** 2
    loud = samples.valid & (np.sum(square, axis=(-1, -2)) > least)
    if len(samples) < 2:
        return np.asarray(loud)
    step = float(np.median(np.diff(samples.time)))
    reach = int(np.ceil(np.median(samples.window) / step - 1e-6))
    whole = np.ones((2 * reach + 1, 1), dtype=bool)
    return np.asarray(binary_erosion(loud, whole, border_value=1))


def only(samples: FieldSamples, channels: BoolArray) -> FieldSamples:
    """Return samples with the other channels missing."""
    return replace(
        samples, phasor_sensor=np.where(channels[..., None], samples.phasor_sensor, np.nan)
    )


class Hearing:
    """Follows which channels are heard, epoch by epoch.

    A beacon that begins to be heard is passed over until a window holds nothing of its silence; one
    that ends is for the gate, which knows what to expect of it.
    """

    def __init__(self) -> None:
        self._heard_for: IntArray | None = None  # epochs in a row, by channel

    def of(self, samples: FieldSamples, step: float) -> FieldSamples:
        """Return an epoch's samples without the beacons that are not heard.

        Parameters
        ----------
        samples : FieldSamples
            One epoch.
        step : float
            Since the epoch before (s).
        """
        loud = heard(samples, HEARD_ONLINE)
        reach = int(np.ceil(samples.window[0] / step - 1e-6))
        if self._heard_for is None:
            self._heard_for = np.full(loud.shape[1], reach)
        # What an epoch does not hold (another slot's tone) has not fallen silent.
        counted = np.where(loud[0], self._heard_for + 1, 0)
        self._heard_for = np.where(samples.valid[0], counted, self._heard_for)
        return only(samples, loud & (self._heard_for > reach))
