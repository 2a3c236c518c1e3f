"""Depth of a log in conducting ground, in skin depths, by the strength of its fields alone."""

import numpy as np

from magfusion.errors import InputError
from magfusion.estimation.data_checks.detection import detected
from magfusion.model.ground import (
    DEEPEST,
    conductivity_of,
    range_of_strength,
    skin_depth_count,
    sphere,
)
from magfusion.model.samples import FieldSamples
from magfusion.model.site import Site

DIRECTIONS, EPOCHS = 24, 50


def depths_of(samples: FieldSamples, site: Site) -> dict[str, tuple[float, float]]:
    """Return range (m) and skin depths of each detected beacon, within a sixth.

    Medians over the log and all directions; empty where the ground does not conduct.
    """
    result: dict[str, tuple[float, float]] = {}
    if not conductivity_of(site):
        return result
    gains = np.linalg.inv(site.platform.magnetometer.matrix).T
    received, direction, start = detected(samples), sphere(DIRECTIONS), 0
    for beacon in site.beacons:
        rows = slice(start, start + len(beacon.tones))
        start = rows.stop
        epochs = np.flatnonzero(received[:, rows].all(axis=1))
        some = epochs[:: -(-len(epochs) // EPOCHS) or 1]
        if len(some):
            phasor = samples.phasor_sensor[some, rows] @ gains
            distance = float(np.median(range_of_strength(beacon, phasor, direction)))
            result[beacon.name] = distance, float(skin_depth_count(beacon, np.array(distance)))
    return result


def refuse_too_deep(samples: FieldSamples, site: Site) -> None:
    """Raise an error for a log whose fields depend more on the ground than on the position."""
    for name, (distance, depths) in depths_of(samples, site).items():
        if depths * np.exp(-0.5 * site.log_conductivity_sigma) > DEEPEST:
            raise InputError(
                f"beacon {name} is about {distance:.0f} m away, {depths:.1f} skin depths in ground"
                f" of {conductivity_of(site):g} S/m; beyond {DEEPEST:g} its field depends more on"
                " the ground than on the position; reduce its frequency or the distance, or omit it"
            )
