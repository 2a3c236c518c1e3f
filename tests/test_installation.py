"""An installation is accepted by fields at marks, and one wrong beacon of it is named."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from magfusion.calibration.installation import InstallationCheck, check_installation
from magfusion.calibration.marked_snapshots import MarkedSnapshots
from magfusion.model.check_distance import CheckDistance
from magfusion.model.parameters import initial_calibration
from magfusion.model.site import Beacon, BeaconSigma, Site
from magfusion.model.trajectory import Trajectory
from magfusion.results.coverage import phasor_variance
from magfusion.simulation.demo_site import demo_site
from magfusion.simulation.log import perturb_site, simulate_fields
from magfusion.units import DEGREE, Array

WINDOW, MARK = 0.4, 0.007  # s, m


def declared() -> Site:
    site = demo_site(coil_radius=None)
    sigma = BeaconSigma(np.full(3, 0.005), np.full(3, 0.3 * DEGREE), np.full(2, 0.01))
    return replace(site, beacons=tuple(replace(b, sigma=sigma) for b in site.beacons))


def checked(change: Callable[[Beacon], Beacon] | None, seed: int) -> InstallationCheck:
    """Return the check of a site whose beacon C is changed."""
    site, rng = declared(), np.random.default_rng(seed)
    true = perturb_site(site, rng)
    if change is not None:
        beacons = tuple(change(b) if b.name == "C" else b for b in true.beacons)
        true = replace(true, beacons=beacons)
    mesh = np.meshgrid([1.2, 3.0, 4.8], [1.2, 2.5, 3.8], [0.6], indexing="ij")
    marks: Array = np.stack(mesh, axis=-1).reshape(-1, 3)
    count = len(marks)
    angles = np.hstack([rng.uniform(-180.0, 180.0, (count, 1)), rng.normal(0.0, 2.0, (count, 2))])
    turn = Rotation.from_euler("zyx", angles, degrees=True)
    place = marks + rng.normal(0.0, MARK, marks.shape)
    still = Trajectory(np.arange(float(count)), turn.as_matrix(), place)
    noise = float(np.sqrt(phasor_variance(site, WINDOW)[0]))
    samples = simulate_fields(true, still, noise, rng, window=WINDOW)
    first, third = true.beacons[0].position_world, true.beacons[2].position_world
    taped = float(np.linalg.norm(third - first)) + rng.normal(0.0, 0.005)
    marked = MarkedSnapshots(
        samples,
        initial_calibration(site, 0.0),
        survey_error=False,
        marks_world=marks,
        mark_sigma=MARK,
        up_body=turn.inv().apply([0.0, 0.0, 1.0]),
        distances=(CheckDistance("A", "C", taped, 0.005),),
    )
    return check_installation(marked)


def _times(factor: float) -> Callable[[Beacon], Beacon]:
    def changed(beacon: Beacon) -> Beacon:
        coils = tuple(replace(c, moment_beacon=factor * c.moment_beacon) for c in beacon.coils)
        return replace(beacon, coils=coils)

    return changed


def _off(beacon: Beacon) -> Beacon:
    return replace(beacon, position_world=beacon.position_world + np.array([0.1, 0.0, 0.0]))


def test_an_installation_within_its_sigmas_passes() -> None:
    result = checked(None, 0)
    assert not any(check.contradicted for check in result.beacons)
    for check in result.beacons:
        assert check.detectable < 0.1  # m; what is not found is smaller
        assert np.all(np.abs(check.step_world) < 5.0 * np.hypot(check.step_sigma, 0.005))


@pytest.mark.parametrize(
    ("change", "fault"),
    [(_off, "position"), (_times(-1.0), "reversed"), (_times(0.5), "moment")],
)
def test_one_wrong_beacon_is_named_with_its_fault(
    change: Callable[[Beacon], Beacon], fault: str
) -> None:
    result = checked(change, 1)
    named = {check.name: check.faults for check in result.beacons if check.contradicted}
    assert list(named) == ["C"]
    assert named["C"][0] == fault
    wrong = result.beacons[2]
    if fault == "position":
        assert wrong.step_world == pytest.approx([0.1, 0.0, 0.0], abs=0.03)  # m; survey included
    if fault == "moment":
        assert wrong.factor == pytest.approx(0.5, abs=0.02)
