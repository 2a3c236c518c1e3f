"""Earth's magnetic field and gravity at a location."""

import datetime

import numpy as np

from magfusion.errors import InputError
from magfusion.units import DEGREE, NANOTESLA, Array

IGRF_FIRST = datetime.date(1900, 1, 1)
IGRF_LAST = datetime.date(2030, 1, 1)
AMBIENT_SHARE = 0.005  # of the field's magnitude: usual disturbance per component, one sigma

# WGS84 (NIMA TR8350.2, tables 3.1 to 3.4): semi-major axis, flattening, first eccentricity
# squared, normal gravity at the equator, Somigliana's constant, and omega^2 a^2 b / GM.
_SEMI_MAJOR = 6378137.0  # m
_FLATTENING = 1.0 / 298.257223563
_ECCENTRICITY2 = 6.69437999014e-3
_EQUATOR_GRAVITY = 9.7803253359  # m/s^2
_SOMIGLIANA = 1.931852652458e-3
_CENTRIFUGAL_RATIO = 3.449786506841e-3


def earth_field_world(
    latitude_deg: float, longitude_deg: float, height_m: float, date: datetime.date
) -> Array:
    """Return the geomagnetic main field of the IGRF.

    `latitude_deg`, `longitude_deg`: geodetic (WGS84), north and east positive. `height_m`: above
    the ellipsoid. `date`: from 1900-01-01 to 2030-01-01. Returns (3,): flux density (T), axes east,
    north, up. Raises InputError if the place is not on the Earth or the date is outside the IGRF.
    """
    _check_place(latitude_deg, height_m)
    if not -360.0 <= longitude_deg <= 360.0:
        raise InputError(
            f"location.longitude_deg: found {longitude_deg}; give degrees from -180 to 360"
        )
    day = datetime.date(date.year, date.month, date.day)
    if not IGRF_FIRST <= day <= IGRF_LAST:
        raise InputError(
            f"location.date: found {day}; the IGRF is valid from {IGRF_FIRST} to {IGRF_LAST}: give"
            " a date in it, or earth_field_t instead of the location"
        )
    import ppigrf  # with pandas, a tenth of a command's start: for a site with a location alone

    midnight = datetime.datetime(day.year, day.month, day.day)
    east_north_up = ppigrf.igrf(longitude_deg, latitude_deg, height_m / 1e3, midnight)
    return np.array([float(np.squeeze(part)) for part in east_north_up]) * NANOTESLA


def gravity(latitude_deg: float, height_m: float) -> float:
    """Return normal gravity on WGS84: Somigliana's formula and the free-air term.

    `latitude_deg`: geodetic. `height_m`: above the ellipsoid. Returns (m/s^2); NIMA TR8350.2 (third
    edition), Eq 4-1 and 4-3. Raises InputError if the place is not on the Earth.
    """
    _check_place(latitude_deg, height_m)
    sine2 = np.sin(latitude_deg * DEGREE) ** 2
    surface = _EQUATOR_GRAVITY * (1 + _SOMIGLIANA * sine2) / np.sqrt(1 - _ECCENTRICITY2 * sine2)
    height = height_m / _SEMI_MAJOR
    slope = 1 + _FLATTENING + _CENTRIFUGAL_RATIO - 2 * _FLATTENING * sine2
    return float(surface * (1 - 2 * slope * height + 3 * height**2))


def east_north_up(
    latitude_deg: float, longitude_deg: float, height_m: float, origin: tuple[float, float, float]
) -> Array:
    """Return a position in the tangent plane of an origin, shape (3,) (m).

    `latitude_deg`, `longitude_deg`, `height_m`: on and above the ellipsoid WGS84. `origin`: the
    same of the world's origin.
    """
    latitude, longitude = origin[0] * DEGREE, origin[1] * DEGREE
    away = _earth_fixed(latitude_deg, longitude_deg, height_m) - _earth_fixed(*origin)
    east = np.array([-np.sin(longitude), np.cos(longitude), 0.0])
    up = np.array(
        [
            np.cos(latitude) * np.cos(longitude),
            np.cos(latitude) * np.sin(longitude),
            np.sin(latitude),
        ]
    )
    return np.stack([east, np.cross(up, east), up]) @ away


def _earth_fixed(latitude_deg: float, longitude_deg: float, height_m: float) -> Array:
    """Return a position in the axes of WGS84, shape (3,) (m)."""
    latitude, longitude = latitude_deg * DEGREE, longitude_deg * DEGREE
    curvature = _SEMI_MAJOR / np.sqrt(1.0 - _ECCENTRICITY2 * np.sin(latitude) ** 2)
    across = (curvature + height_m) * np.cos(latitude)
    along_axis = ((1.0 - _ECCENTRICITY2) * curvature + height_m) * np.sin(latitude)
    return np.array([across * np.cos(longitude), across * np.sin(longitude), along_axis])


def _check_place(latitude_deg: float, height_m: float) -> None:
    if not -90.0 <= latitude_deg <= 90.0:
        raise InputError(
            f"location.latitude_deg: found {latitude_deg}; give degrees from -90 to 90"
        )
    if not -1e4 <= height_m <= 1e6:
        raise InputError(
            f"location.height_m: found {height_m}; give metres above the ellipsoid "
            "from -10000 to 1000000"
        )
