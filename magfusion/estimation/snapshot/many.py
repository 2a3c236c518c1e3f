"""Fixes among many beacons: each stretch of epochs with its detected beacons only."""

from collections.abc import Callable

import numpy as np

from magfusion.estimation.snapshot.fix import Fixes, Gravity
from magfusion.estimation.snapshot.refine import joined
from magfusion.model.parameters import Calibration, channels_of, of_beacons, samples_of, stretches
from magfusion.model.samples import FieldSamples
from magfusion.units import Array, IntArray

Part = tuple[slice, IntArray, FieldSamples, Calibration, Gravity | None]


def parts_detected(
    samples: FieldSamples, calibration: Calibration, gravity: Gravity | None
) -> list[Part]:
    """Return stretches of epochs: rows, beacons, and the arguments restricted to them."""
    site, out = calibration.site, []
    for rows, detected in stretches(site, samples.valid):
        beacons = detected if len(detected) else np.zeros(1, dtype=np.int64)
        some = samples_of(samples.rows(rows), channels_of(site, beacons))
        known = of_beacons(calibration, beacons)
        out.append((rows, beacons, some, known, None if gravity is None else gravity.rows(rows)))
    return out


def fix_parts(
    parts: list[Part],
    calibration: Calibration,
    fixed: Callable[[slice, FieldSamples, Calibration, Gravity | None], Fixes],
) -> Fixes:
    """Return the fixes of all stretches, with all channels of the site."""
    site, result = calibration.site, []
    for rows, beacons, some, known, up in parts:
        result.append(
            whole_fixes(fixed(rows, some, known, up), calibration, channels_of(site, beacons))
        )
    maximum = max(fixes.cost.shape[1] for fixes in result)
    return joined([fixes.padded(maximum) for fixes in result])


def whole_fixes(fixes: Fixes, calibration: Calibration, channels: IntArray) -> Fixes:
    """Expand fixes of some channels to all channels; the others are as declared."""
    values = dict(vars(fixes))
    for name in ("phase", "log_gain"):
        every = np.zeros((*fixes.cost.shape, len(calibration.site.channels)))
        every[..., channels] = getattr(fixes, name)
        values[name] = every
    return Fixes(**values)


def some_fixes(fixes: Fixes, rows: slice, channels: IntArray) -> Fixes:
    """Return the fixes of a stretch, restricted to some channels."""
    values = dict(vars(fixes.rows(rows)))
    for name in ("phase", "log_gain"):
        values[name] = values[name][..., channels]
    return Fixes(**values)


def by_beacon(result: list[tuple[Array, IntArray]], beacons: int) -> Array:
    """Expand values of some beacons at each stretch to all, zero for others, (n, beacons)."""
    out = []
    for own, numbers in result:
        every = np.zeros((len(own), beacons))
        every[:, numbers] = own
        out.append(every)
    return np.concatenate(out)
