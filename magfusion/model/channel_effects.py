"""Effects on a channel besides moment and phase: temperature, current, frequency response.

A channel is a tone of a beacon; the effects are equal for the three components of its phasor.
"""

import numpy as np

from magfusion.model.response import AxisResponses, FrequencyResponse
from magfusion.model.site import Site
from magfusion.units import Array, ComplexArray


def are_driven(site: Site) -> bool:
    """Return whether currents of a site's beacons were recorded."""
    return site.drives is not None and bool(site.drives.readings)


def driven(site: Site, time: Array) -> tuple[Array, Array] | None:
    """Return the effect of recorded currents on channels.

    `time` (...) (s). Returns (..., channels) each: increase of the logarithms of amplitudes, and
    phase lead against those declared (rad); None where no current was recorded.
    """
    if not are_driven(site):
        return None
    assert site.drives is not None
    none = np.zeros(np.shape(time)), np.zeros(np.shape(time))
    parts = [site.drives.at(name, tone, time) or none for name, tone in site.channels]
    sizes, angles = zip(*parts, strict=True)
    return np.stack(sizes, axis=-1), np.stack(angles, axis=-1)


def responded(site: Site) -> tuple[Array, Array] | None:
    """Return the response of the magnetometers at each channel: log-gain and phase (rad).

    Each of shape (channels,); None if all have a unit response.  For axes with different
    responses, see `axis_factors`.
    """
    sensors = site.platform.magnetometers
    shared = [s.response if isinstance(s.response, FrequencyResponse) else None for s in sensors]
    if all(response is None for response in shared) or not site.beacons:
        return None
    frequencies_hz = site.tone_frequencies_hz
    none = np.zeros_like(frequencies_hz)
    parts = [(none, none) if r is None else r.at(frequencies_hz) for r in shared]
    if len(parts) == 1:
        return parts[0]
    sizes, phases = zip(*parts, strict=True)
    return np.concatenate(sizes), np.concatenate(phases)


def axis_factors(site: Site) -> ComplexArray | None:
    """Return the response of each axis at each channel relative to `responded`, (channels, 3).

    None if no magnetometer has axes with different responses.
    """
    sensors = site.platform.magnetometers
    if not site.beacons or not any(isinstance(s.response, AxisResponses) for s in sensors):
        return None
    frequencies_hz = site.tone_frequencies_hz
    shared = np.ones((len(frequencies_hz), 3), dtype=np.complex128)
    return np.concatenate(
        [
            s.response.factor(frequencies_hz) if isinstance(s.response, AxisResponses) else shared
            for s in sensors
        ]
    )


def of_all_sensors(site: Site, by_tone: Array) -> Array:
    """Repeat a quantity of the channels (...) of one magnetometer for all of them."""
    count = len(site.platform.magnetometers)
    return by_tone if count == 1 else np.concatenate([by_tone] * count, axis=-1)


def warmed(site: Site, time: Array) -> Array | None:
    """Return the increase of the logarithm of each channel's moments by temperature.

    `time` (...) (s). Returns (..., channels); None where no coefficient is declared, or no
    temperature measured.
    """
    known = site.temperatures
    if known is None or all(beacon.temperature_model is None for beacon in site.beacons):
        return None
    parts = []
    for beacon in site.beacons:
        degc = None if beacon.temperature_model is None else known.at(beacon.name, time)
        own = np.zeros(np.shape(time))
        if beacon.temperature_model is not None and degc is not None:
            own = beacon.temperature_model.log_moment_per_k * (
                degc - beacon.temperature_model.reference_degc
            )
        parts += [own] * len(beacon.tones)
    return of_all_sensors(site, np.stack(parts, axis=-1))
