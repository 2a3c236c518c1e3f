"""A tracker of three slots with every imperfection, for tests."""

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


def rotated(*rotvec: float) -> np.ndarray:
    """Return the matrix of a rotation vector (rad)."""
    return np.asarray(Rotation.from_rotvec(rotvec).as_matrix())


def tracker_site(
    rng: np.random.Generator, *, gain: float = 0.01, tilt: float = 0.005, centre: float = 1e-3
) -> Site:
    """Return a site whose coils err by so much (relative, rad, m); with three zeros it is ideal."""

    def coils() -> np.ndarray:
        across = tilt * rng.standard_normal((3, 3)) * (1.0 - np.eye(3))
        return np.asarray((1.0 + gain * rng.standard_normal((3, 1))) * (np.eye(3) + across))

    beacon = Beacon(
        name="T",
        position_world=np.array([0.2, -0.1, 0.9]),
        world_from_beacon=rotated(0.4, -0.3, 1.1),
        frequency_hz=1000.0,
        coils=tuple(
            Coil(moment, 0.3 * slot, centre * rng.standard_normal(3), slot=slot)
            for slot, moment in enumerate(coils())
        ),
        synchronised=True,
        sigma=BeaconSigma(np.zeros(3), np.zeros(3), np.zeros(3)),
    )
    magnetometer = Magnetometer(
        position_body=np.array([0.05, -0.02, 0.03]),
        body_from_sensor=rotated(0.2, 0.1, -0.9),
        noise_density=1e-10,
        matrix=coils(),
        offset=np.zeros(3),
        sigma=MagnetometerSigma(np.zeros((3, 3)), np.zeros(3), np.zeros(3), np.zeros(3)),
        coil_centres_sensor=centre * rng.standard_normal((3, 3)) if centre else None,
    )
    imu = ImuModel(1e-3, 1e-2, 1e-5, 1e-4, 1e-2, 1e-1)
    return Site(9.81, 0.0, (beacon,), Platform(imu, magnetometer))


def body_poses(site: Site, number: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return attitudes and positions of the body between 0.3 and 0.6 m around the first beacon."""
    attitude = Rotation.random(number, rng=rng).as_matrix()
    direction = rng.standard_normal((number, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    place = site.beacons[0].position_world + rng.uniform(0.3, 0.6, (number, 1)) * direction
    return attitude, place


def in_beacon(
    site: Site, world_from_body: np.ndarray, position_world: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return beacon_from_sensor and the sensor's position in beacon axes (m)."""
    beacon, sensor = site.beacons[0], site.platform.magnetometer
    place = position_world + world_from_body @ sensor.position_body - beacon.position_world
    turn = beacon.world_from_beacon.T @ world_from_body @ sensor.body_from_sensor
    return turn, place @ beacon.world_from_beacon
