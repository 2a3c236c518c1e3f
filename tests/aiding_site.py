"""A demonstration site with an aiding sensor of every kind, for tests of them."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.model.aiding import AidingSensor, AidingSigma
from magfusion.model.site import Site
from magfusion.simulation.demo_site import demo_site

LEVER = np.array([0.3, -0.2, 0.5])
TURN = Rotation.from_euler("xyz", [3.0, -5.0, 20.0], degrees=True).as_matrix()


def sigmas(offset: float = 0.3) -> AidingSigma:
    """Return priors of every parameter, of ordinary size."""
    return AidingSigma(
        position_body=np.full(3, 0.05),
        rotation_sensor=np.full(3, 0.02),
        scale=np.array(0.02),
        offset=np.array(offset),
        time_offset=np.array(0.02),
    )


def sensors() -> tuple[AidingSensor, ...]:
    """Return a sensor of every kind."""
    mounted = {"position_body": LEVER, "sigmas": sigmas()}
    return (
        AidingSensor("visual", "velocity", 0.02, body_from_sensor=TURN, **mounted),
        AidingSensor("anchor", "range", 0.05, point_world=np.array([8.0, 1.0, 2.0]), **mounted),
        AidingSensor("prism", "position", 0.01, origin=(60.5, 25.25, 30.0), **mounted),
        AidingSensor("foot", "mark", 0.01, marks_world={"7": np.array([2.0, 1.0, 0.5])}, **mounted),
        AidingSensor("level", "height", 0.02, offset_walk=0.1, **mounted),
        AidingSensor(
            "air",
            "pressure",
            1.0,
            position_body=LEVER,
            scale=np.array(-1.2 * 9.80665),
            offset=np.array(101325.0),
            sigmas=sigmas(100.0),
        ),
        AidingSensor(
            "keyframes",
            "relative_pose",
            0.005,
            body_from_sensor=TURN,
            scale=np.array(0.9),
            rotation_sigma=0.002,
            **mounted,
        ),
        AidingSensor("compass", "heading", 0.01, sigmas=sigmas(0.05)),
    )


def aided_site(*chosen: AidingSensor) -> Site:
    """Return the demonstration site with some aiding sensors, by default all."""
    return replace(demo_site(coil_radius=None), aiding=chosen or sensors())
