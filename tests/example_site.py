"""A site of every kind of beacon, with nothing symmetric in it, for tests of the estimators."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.model.response import ResponseSigma
from magfusion.model.site import BeaconSigma, Coil, MagnetometerSigma, Site
from magfusion.simulation.demo_site import demo_site

UNEVEN = np.array([1.0, 2.0, 3.0])
TONES_HZ = np.array([20.0, 22.0, 25.0, 28.0, 31.0, 35.0])


def mixed_site() -> Site:
    """Two axes; three coils by frequency, unsynchronised; one coil, unsynchronised; two axes."""
    plain = demo_site(coil_radius=None)
    a, b, c, d = plain.beacons
    coils = (
        Coil(np.array([190.0, 0.0, 4.0]), 0.2, np.array([0.03, -0.01, 0.02]), frequency_hz=22.0),
        Coil(np.array([0.0, 170.0, 0.0]), -0.7, np.array([0.0, 0.05, 0.0]), frequency_hz=25.0),
        Coil(np.array([1.0, 0.0, 210.0]), 2.0, np.array([0.0, -0.02, 0.06]), frequency_hz=28.0),
    )
    b = replace(b, coils=coils, synchronised=False)
    c = replace(c, coils=(Coil(np.array([20.0, -30.0, 150.0]), 0.4),), frequency_hz=31.0)
    beacons = tuple(
        replace(beacon, sigma=BeaconSigma(0.01 * UNEVEN, 0.02 * UNEVEN, 0.01 * UNEVEN[:n]))
        for beacon, n in ((a, 2), (b, 3), (replace(c, synchronised=False), 1), (d, 2))
    )
    by_axis = np.arange(1.0, 13.0).reshape(6, 2) / 12.0
    magnetometer = replace(
        plain.platform.magnetometer,
        body_from_sensor=Rotation.from_euler("xyz", (0.5, -1.2, 2.5)).as_matrix(),
        matrix=np.array([[1.05, 0.02, -0.03], [0.01, 0.93, 0.04], [-0.02, 0.05, 1.08]]),
        sigma=MagnetometerSigma(
            matrix=0.01 * np.arange(1.0, 10.0).reshape(3, 3),
            offset=np.full(3, 1e-8),
            rotation_sensor=0.02 * UNEVEN,
            position_body=0.003 * UNEVEN,
        ),
        response_sigma=ResponseSigma(TONES_HZ, 0.1 * by_axis, 0.05 * by_axis),
    )
    platform = replace(plain.platform, magnetometer=magnetometer)
    return replace(plain, beacons=beacons, platform=platform)
