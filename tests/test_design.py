"""A design is what coverage says it is, and no exchange betters it."""

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from example_site import mixed_site

from magfusion.errors import InputError
from magfusion.files.hall import load_hall
from magfusion.model.correlation import Correlation
from magfusion.model.ground import in_ground
from magfusion.model.hall import Hall, Mounts, Prism, mounting_places, points_of_use, prism_of
from magfusion.model.parameters import choose_blocks
from magfusion.model.prior import parameters_of
from magfusion.model.site import Site
from magfusion.model.trust import Risk
from magfusion.results.coverage import coverage, volume
from magfusion.results.design.exchange import (
    Candidates,
    LayoutSearch,
    Objective,
    best_layout,
    search_value,
    value_of,
)
from magfusion.results.design.layout_information import LayoutInformation
from magfusion.results.design.pattern import (
    ToneBand,
    axes_offered,
    frequencies_for,
    pattern_axis,
    rotated_to,
    tuned,
)
from magfusion.results.design.planning import Task, candidates_of, designed
from magfusion.results.design.tuning import assigned, divided
from magfusion.results.pose_information import SURVEY_GROUPS
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site

WINDOW = 0.4  # s
POINTS = volume(DEMO_BOX_WORLD, 1.3)
ROOM = np.array([[0.0, 0.0, 0.0], [6.0, 5.0, 2.5]])
BAND = ToneBand(10.0, 100.0, WINDOW, 50.0)
L_SHAPE = np.array([[0, 0], [6, 0], [6, 2], [3, 2], [3, 5], [0, 5]], dtype=float)


def information(site: Site, kept: int = 0) -> LayoutInformation:
    staying = replace(site, beacons=site.beacons[:kept])
    return LayoutInformation(staying, site.beacons[0], POINTS, WINDOW, Risk())


def task(count: int = 2, places: int = 7, **changes: object) -> Task:
    site = demo_site(coil_radius=None)
    hall = Hall(prism_of(ROOM), Mounts(tuple(range(4)), ROOM[:, 2]), prism_of(DEMO_BOX_WORLD))
    every = mounting_places(hall, 2.5)
    few = every[np.linspace(0, len(every) - 1, places).astype(int)]
    plain = Task(
        replace(site, beacons=()), site.beacons[0], count, few, POINTS, BAND, Risk(), axes=3
    )
    return replace(plain, **changes)


def correlated_site() -> Site:
    """Return a site whose first two beacons and magnetometer were refined by one log."""
    site = demo_site(coil_radius=None)
    refined = replace(site, beacons=site.beacons[:2])
    names = parameters_of(choose_blocks(refined, SURVEY_GROUPS))
    drawn = np.random.default_rng(0).normal(size=(len(names), 2 * len(names)))
    return replace(site, correlation=Correlation(tuple(names), np.corrcoef(drawn)))


def site_in_the_sea() -> Site:
    return replace(in_ground(demo_site(coil_radius=None), 4.0), log_conductivity_sigma=0.1)


@pytest.mark.parametrize(
    ("site", "kept"),
    [
        (demo_site(coil_radius=None), 0),
        (demo_site(coil_radius=None), 2),
        (demo_site(synchronised=False), 0),
        (mixed_site(), 2),
        (correlated_site(), 2),
        (site_in_the_sea(), 0),
        (site_in_the_sea(), 1),
    ],
)
def test_design_and_coverage_agree_on_a_layout_to_rounding(site: Site, kept: int) -> None:
    """One marginalises beacon by beacon and adds up, the other everything at once."""
    result = coverage(site, POINTS, WINDOW, risk=Risk())
    info, new = information(site, kept), site.beacons[kept:]
    assert np.all(np.isfinite(result.protection_level_m))
    worst, each = value_of(info, new, "worst")
    assert np.allclose(each, result.protection_level_m, rtol=1e-10, atol=0)
    assert worst == np.max(each)
    _, trace = value_of(info, new, "A")
    assert np.allclose(np.sqrt(trace), result.position_sigma, rtol=1e-11, atol=0)


@pytest.mark.parametrize("objective", ["worst", "A", "D"])
def test_the_exchange_finds_the_best_of_all_pairs(objective: Objective) -> None:
    what = task(places=5, objective=objective)
    candidates = candidates_of(what, what.template)
    info = LayoutInformation(what.site, what.template, POINTS, WINDOW, Risk())
    allowed = [
        pair
        for pair in itertools.combinations(range(len(candidates.beacons)), 2)
        if candidates.far_from(pair[:1])[pair[1]]
    ]
    assert len(allowed) > 60
    every = [
        value_of(info, [candidates.beacons[c] for c in pair], objective)[0] for pair in allowed
    ]
    search = LayoutSearch(info, candidates, objective)
    result = best_layout(search, 2, 4, np.random.default_rng(1))
    assert result is not None
    assert result.value == pytest.approx(min(every), rel=1e-3)
    assert result.value < np.median(every)


