"""Single epochs tell that one of several magnetometers is mounted otherwise, of three which."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_several_magnetometers import poses, two_magnetometers

from magfusion.estimation.snapshot.fix_magnetometers import contradicting_magnetometers
from magfusion.model.parameters import initial_calibration
from magfusion.model.site import MagnetometerSigma, Site
from magfusion.simulation.demo_site import demo_site
from magfusion.simulation.log import simulate_fields

TURN = Rotation.from_euler("x", 8.0, degrees=True).as_matrix()


@pytest.fixture(scope="module")
def three() -> Site:
    site = two_magnetometers(demo_site(coil_radius=None))
    remaining, right = site.platform.magnetometers
    sigma = MagnetometerSigma(
        matrix=np.full((3, 3), 0.003),
        offset=np.zeros(3),
        rotation_sensor=np.full(3, np.deg2rad(0.5)),
        position_body=np.full(3, 0.002),
    )
    above = replace(remaining, name="above", position_body=np.array([0.0, 0.02, 0.2]))
    sensors = tuple(replace(s, sigma=sigma) for s in (remaining, right, above))
    return replace(site, platform=site.platform.with_magnetometers(sensors))


def mounted(site: Site, false: int | None, count: int) -> Site:
    """Return the site of the first few, one of which is declared otherwise than it is."""
    sensors = list(site.platform.magnetometers[:count])
    if false is not None:
        wrong = sensors[false].body_from_sensor @ TURN
        sensors[false] = replace(sensors[false], body_from_sensor=wrong)
    return replace(site, platform=site.platform.with_magnetometers(tuple(sensors)))


@pytest.mark.parametrize(
    ("count", "false", "findings"),
    [
        (2, None, None),
        (2, 1, "The magnetometers left, right contradict each other"),
        (3, None, None),
        (3, 2, "Magnetometer above contradicts the others, which agree"),
        (3, 0, "Magnetometer left contradicts the others, which agree"),
    ],
)
def test_who_contradicts_whom_is_said(
    three: Site, count: int, false: int | None, findings: str | None
) -> None:
    true, declared = mounted(three, None, count), mounted(three, false, count)
    at = poses(8)
    samples = simulate_fields(true, at, 2e-10, np.random.default_rng(count))
    result = contradicting_magnetometers(samples, initial_calibration(declared, 0.0))
    assert [f.text.startswith(findings) for f in result if findings] == ([True] if findings else [])
    assert bool(result) == bool(findings)
