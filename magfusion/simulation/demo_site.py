"""A demonstration room with four rotating beacons."""

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.model.site import (
    Beacon,
    BeaconSigma,
    Coil,
    ImuModel,
    Magnetometer,
    MagnetometerSigma,
    Platform,
    Site,
)
from magfusion.units import DEGREE, Array

MOMENT = 220.0  # A m^2

# Position (m) and roll, pitch, yaw (degrees) in a room of 6 m by 5 m; not in one plane.
_PLACES = {
    "A": ((0.0, 0.0, 0.1), (2.0, -3.0, 10.0)),
    "B": ((6.0, 0.2, 2.4), (-85.0, 4.0, 20.0)),
    "C": ((5.8, 5.0, 0.2), (3.0, 88.0, -35.0)),
    "D": ((0.1, 4.8, 2.2), (45.0, 30.0, 120.0)),
}
_FREQUENCIES_HZ = (20.0, 25.0, 30.0, 35.0)

DEMO_BOX_WORLD = np.array([[1.2, 1.2, 0.6], [4.8, 3.8, 1.6]])  # m, clear of the beacons


def demo_site(coil_radius: float | None = 0.1, synchronised: bool = True) -> Site:
    """Return four rotating beacons of two coils each, and a platform of ordinary MEMS quality.

    `coil_radius`: of the true coils (m); None makes them dipoles, so that the dipole model is
    exact. `synchronised`: whether the drive phases are known.
    """
    beacons = tuple(
        _beacon(name, position, rpy_deg, frequency_hz, coil_radius, synchronised)
        for (name, (position, rpy_deg)), frequency_hz in zip(
            _PLACES.items(), _FREQUENCIES_HZ, strict=True
        )
    )
    return Site(
        gravity=9.81,
        model_error=0.005,
        beacons=beacons,
        platform=Platform(_imu(), _magnetometer()),
        earth_field_world=np.array([1.2e-6, 1.9e-5, -4.5e-5]),
    )


def _beacon(
    name: str,
    position: tuple[float, float, float],
    rpy_deg: tuple[float, float, float],
    frequency_hz: float,
    radius: float | None,
    synchronised: bool,
) -> Beacon:
    return Beacon(
        name=name,
        position_world=np.array(position),
        world_from_beacon=Rotation.from_euler("xyz", rpy_deg, degrees=True).as_matrix(),
        frequency_hz=frequency_hz,
        coils=(
            Coil(np.array([MOMENT, 0.0, 0.0]), phase=0.0, radius=radius),
            Coil(np.array([0.0, MOMENT, 0.0]), phase=-np.pi / 2.0, radius=radius),
        ),
        synchronised=synchronised,
        sigma=BeaconSigma(
            position_world=np.full(3, 1e-3),
            rotation_beacon=np.full(3, 0.05 * DEGREE),
            log_moment=np.full(2, 1e-3),
        ),
    )


def _imu() -> ImuModel:
    return ImuModel(
        gyro_noise=3e-4,
        accel_noise=3e-3,
        gyro_bias_walk=1e-5,
        accel_bias_walk=1e-4,
        gyro_bias_sigma=5e-3,
        accel_bias_sigma=0.05,
    )


def _magnetometer() -> Magnetometer:
    mounting: Array = Rotation.from_euler("xyz", (0.0, 0.0, -90.0), degrees=True).as_matrix()
    return Magnetometer(
        position_body=np.array([0.05, -0.02, 0.03]),
        body_from_sensor=mounting,
        noise_density=2.5e-10,
        matrix=np.eye(3),
        offset=np.zeros(3),
        sigma=MagnetometerSigma(
            matrix=np.full((3, 3), 1e-3),
            offset=np.full(3, 1e-8),
            rotation_sensor=np.full(3, 0.05 * DEGREE),
            position_body=np.full(3, 1e-3),
        ),
    )
