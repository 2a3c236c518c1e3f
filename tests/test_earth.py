"""The Earth's field and gravity against published values."""

import datetime

import numpy as np
import pytest

from magfusion.errors import InputError
from magfusion.model.physics.earth import earth_field_world, gravity
from magfusion.units import NANOTESLA

# World Magnetic Model 2020, technical report, table of test values: north, east, down in nT.  It
# is a model made from other satellites' data by another agency; the two agree to some 60 nT.
WMM_2020 = [
    (80.0, 0.0, 0.0, datetime.date(2020, 1, 1), (6570.4, -146.3, 54606.0)),
    (0.0, 120.0, 0.0, datetime.date(2020, 1, 1), (39624.3, 109.9, -10932.5)),
    (-80.0, 240.0, 100e3, datetime.date(2022, 7, 2), (5815.0, 14803.0, -49755.3)),
]


@pytest.mark.parametrize(("latitude", "longitude", "height", "date", "north_east_down"), WMM_2020)
def test_the_field_agrees_with_the_world_magnetic_model(
    latitude, longitude, height, date, north_east_down
):
    north, east, down = north_east_down
    field_nt = earth_field_world(latitude, longitude, height, date) / NANOTESLA
    assert np.linalg.norm(field_nt - [east, north, -down]) < 100.0  # nT of some 50 000


def test_the_field_of_a_datetime_is_that_of_its_day():
    day, hour = datetime.date(2024, 5, 6), datetime.datetime(2024, 5, 6, 17, 30)
    same = earth_field_world(48.0, 11.0, 500.0, hour) == earth_field_world(48.0, 11.0, 500.0, day)
    assert same.all()


@pytest.mark.parametrize(
    ("latitude", "longitude", "height", "date", "place"),
    [
        (90.1, 0.0, 0.0, datetime.date(2020, 1, 1), "latitude_deg"),
        (float("nan"), 0.0, 0.0, datetime.date(2020, 1, 1), "latitude_deg"),
        (0.0, 361.0, 0.0, datetime.date(2020, 1, 1), "longitude_deg"),
        (0.0, 0.0, 2e6, datetime.date(2020, 1, 1), "height_m"),
        (0.0, 0.0, 0.0, datetime.date(1899, 12, 31), "date"),
        (0.0, 0.0, 0.0, datetime.date(2030, 1, 2), "date"),
    ],
)
def test_a_place_or_date_outside_the_model_is_refused_by_name(
    latitude, longitude, height, date, place
):
    with pytest.raises(InputError, match=place):
        earth_field_world(latitude, longitude, height, date)


def test_gravity_takes_the_wgs84_values_at_equator_and_pole():
    # NIMA TR8350.2, table 3.4: 9.7803253359 and 9.8321849378 m/s^2
    assert gravity(0.0, 0.0) == pytest.approx(9.7803253359, abs=1e-10)
    assert gravity(90.0, 0.0) == pytest.approx(9.8321849378, abs=1e-9)
    assert gravity(-90.0, 0.0) == gravity(90.0, 0.0)


def test_gravity_falls_by_0_3086_milligal_per_metre():
    slope = (gravity(45.0, 100.0) - gravity(45.0, 0.0)) / 100.0
    assert slope == pytest.approx(-3.086e-6, rel=1e-3)  # 1/s^2, the free-air gradient
