"""A declared region or hemisphere: a lone tracker has one pose, and says where that ends."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import run_command
from tracker_site import body_poses, in_beacon, tracker_site

from magfusion.errors import InputError
from magfusion.estimation.snapshot.fix import Fixes
from magfusion.estimation.snapshot.likelihood import fix_epochs
from magfusion.estimation.snapshot.region_test import of_place
from magfusion.files.log import write_log
from magfusion.files.site import load_site, save_site
from magfusion.jobs.region_option import Where
from magfusion.model.field import predict
from magfusion.model.parameters import initial_calibration
from magfusion.model.region import HalfSpace, Region
from magfusion.model.samples import FieldSamples, Log
from magfusion.model.site import Coil, Site
from magfusion.simulation.demo_site import demo_site
from magfusion.simulation.inertial import simulate_imu
from magfusion.simulation.log import EPOCH_NS, simulate_fields
from magfusion.simulation.motion import Rests, random_walk_motion

NUMBER = 60
FRONT = np.array([0.0, 0.0, 1.0])  # beacon axes


def fixed(site: Site, world_from_body: np.ndarray, position_world: np.ndarray) -> Fixes:
    beacon, sensor = site.beacons[0], site.platform.magnetometer
    phasor = predict(beacon, sensor, world_from_body, position_world)
    cov = np.broadcast_to(1e-20 * np.eye(3), (len(phasor), 3, 3, 3)).copy()  # T^2
    time = np.arange(float(len(phasor)))
    samples = FieldSamples(time, np.ones(len(phasor)), site.channels, phasor, cov)
    return fix_epochs(samples, initial_calibration(site, 0.0), survey_error=False)


def facing(site: Site, hemisphere: np.ndarray | None = FRONT) -> Site:
    return replace(site, beacons=(replace(site.beacons[0], hemisphere_beacon=hemisphere),))


def test_a_lone_tracker_has_one_pose_in_its_hemisphere_and_two_without() -> None:
    site = tracker_site(np.random.default_rng(1), centre=0.0)
    attitude, place = body_poses(site, 200, np.random.default_rng(2))
    height = in_beacon(site, attitude, place)[1][:, 2]
    kept = np.flatnonzero(height > 0.08)[:NUMBER]  # m, of 0.3 to 0.6
    attitude, place = attitude[kept], place[kept]
    without, reported = fixed(site, attitude, place), fixed(facing(site), attitude, place)
    assert np.all(np.abs(without.probability[:, 1] - 0.5) < 0.01)
    wrong = np.linalg.norm(without.position_world[:, 0] - place, axis=1) > 0.1
    assert 0.2 < np.mean(wrong) < 0.8
    np.testing.assert_allclose(reported.position_world[:, 0], place, rtol=0, atol=1e-4)
    assert np.all(reported.probability[:, 0] > 1.0 - 1e-6)


def test_a_room_and_a_half_space_are_one_line_each() -> None:
    site = tracker_site(np.random.default_rng(1), centre=0.0)
    attitude, place = body_poses(site, 200, np.random.default_rng(3))
    x, above = site.beacons[0].position_world[0], place[:, 0] > 0.28
    attitude, place = attitude[above], place[above]
    box = np.array([[x, -np.inf, -np.inf], [np.inf, np.inf, np.inf]])
    half = HalfSpace(np.array([3.0, 0.0, 0.0]), np.array([x, 7.0, -2.0]))
    for region in (Region(box_world=box), Region(half_space=half)):
        result = fixed(replace(site, region=region), attitude, place)
        np.testing.assert_allclose(result.position_world[:, 0], place, rtol=0, atol=1e-4)
        assert np.all(result.probability[:, 0] > 1.0 - 1e-6)


def test_near_the_plane_both_poses_are_kept_and_it_is_said() -> None:
    site = facing(tracker_site(np.random.default_rng(1), centre=0.0))
    attitude, _ = body_poses(site, 20, np.random.default_rng(4))
    beacon, lever = site.beacons[0], site.platform.magnetometer.position_body
    height = np.linspace(-0.002, 0.004, 20)  # m, at 0.5 m
    sensor = beacon.world_from_beacon @ np.array([[0.4] * 20, [0.3] * 20, height])
    place = beacon.position_world + sensor.T - attitude @ lever
    result = fixed(site, attitude, place)
    assert np.all(result.probability[:, 1] > 0.2)
    first = (result.world_from_body, result.position_world, result.pose_cov)
    (findings,) = of_place(site, result.time, *(part[:, 0] for part in first))
    assert findings.code == "region_edge"
    assert "the plane through beacon T" in findings.text


def test_poses_behind_are_found_and_said_to_be_outside() -> None:
    """A declaration that cannot be true costs no pose: it is said."""
    site = tracker_site(np.random.default_rng(1), centre=0.0)
    far = Region(box_world=np.array([[50.0, 50.0, 50.0], [60.0, 60.0, 60.0]]))
    attitude, place = body_poses(site, 10, np.random.default_rng(5))
    result = fixed(replace(site, region=far), attitude, place)
    assert np.all(np.isfinite(result.cost[:, 0]))
    first = (result.world_from_body, result.position_world, result.pose_cov)
    findings = of_place(replace(site, region=far), result.time, *(part[:, 0] for part in first))
    assert [finding.code for finding in findings] == ["outside_region"]
    assert "the lower limit of" in findings[0].text


def test_a_site_keeps_what_it_says_of_the_place(tmp_path: Path) -> None:
    box = np.array([[0.0, -np.inf, 1.0], [5.0, 4.0, np.inf]])
    region = Region(box, HalfSpace(FRONT, np.array([0.0, 0.0, 0.5])))
    site = replace(facing(demo_site()), region=region)
    save_site(site, tmp_path / "site.yaml")
    read = load_site(tmp_path / "site.yaml")
    assert read.bounds is not None
    assert site.bounds is not None
    np.testing.assert_allclose(read.bounds.normal_world, site.bounds.normal_world, rtol=1e-14)
    np.testing.assert_allclose(read.bounds.offset, site.bounds.offset, rtol=1e-14)
    assert read.bounds.names == site.bounds.names
    text = (tmp_path / "site.yaml").read_text()
    assert "null" in text
    save_site(demo_site(), tmp_path / "plain.yaml")
    assert load_site(tmp_path / "plain.yaml").bounds is None


@pytest.mark.parametrize(
    ("line", "place"),
    [
        ("region: {}", "region: found {}; give box_m or half_space"),
        ("region: {box_m: [[0, 0, 0], [1, 1, 0]]}", "region.box_m: found"),
        ("region: {box_m: [[0, 0], [1, 1, 1]]}", "null for no limit"),
        ("region: {half_space: {normal: [0, 0, 0]}}", "region.half_space.normal"),
        ("region: {sphere: 3}", "region.sphere: is not a known key"),
    ],
)
def test_a_region_that_says_nothing_is_refused(line: str, place: str, tmp_path: Path) -> None:
    save_site(demo_site(), tmp_path / "site.yaml")
    (tmp_path / "site.yaml").write_text((tmp_path / "site.yaml").read_text() + line + "\n")
    with pytest.raises(InputError) as refused:
        load_site(tmp_path / "site.yaml")
    assert place in str(refused.value)


@pytest.mark.parametrize(
    ("where", "result"),
    [
        (Where(("A=+w",)), "a direction is one of"),
        (Where(("Z=+x",)), "no beacon 'Z'"),
        (Where(("+x",)), "has 4 beacons; specify one, e.g. --hemisphere A=+x"),
        (Where(("A=0,0,0",)), "a direction is one of"),
        (Where(region="0,1,0,1"), "six numbers"),
        (Where(region="1,0,0,1,0,1"), "below its upper limit"),
        (Where(region="-inf,inf,-inf,inf,-inf,inf"), "one finite"),
    ],
)
def test_what_the_command_line_cannot_mean_is_refused(where: Where, result: str) -> None:
    with pytest.raises(InputError) as refused:
        where.bounded(demo_site())
    assert result in str(refused.value)


def test_the_command_line_says_it_to_a_site() -> None:
    site = Where(("B=0,-1,0", "A=-z"), "0,5,-inf,4,1,inf").bounded(demo_site())
    sides = [beacon.hemisphere_beacon for beacon in site.beacons]
    np.testing.assert_array_equal(sides[0], [0.0, 0.0, -1.0])
    np.testing.assert_array_equal(sides[1], [0.0, -1.0, 0.0])
    assert sides[2] is None
    assert site.bounds is not None
    assert len(site.bounds.names) == 6


@pytest.fixture(scope="module")
def single(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return phasors of a walk in front of a lone beacon of three coils."""
    root = tmp_path_factory.mktemp("lone")
    plain = demo_site(coil_radius=None)
    size = np.linalg.norm(plain.beacons[0].coils[0].moment_beacon)
    coils = tuple(
        Coil(size * axis, frequency_hz=f)
        for axis, f in zip(np.eye(3), (20.0, 24.0, 28.0), strict=True)
    )
    beacon = replace(
        plain.beacons[0],
        coils=coils,
        position_world=np.array([0.0, 2.0, 1.0]),
        world_from_beacon=np.eye(3),
        sigma=replace(plain.beacons[0].sigma, log_moment=np.zeros(3)),
    )
    site, rng, duration = replace(plain, beacons=(beacon,)), np.random.default_rng(3), 10.0
    box = np.array([[1.0, 0.0, 0.5], [4.0, 4.0, 2.0]])
    motion = random_walk_motion(rng, duration, box, rests=Rests(0.0, duration, 0.0))
    imu = simulate_imu(motion, site.platform.imu, site.gravity, 50.0, duration, rng).samples
    truth = motion.trajectory(np.arange(0.5, duration - 0.5, 0.25))
    fields = simulate_fields(site, truth, 1e-10, rng)
    write_log(Log("lone", EPOCH_NS, "test", imu, fields=fields, truth=truth), root / "log")
    save_site(site, root / "log" / "site.yaml")
    return root / "log"


@pytest.mark.parametrize("job", ["fix", "smooth", "navigate"])
def test_every_job_takes_it_on_the_command_line(job: str, single: Path, tmp_path: Path) -> None:
    options = ("--hemisphere", "+x") if job != "smooth" else ("--region", "0,9,-9,9,-9,9")
    run_command(job, single, "-o", tmp_path / "run", *options)
    report = json.loads((tmp_path / "run" / "report.json").read_text())
    assert report["ate_m"] < 0.3
    assert not report.get("ambiguous")
    assert not report.get("ambiguous_epochs")
    assert "ambiguous" not in {reason["code"] for reason in report["reasons"]}


def test_without_it_the_opposite_side_is_said_to_be_open(single: Path, tmp_path: Path) -> None:
    run_command("fix", single, "-o", tmp_path / "run")
    report = json.loads((tmp_path / "run" / "report.json").read_text())
    assert report["ambiguity_mirror_epochs"] == report["epochs"]
    assert "ambiguous" in {reason["code"] for reason in report["reasons"]}
