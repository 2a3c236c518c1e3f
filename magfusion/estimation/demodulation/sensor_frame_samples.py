"""Raw data as the estimator uses them: on the magnetometer's own axes, at one temperature."""

from dataclasses import replace

import numpy as np

from magfusion.estimation.demodulation.temperature_compensation import (
    at_reference_temperature,
    fields_at_reference_temperature,
)
from magfusion.estimation.measurements.signs import along_axis
from magfusion.model.samples import FieldSamples
from magfusion.model.site import Site
from magfusion.units import Array


def sensor_frame_samples(site: Site, time: Array, measured_sensor: Array) -> Array:
    """Return raw samples (k, 3) (T) without placeholders of missing axes."""
    known, sensor = site.temperatures, site.platform.magnetometer
    if sensor.lacking:
        measured_sensor = np.array(measured_sensor, dtype=np.float64)
        measured_sensor[..., sensor.lacking] = 0.0
    return at_reference_temperature(known, sensor, time, measured_sensor)


def sensor_frame_phasors(site: Site, samples: FieldSamples) -> FieldSamples:
    """Return phasors without placeholders of missing axes."""
    known, sensor = site.temperatures, site.platform.magnetometer
    samples = along_axis(samples, site)
    if sensor.lacking:
        phasor = samples.phasor_sensor.copy()
        phasor[..., sensor.lacking] = np.nan
        samples = replace(samples, phasor_sensor=phasor, axes=sensor.axes)
    return fields_at_reference_temperature(known, sensor, samples)
