"""Position from a fingerprint survey: paper 004, algorithms 2 and 3, corrected.

A survey is reduced to what the algorithms compare: the amplitude of each beacon at each point, root
mean square over time.  They do not use the field's model, so that unmodelled effects (coil size,
steel) affect them only between the points of the survey.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from magfusion.errors import InputError
from magfusion.files.survey import Survey
from magfusion.model.site import Site
from magfusion.papers.p004_fingerprints.equations import (
    distances,
    eq_25_fingerprint,
    eq_27_position,
    eq_28_range,
)
from magfusion.papers.p004_fingerprints.rssi import fit_lines, trilaterate_from_both_sides
from magfusion.units import NANOTESLA, Array, ComplexArray, IntArray

NEIGHBOURS = 4  # n of paper 004, section 2.4


@dataclass(frozen=True, eq=False)
class FingerprintDatabase:
    """Amplitudes of beacons at points with known positions."""

    beacons: tuple[str, ...]
    beacons_world: Array  # (beacons, 3) (m)
    position_world: Array  # (points, 3), of the sensor (m)
    # (points, beacons), root mean square over time (T); NaN where a beacon was not detected
    amplitude: Array

    def __len__(self) -> int:
        return len(self.position_world)

    def detecting(self, columns: IntArray) -> "FingerprintDatabase":
        """Return the points where all given beacons were detected, with these beacons alone."""
        amplitude = self.amplitude[:, columns]
        complete = np.isfinite(amplitude).all(axis=1)
        return FingerprintDatabase(
            tuple(self.beacons[c] for c in columns),
            self.beacons_world[columns],
            self.position_world[complete],
            amplitude[complete],
        )


def fingerprint_database(survey: Survey, site: Site) -> FingerprintDatabase:
    """Return the fingerprints of a survey, for the site's beacons in it.

    The survey's poses are of the body; fingerprints belong to the sensor. Raises InputError where
    the survey has a beacon or a tone that is not in the site.
    """
    unknown = [channel for channel in survey.channels if channel not in site.channels]
    if unknown:
        beacon, tone = unknown[0]
        known = ", ".join(b.name for b in site.beacons)
        raise InputError(
            f"the survey has beacon {beacon} tone {tone}, which is not in the site (which has"
            f" {known}); give the site of the survey."
        )
    sensor = site.platform.magnetometer
    detected = [b for b in site.beacons if any(name == b.name for name, _ in survey.channels)]
    amplitude = [_of_beacon(survey, site, b.name) for b in detected]
    return FingerprintDatabase(
        beacons=tuple(b.name for b in detected),
        beacons_world=np.array([b.position_world for b in detected]),
        position_world=survey.position_world + survey.world_from_body @ sensor.position_body,
        amplitude=np.stack(amplitude, axis=1),
    )


def _of_beacon(survey: Survey, site: Site, name: str) -> Array:
    own = [c for c, (beacon, _) in enumerate(survey.channels) if beacon == name]
    if survey.phasor_sensor is None:
        assert survey.amplitude is not None
        return np.sqrt(np.sum(survey.amplitude[:, own] ** 2, axis=1))
    return eq_25_fingerprint(calibrated(survey.phasor_sensor[:, own], site))


def calibrated(phasor_sensor: ComplexArray, site: Site) -> ComplexArray:
    """Return measured phasors (..., 3) with the magnetometer's matrix inverted (T)."""
    return phasor_sensor @ np.linalg.inv(site.platform.magnetometer.matrix).T


def nearest(
    database: FingerprintDatabase, amplitude: Array, neighbours: int, *, logarithmic: bool = True
) -> tuple[Array, IntArray]:
    """Return differences and indices (n, k) of the points most similar to amplitudes (n, beacons).

    Euclidean, of logarithms or else in nT, where the nearest beacon outweighs all others; smallest
    first.  The database must be complete (`FingerprintDatabase.detecting`).
    """
    ours, others = (
        np.log(a) if logarithmic else a / NANOTESLA for a in (database.amplitude, amplitude)
    )
    difference, point = KDTree(ours).query(others, np.arange(1, neighbours + 1))
    return difference, point


def locate_by_neighbours(
    database: FingerprintDatabase,
    amplitude: Array,
    neighbours: int = NEIGHBOURS,
    *,
    logarithmic: bool = True,
) -> Array:
    """Return the positions (n, 3) of the sensor (m) by algorithm 2; arguments as in `nearest`.

    The paper uses amplitudes in nT (``logarithmic=False``).
    """
    difference, point = nearest(database, amplitude, neighbours, logarithmic=logarithmic)
    return eq_27_position(difference, database.position_world[point])


def locate_by_differential_range(
    database: FingerprintDatabase,
    amplitude: Array,
    neighbours: int = NEIGHBOURS,
) -> Array:
    """Return the positions (n, 3) of the sensor (m) by algorithm 3, with Eq 28 and 29 corrected.

    Ranges from each of the nearest fingerprints::

        r_i(j) = |P_j - M_i| exp((ln F_t,i - ln F_j,i) / k_i)
        min_P  sum_i (|P - M_i| - mean_j r_i(j))^2

    The slopes k (beacons,) are those of all fingerprints; arguments as in `nearest`.
    """
    _, point = nearest(database, amplitude, neighbours)
    reach = distances(database.position_world, database.beacons_world)
    slope = fit_lines(reach, database.amplitude).slope
    ranges = eq_28_range(reach[point], amplitude[:, None], database.amplitude[point], slope)
    start = np.mean(database.position_world[point], axis=1)
    return trilaterate_from_both_sides(np.mean(ranges, axis=1), database.beacons_world, start)
