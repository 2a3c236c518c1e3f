"""A gallery from its design to its accepted installation."""

from dataclasses import replace

import numpy as np

from magfusion.model.hall import Hall, Mounts, prism_of
from magfusion.model.site import BeaconSigma, Site
from magfusion.simulation.demo_site import demo_site
from magfusion.units import DEGREE

LENGTH, WIDTH, HEIGHT = 80.0, 6.0, 4.0  # m
MOMENT = 400.0  # A m^2, of a coil that the wall can carry


def gallery() -> Hall:
    """Return the gallery: beacons on its walls, a platform on its floor."""
    room = prism_of(np.array([[0.0, 0.0, 0.0], [LENGTH, WIDTH, HEIGHT]]))
    use = prism_of(np.array([[0.0, 0.0, 0.5], [LENGTH, WIDTH, 1.5]]))
    return Hall(room, Mounts((0, 1, 2, 3), np.array([1.0, 3.5])), use, 1.0)


def template_site() -> Site:
    """Return the platform, and the coil of which copies are placed."""
    usual = demo_site(coil_radius=None)
    first = usual.beacons[0]
    coil = replace(first.coils[0], moment_beacon=np.array([MOMENT, 0.0, 0.0]))
    sigma = BeaconSigma(np.full(3, 0.005), np.full(3, 0.3 * DEGREE), np.full(1, 0.01))
    beacon = replace(first, name="T", coils=(coil,), sigma=sigma, world_from_beacon=np.eye(3))
    return replace(usual, beacons=(beacon,))
