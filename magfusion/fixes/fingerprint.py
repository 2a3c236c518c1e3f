"""Position from a fingerprint survey: paper 004, algorithms 2 and 3, corrected.

A survey is cut into what the algorithms compare: the amplitude of each beacon at each point, root
mean square over time.  None of them knows the field's model, so that what the model does not know
(coil size, steel) troubles them only between the points of the survey.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from magfusion.errors import InputError
from magfusion.fixes.rssi import distances, fit_lines, trilaterate_from_both_sides
from magfusion.records.survey import Survey
from magfusion.site import Site
from magfusion.units import NANOTESLA, Array, ComplexArray, IntArray

NEIGHBOURS = 4  # n of paper 004, section 2.4


@dataclass(frozen=True, eq=False)
class FingerprintDatabase:
    """Amplitudes of beacons at points with known positions.

    Parameters
    ----------
    beacons : tuple of str
    beacons_world : ndarray, shape (beacons, 3)
        (m)
    position_world : ndarray, shape (points, 3)
        Of the sensor (m).
    amplitude : ndarray, shape (points, beacons)
        Root mean square over time (T); NaN where a beacon was not heard.
    """

    beacons: tuple[str, ...]
    beacons_world: Array
    position_world: Array
    amplitude: Array

    def __len__(self) -> int:
        return len(self.position_world)

    def hearing(self, columns: IntArray) -> "FingerprintDatabase":
        """Return the points that hear all of some beacons, with no others."""
        amplitude = self.amplitude[:, columns]
        complete = np.isfinite(amplitude).all(axis=1)
        return FingerprintDatabase(
            tuple(self.beacons[c] for c in columns),
            self.beacons_world[columns],
            self.position_world[complete],
            amplitude[complete],
        )


def fingerprint_database(survey: Survey, site: Site) -> FingerprintDatabase:
    """Return the fingerprints of a survey, of the site's beacons that it names.

    The survey's poses are of the body; fingerprints belong to the sensor.

    Raises
    ------
    InputError
        Where the survey names a beacon or a tone that the site does not know.
    """
    unknown = [channel for channel in survey.channels if channel not in site.channels]
    if unknown:
        beacon, tone = unknown[0]
        known = ", ".join(b.name for b in site.beacons)
        raise InputError(
            f"the survey holds beacon {beacon} tone {tone}, which the site does not know (it knows"
            f" {known}); give the site in which it was made."
        )
    sensor = site.platform.magnetometer
    heard = [b for b in site.beacons if any(name == b.name for name, _ in survey.channels)]
    amplitude = [_of_beacon(survey, site, b.name) for b in heard]
    return FingerprintDatabase(
        beacons=tuple(b.name for b in heard),
        beacons_world=np.array([b.position_world for b in heard]),
        position_world=survey.position_world + survey.world_from_body @ sensor.position_body,
        amplitude=np.stack(amplitude, axis=1),
    )


def _of_beacon(survey: Survey, site: Site, name: str) -> Array:
    own = [c for c, (beacon, _) in enumerate(survey.channels) if beacon == name]
    if survey.phasor_sensor is None:
        assert survey.amplitude is not None
        return np.asarray(np.sqrt(np.sum(survey.amplitude[:, own] ** 2, axis=1)))
    return amplitude_of(calibrated(survey.phasor_sensor[:, own], site))


def calibrated(phasor_sensor: ComplexArray, site: Site) -> ComplexArray:
    """Return measured phasors (..., 3) with the magnetometer's matrix undone (T)."""
    return np.asarray(phasor_sensor @ np.linalg.inv(site.platform.magnetometer.matrix).T)


def amplitude_of(phasor: ComplexArray) -> Array:
    """Return the amplitude of one beacon from the phasors of its tones (..., tones, 3).

    Root mean square over time (T), shape (...): the RSSI of paper 004.
    """
    return np.asarray(np.sqrt(0.5 * np.sum(np.abs(phasor) ** 2, axis=(-1, -2))))