def test_what_is_minimised_for_the_worst_sigma_is_a_smooth_bound_of_it() -> None:
    """Hölder: at most the worst, at least that over the eighth root of the number of points."""
    each = np.random.default_rng(3).lognormal(-5.0, 1.0, (40, 60))
    value, worst = search_value(each, "sigma"), np.max(each, axis=1)
    assert np.all(value < worst)
    assert np.all(value > worst / 60.0 ** (1.0 / 8.0))
    # Some of the points, as they are compared first, bound it from below.
    parts = np.stack([search_value(each[:, :k], "sigma", 60) for k in (3, 8, 60)])
    assert np.all(np.diff(parts, axis=0) > 0.0)
    np.testing.assert_allclose(parts[-1], value, rtol=1e-12)


def test_a_search_without_time_still_gives_a_layout() -> None:
    what = task()
    result = designed(
        what, starts=3, layouts=0, rng=np.random.default_rng(1), in_time=lambda: False
    )
    assert not result.complete
    assert len(result.new) == 2


def test_an_earlier_design_is_where_the_search_goes_on() -> None:
    rng = np.random.default_rng
    once = designed(task(), starts=2, layouts=0, rng=rng(3))
    again = designed(task(), starts=1, layouts=0, rng=rng(4), first=once.site)
    info = LayoutInformation(task().site, task().template, POINTS, WINDOW, Risk())
    assert value_of(info, again.new, "worst")[0] <= 1.001 * value_of(info, once.new, "worst")[0]


def test_what_is_asked_of_a_layout_is_kept() -> None:
    site = demo_site(coil_radius=None)
    what = task(
        3, 7, site=replace(site, beacons=site.beacons[1:2]), min_distance=2.5, clearance=1.3
    )
    result = designed(what, starts=1, layouts=4, rng=np.random.default_rng(2))
    assert result.site.beacons[0] is site.beacons[1]
    for layout in (result.site, result.median_random):
        assert layout is not None
        places = np.array([b.position_world for b in layout.beacons])
        assert all(np.linalg.norm(a - b) >= 2.5 for a, b in itertools.combinations(places, 2))
        assert all(np.min(np.linalg.norm(POINTS - p, axis=1)) >= 1.3 for p in places[1:])
        tones = np.concatenate([b.tone_frequencies_hz for b in layout.beacons])
        separate = np.abs(tones[:, None] - tones) + 1e3 * np.eye(len(tones))
        assert np.min(separate) >= BAND.spacing - 1e-9
        assert np.min(np.abs(tones - 50.0)) >= BAND.spacing - 1e-9
    assert len({b.name for b in result.site.beacons}) == 4


def test_a_budget_divided_is_spent_and_serves_better() -> None:
    site = demo_site(coil_radius=None)
    info, beacons = information(site), site.beacons
    new, share = divided(info, beacons, "worst", lambda: True)
    assert np.sum(share) == pytest.approx(len(beacons))
    assert np.ptp(share) > 0.0
    assert value_of(info, new, "worst")[0] < value_of(info, beacons, "worst")[0]


def test_frequencies_are_exchanged_where_the_ground_weakens_some() -> None:
    site = site_in_the_sea()
    info = information(site)
    hz = np.array([[1000.0], [2000.0], [3000.0], [4000.0]])
    beacons = tuple(tuned(b, f) for b, f in zip(site.beacons, hz, strict=True))
    new = assigned(info, beacons, np.array([1500.0, 5000.0]), "worst", lambda: True)
    assert value_of(info, new, "worst")[0] < value_of(info, beacons, "worst")[0]
    frequencies = [b.frequency_hz for b in new]
    assert len(set(frequencies)) == 4
    assert set(frequencies) <= {*hz.ravel().tolist(), 1500.0, 5000.0}


