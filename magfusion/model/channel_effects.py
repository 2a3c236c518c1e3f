"""What is known of each channel beside moments and phases: temperature, current, response.

A channel is a tone of a beacon; what is said here is the same for the three components of its
phasor.
"""

import numpy as np

from magfusion.model.site import Site
from magfusion.units import Array


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
    """Return how the magnetometer answers to each channel's frequency: log-gain and phase (rad).

    Each of shape (channels,); None where all are measured as they are.
    """
    response = site.platform.magnetometer.response
    if response is None or not site.beacons:
        return None
    return response.at(np.concatenate([b.tone_frequencies_hz for b in site.beacons]))


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
    return np.stack(parts, axis=-1)