def nearest(
    database: FingerprintDatabase, amplitude: Array, neighbours: int, *, logarithmic: bool = True
) -> tuple[Array, IntArray]:
    """Return the fingerprints most like each measurement (paper 004, Eq 25-26).

    Parameters
    ----------
    database : FingerprintDatabase
        Complete (`FingerprintDatabase.hearing`), with as many points as neighbours at least.
    amplitude : ndarray, shape (n, beacons)
        (T)
    neighbours : int
    logarithmic : bool
        Compare logarithms; else nanotesla, where the nearest beacon outweighs all others.

    Returns
    -------
    difference : ndarray, shape (n, neighbours)
        Euclidean, least first (dimensionless, or nT).
    point : ndarray of int, shape (n, neighbours)
    """
    ours, theirs = (
        np.log(a) if logarithmic else a / NANOTESLA for a in (database.amplitude, amplitude)
    )
    difference, point = KDTree(ours).query(theirs, np.arange(1, neighbours + 1))
    return np.asarray(difference), np.asarray(point, dtype=np.int64)


def locate_by_neighbours(
    database: FingerprintDatabase,
    amplitude: Array,
    neighbours: int = NEIGHBOURS,
    *,
    logarithmic: bool = True,
) -> Array:
    """Return the mean of the nearest fingerprints' positions, weighted by their likeness.

    Paper 004, algorithm 2, Eq 27.  The paper prints it with amplitudes, in nT
    (``logarithmic=False``), but its result needs the logarithms: with a survey of 0.5 m the
    printed form errs four times as much.

    Parameters
    ----------
    database, amplitude, neighbours, logarithmic
        As `nearest`.

    Returns
    -------
    ndarray, shape (n, 3)
        Of the sensor (m); the fingerprint's own position where one is met exactly, for which
        Eq 27 is 0 / 0.
    """
    difference, point = nearest(database, amplitude, neighbours, logarithmic=logarithmic)
    met = difference == 0.0
    share = np.where(met.any(axis=1, keepdims=True), met, 1.0 / np.where(met, 1.0, difference))
    share = share / np.sum(share, axis=1, keepdims=True)
    return np.asarray(np.einsum("nj,njx->nx", share, database.position_world[point]))


def locate_by_differential_range(
    database: FingerprintDatabase,
    amplitude: Array,
    neighbours: int = NEIGHBOURS,
    slope: Array | None = None,
) -> Array:
    """Return the position by ranges that the nearest fingerprints give, each by itself.

    Paper 004, algorithm 3, the improved fingerprint matching.  Eq 28 as printed makes of a
    difference of logarithms a range of twenty metres: the intercept cancels in it, and what is left
    is a ratio of ranges, here the right way up, that needs the fingerprint's own range.  Eq 29
    takes the mean over beacons for a distance to a fingerprint; the mean over fingerprints is a
    distance to a beacon::

        r_i(j) = |P_j - M_i| exp((ln F_t,i - ln F_j,i) / k_i)
        min_P  sum_i (|P - M_i| - mean_j r_i(j))^2

    Parameters
    ----------
    database, amplitude, neighbours
        As `nearest`.
    slope : ndarray, shape (beacons,), optional
        k of each beacon's line; that of all fingerprints where it is not given.

    Returns
    -------
    ndarray, shape (n, 3)
        Of the sensor (m).

    Raises
    ------
    EstimationError
        Where the trilateration does not converge.
    """
    _, point = nearest(database, amplitude, neighbours)
    reach = distances(database.position_world, database.beacons_world)
    if slope is None:
        slope = fit_lines(reach, database.amplitude).slope
    ratio = np.exp((np.log(amplitude)[:, None] - np.log(database.amplitude[point])) / slope)
    ranges = np.mean(reach[point] * ratio, axis=1)
    start = np.mean(database.position_world[point], axis=1)
    return trilaterate_from_both_sides(ranges, database.beacons_world, start)