def test_tones_are_told_apart_from_each_other_and_from_the_mains() -> None:
    template = mixed_site().beacons[1]  # three coils with a frequency each
    kept = demo_site().beacons[:1]  # 20 Hz
    tones, _ = frequencies_for(template, 2, BAND, kept)
    every = np.concatenate([tones.ravel(), [0.0, 20.0, 50.0, 100.0]])
    gaps = np.abs(every[:, None] - every) + 1e3 * np.eye(len(every))
    assert tones.shape == (2, 3)
    assert np.min(gaps) >= 5.0 - 1e-9  # Hz: two periods of the window
    with pytest.raises(InputError, match="--band 10,100 has"):
        frequencies_for(template, 20, BAND, kept)


@pytest.mark.parametrize("index", range(4))
def test_a_beacon_is_turned_to_its_axis(index: int) -> None:
    beacon = mixed_site().beacons[index]
    axis = pattern_axis(beacon)
    if axis is None:  # coils in all directions: no turn is better than another
        assert len(axes_offered(beacon, 13)) == 1
        return
    field = beacon.world_from_beacon @ axis
    if len(beacon.coils) == 1:
        moment = beacon.world_from_beacon @ beacon.moments_beacon[0]
        assert np.linalg.norm(np.cross(field, moment)) < 1e-9 * np.linalg.norm(moment)
    else:
        assert np.allclose(beacon.moments_beacon @ axis, 0.0, rtol=0, atol=1e-9)
    for wanted in axes_offered(beacon, 13):
        new = rotated_to(beacon, wanted)
        assert abs(wanted @ new.world_from_beacon @ axis) == pytest.approx(1.0, abs=1e-12)
        assert np.linalg.norm(new.world_from_beacon @ new.world_from_beacon.T - np.eye(3)) < 1e-12


def test_points_and_places_lie_in_the_hall_and_on_its_walls() -> None:
    room = Prism(L_SHAPE, np.array([0.0, 3.0]))
    gate = Prism(np.array([[2, -1], [4, -1], [4, 1], [2, 1]], dtype=float), np.array([0.0, 2.0]))
    mounts = Mounts((0, 3), np.array([1.0, 3.0]), ceiling=True, forbidden=(gate,))
    hall = Hall(room, mounts, Prism(L_SHAPE, np.array([0.5, 1.5])), margin=0.5)
    points, places = points_of_use(hall, 0.5), mounting_places(hall, 1.0)
    assert not np.any((points[:, 0] > 2.5 + 1e-9) & (points[:, 1] > 1.5 + 1e-9))
    assert np.any(points[:, 0] > 5.0)
    assert np.any(points[:, 1] > 4.0)
    on_wall = places[places[:, 2] < 3.0 - 1e-9]
    assert np.all((on_wall[:, 1] == 0.0) | (np.abs(on_wall[:, 0] - 3.0) < 1e-9))
    in_gate = (np.abs(places[:, 0] - 3.0) <= 1.0) & (places[:, 1] <= 1.0) & (places[:, 2] <= 2.0)
    assert not np.any(in_gate)


HALL = """
magfusion_hall: 1
hall: {polygon_m: [[0, 0], [6, 0], [6, 5], [0, 5]], height_m: [0, 3]}
"""


@pytest.mark.parametrize(
    ("text", "reported"),
    [
        (HALL + "walls: [1]", "walls: is not a known key"),
        (HALL + "mount: {walls: [4]}", r"mount.walls\[0\]: found 4; the hall has walls 0 to 3"),
        (HALL + "mount: {surfaces: [door]}", "mount.surfaces"),
        (HALL + "use: {height_m: [1, 4]}", "use.height_m: found .*; give heights between"),
        (HALL + "use: {height_m: [2, 1]}", "the lower one first"),
        (HALL.replace("[6, 5], [0, 5]", "[0, 5], [6, 5]"), "hall.polygon_m: .*no edges cross"),
        (HALL.replace("[0, 3]", "[0, 0]"), "hall.height_m: .*at least 0.1 m apart"),
        (HALL.replace("hall: 1", "hall: 2"), "magfusion_hall: .*write 1"),
    ],
)
def test_a_hall_that_cannot_be_is_refused(text: str, reported: str, tmp_path: Path) -> None:
    path = tmp_path / "hall.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=reported) as refused:
        load_hall(path)
    assert str(path) in str(refused.value)


def test_beacons_that_find_no_room_are_refused() -> None:
    with pytest.raises(InputError, match="--apart 9 m"):
        designed(task(min_distance=9.0), starts=1, layouts=0, rng=np.random.default_rng(1))
    with pytest.raises(InputError, match="mounting places remain"):
        candidates_of(task(clearance=9.0), task().template)
    assert isinstance(candidates_of(task(), task().template), Candidates)
