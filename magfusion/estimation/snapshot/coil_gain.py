"""Initial estimate of an unknown coil gain for a smoother, from single epochs."""

from dataclasses import replace

import numpy as np

from magfusion.errors import EstimationError
from magfusion.estimation.data_checks.statistics import MAD_TO_SIGMA
from magfusion.estimation.snapshot.coil_fix import UNKNOWNS, Gain, fix_coil
from magfusion.estimation.snapshot.coil_starts import CoilEpochs
from magfusion.model.parameters import initial_calibration
from magfusion.model.samples import FieldSamples
from magfusion.model.site import Site

MAX_EPOCHS = 60  # epochs, spread over a log
MIN_COUNT = 5  # of them, that determine a gain
MIN_SIGMA = 0.01  # of the logarithm; model errors are common to all epochs


def with_found_gain(fields: FieldSamples, site: Site) -> Site:
    """Return a site whose one axis has the gain estimated from its epochs, with their scatter.

    Its declared value is not used; the smoother estimates it further, from that prior. `fields`:
    channels in the site's order. Raises EstimationError where too few epochs determine a gain.
    """
    sensor = site.platform.magnetometer
    epochs = CoilEpochs.of(fields, site)
    enough = np.flatnonzero(epochs.number_count >= UNKNOWNS)
    log_gain = np.zeros(0)
    if len(enough):
        kept = np.zeros(len(epochs), dtype=bool)
        kept[enough[:: max(1, len(enough) // MAX_EPOCHS)]] = True
        some = epochs.rows(kept)
        calibration = initial_calibration(site, float(np.mean(some.time)))
        result = fix_coil(some, calibration, Gain())
        size = np.linalg.norm(result.axis_world[:, 0], axis=1)
        log_gain = np.log(size[result.determined[:, 0]])
    if len(log_gain) < MIN_COUNT:
        raise EstimationError(
            f"{len(log_gain)} epochs determine the gain of the coil together with its position and"
            f" direction; {MIN_COUNT} are needed: add beacons, or declare the gain as"
            " magnetometer.matrix"
        )
    middle = float(np.median(log_gain))
    scatter = MAD_TO_SIGMA * float(np.median(np.abs(log_gain - middle)))
    row = "xyz".index(sensor.axes)
    factor = np.exp(middle) / np.linalg.norm(sensor.matrix[row])
    matrix, sigma = sensor.matrix.copy(), sensor.sigma.matrix.copy()
    matrix[row] *= factor
    sigma[row] *= factor
    sigma[row, row] = max(scatter, MIN_SIGMA) * np.exp(middle)
    known = replace(sensor, matrix=matrix, sigma=replace(sensor.sigma, matrix=sigma))
    return replace(site, platform=replace(site.platform, magnetometer=known))
