"""Designs of beacons in time slots: each copy has slots of its own, and the noise they leave."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import Refuse, run_command

from magfusion.files.site import load_site, save_site
from magfusion.model.site import Beacon, MarkedSlots, Slots
from magfusion.model.trust import Risk
from magfusion.results.coverage import coverage, phasor_variance, volume
from magfusion.results.design.pattern import ToneBand
from magfusion.results.design.planning import Task, designed
from magfusion.results.design.turns import all_in_turn, cycle_of, in_turn
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site

WINDOW = 0.4  # s
POINTS = volume(DEMO_BOX_WORLD, 1.8)


def template(slots: Slots | MarkedSlots | None = None) -> Beacon:
    """Return a beacon of two coils that are driven in turn, with a silent slot."""
    beacon = demo_site(coil_radius=None).beacons[0]
    coils = tuple(replace(coil, slot=k, phase=0.0) for k, coil in enumerate(beacon.coils))
    chosen = Slots(0.02, 3, 0.01) if slots is None else slots
    return replace(beacon, coils=coils, slots=chosen, frequency_hz=500.0)


def test_copies_have_slots_of_their_own_and_the_silent_one_stays() -> None:
    beacons = all_in_turn(template(), [template()] * 3)
    own = [coil.slot for beacon in beacons for coil in beacon.coils]
    assert sorted(own) == [1, 2, 3, 4, 5, 6]  # of seven; slot 0 is silent
    assert {beacon.slots for beacon in beacons} == {Slots(0.02, 7, 0.01)}
    assert cycle_of(template(), 3) == pytest.approx(0.14)
    marked = in_turn(template(MarkedSlots()), 1, 3)
    assert [coil.slot for coil in marked.coils] == [2, 3]
    assert cycle_of(template(MarkedSlots()), 3) is None


def test_what_the_search_minimises_is_what_coverage_says_of_the_site() -> None:
    site = replace(demo_site(coil_radius=None), beacons=())
    places = volume(np.array([[-0.5, -0.5, 2.5], [6.5, 5.5, 3.0]]), 2.5)
    task = Task(
        site=site,
        template=template(),
        count=3,
        places=places,
        points=POINTS,
        band=ToneBand(10.0, 100.0, WINDOW, 50.0),
        risk=Risk(),
        axes=3,
    )
    result = designed(task, starts=1, layouts=6, rng=np.random.default_rng(0))
    level = coverage(result.site, POINTS, WINDOW, risk=Risk()).protection_level_m
    assert level is not None
    assert result.median_random is not None
    median = coverage(result.median_random, POINTS, WINDOW, risk=Risk()).protection_level_m
    assert median is not None
    assert np.max(level) < np.max(median)
    assert np.max(median) == pytest.approx(np.sort(result.random_worst_m)[2], rel=1e-6)
    # Of a cycle of seven slots each coil has one.
    density = site.platform.magnetometer.noise_density
    np.testing.assert_allclose(phasor_variance(result.site, WINDOW), 7.0 * density**2 / WINDOW)


@pytest.mark.slow
def test_slots_go_through_the_job_and_what_cannot_be_is_refused(
    tmp_path: Path, refuse: Refuse
) -> None:
    site = replace(demo_site(coil_radius=None), beacons=(template(),))
    save_site(site, tmp_path / "site.yaml")
    here = (tmp_path / "site.yaml", "--beacons", 2, "--box", "0,6,0,5,0,3", "--spacing", 2.5)
    few = ("--starts", 1, "--axes", 3, "--apart", 0.5)
    run_command("design", *here, *few, "-o", tmp_path / "design")
    result = load_site(tmp_path / "design" / "site.yaml")
    assert sorted(c.slot or 0 for b in result.beacons for c in b.coils) == [1, 2, 3, 4]
    findings = refuse("design", *here, "--window", 0.05, "-o", tmp_path / "x")
    assert "give --window 0.1 or more" in findings
    findings = refuse("design", *here, "--keep", "all", "-o", tmp_path / "x")
    assert "can only be designed as a whole" in findings
