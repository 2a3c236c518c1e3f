"""Frequency response of simulated magnetometers, and the channels of each."""

import numpy as np

from magfusion.model.response import AxisResponses, FrequencyResponse
from magfusion.model.site import Site
from magfusion.units import Array, ComplexArray


def answered(
    phasor: ComplexArray, response: FrequencyResponse | AxisResponses | None, frequency_hz: Array
) -> ComplexArray:
    """Return the response of a magnetometer to tones, shape (n, tones, 3).

    `phasor` (n, tones, 3): as measured with a flat response (T). `frequency_hz` (tones,).
    """
    if response is None:
        return phasor
    axes = response.axes if isinstance(response, AxisResponses) else (response,) * 3
    out = phasor.copy()
    for k, axis in enumerate(axes):
        tone = np.log(np.maximum(frequency_hz, 1e-300))
        known = np.log(axis.frequency_hz)
        gain = np.exp(np.interp(tone, known, np.log(axis.gain)))
        turn = np.interp(tone, known, axis.phase)
        out[..., k] *= np.where(frequency_hz == 0.0, 1.0, gain * np.exp(1j * turn))
    return out


def names_by_channel(site: Site) -> tuple[str, ...]:
    """Return the magnetometer of each channel; empty for a single magnetometer."""
    sensors = site.platform.magnetometers
    count = len(site.channels) // len(sensors)
    if len(sensors) == 1:
        return ()
    return tuple(sensor.name for sensor in sensors for _ in range(count))
