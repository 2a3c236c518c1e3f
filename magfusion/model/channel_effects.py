"""What is known of each channel beside moments and phases: temperature, current, response.

A channel is a tone of a beacon; what is said here is the same for the three components of its
phasor.
"""

import numpy as np

from magfusion.model.response import AxisResponses, FrequencyResponse
from magfusion.model.site import Site
from magfusion.units import Array, ComplexArray


def are_driven(site: Site) -> bool:
    """Return whether anything is known of the currents of a site's beacons."""
    return site.drives is not None and bool(site.drives.readings)


def driven(site: Site, time: Array) -> tuple[Array, Array] | None:
    """Return what recorded currents do to channels.

    Parameters
    ----------
    time : ndarray, shape (...)
        (s)

    Returns
    -------
    tuple of ndarray, or None, each of shape (..., channels)
        By how much they raise the logarithms of amplitudes, and by which phases they are ahead of
        those declared (rad); None where no current was recorded.
    """
    if not are_driven(site):
        return None
    assert site.drives is not None
    none = np.zeros(np.shape(time)), np.zeros(np.shape(time))
    parts = [site.drives.at(name, tone, time) or none for name, tone in site.channels]
    sizes, angles = zip(*parts, strict=True)
    return np.stack(sizes, axis=-1), np.stack(angles, axis=-1)


def responded(site: Site) -> tuple[Array, Array] | None:
    """Return how the magnetometers answer to each channel's frequency: log-gain and phase (rad).

    Each of shape (channels,); None where all are measured as they are.  Of axes that answer each in
    its own way, see `axis_factors`.
    """
    sensors = site.platform.magnetometers
    alike = [s.response if isinstance(s.response, FrequencyResponse) else None for s in sensors]
    if all(response is None for response in alike) or not site.beacons:
        return None
    frequencies_hz = site.tone_frequencies_hz
    none = np.zeros_like(frequencies_hz)
    parts = [(none, none) if r is None else r.at(frequencies_hz) for r in alike]
    if len(parts) == 1:
        return parts[0]
    sizes, phases = zip(*parts, strict=True)
    return np.concatenate(sizes), np.concatenate(phases)


def axis_factors(site: Site) -> ComplexArray | None:
    """Return what each axis measures of a channel's field beyond `responded`, (channels, 3).

    None where no magnetometer has axes that answer each in its own way.
    """
    sensors = site.platform.magnetometers
    if not site.beacons or not any(isinstance(s.response, AxisResponses) for s in sensors):
        return None
    frequencies_hz = site.tone_frequencies_hz
    alike = np.ones((len(frequencies_hz), 3), dtype=np.complex128)
    return np.concatenate(
        [
            s.response.factor(frequencies_hz) if isinstance(s.response, AxisResponses) else alike
            for s in sensors
        ]
    )


def of_all_sensors(site: Site, by_tone: Array) -> Array:
    """Return what is of the channels (...) of any magnetometer for all of them."""
    count = len(site.platform.magnetometers)
    return by_tone if count == 1 else np.concatenate([by_tone] * count, axis=-1)


def warmed(site: Site, time: Array) -> Array | None:
    """Return by how much temperature raises the logarithm of each channel's moments.

    Parameters
    ----------
    time : ndarray, shape (...)
        (s)

    Returns
    -------
    ndarray or None, shape (..., channels)
        None where nothing is declared of it, or nothing measured.
    """
    known = site.temperatures
    if known is None or all(beacon.warming is None for beacon in site.beacons):
        return None
    parts = []
    for beacon in site.beacons:
        degc = None if beacon.warming is None else known.at(beacon.name, time)
        own = np.zeros(np.shape(time))
        if beacon.warming is not None and degc is not None:
            own = beacon.warming.log_moment_per_k * (degc - beacon.warming.reference_degc)
        parts += [own] * len(beacon.tones)
    return of_all_sensors(site, np.stack(parts, axis=-1))
