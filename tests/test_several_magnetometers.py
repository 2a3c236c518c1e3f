"""Several magnetometers on one platform: each at its place, by its clock, with its own response."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as parquet
import pytest
from derivatives import central_difference, relative_to_group
from example_site import mixed_site
from scipy.spatial.transform import Rotation

from magfusion.errors import InputError
from magfusion.estimation.batch.batch import Smoothed, SmootherSettings, smooth
from magfusion.estimation.data_checks.magnetometers import without_silent
from magfusion.estimation.graph.state import as_trajectory
from magfusion.estimation.integrity.magnetometer_exclusion import agreed
from magfusion.estimation.online.navigator import Navigator, NavigatorSettings
from magfusion.estimation.online_integrity.judgement import JudgedState
from magfusion.estimation.snapshot.likelihood import fix_epochs
from magfusion.files.fields import (
    on_log_clock,
    order_channels,
    read_fields,
    side_by_side,
    write_fields,
)
from magfusion.files.site import load_site, save_site
from magfusion.files.table import Span
from magfusion.jobs.replay import Replay, feed
from magfusion.model.parameters import (
    Block,
    Calibration,
    choose_blocks,
    dimension,
    initial_calibration,
    linearize_channels,
    predict_channels,
    retract,
)
from magfusion.model.response import AxisResponses, FrequencyResponse
from magfusion.model.samples import FieldSamples, ImuSamples, Log
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.results.errors import trajectory_errors
from magfusion.simulation.demo_site import demo_site
from magfusion.simulation.log import SimulatedLog, SimulationConfig, simulate_fields, simulate_log

FREQUENCIES = np.array([5.0, 20.0, 60.0])
NO_SAMPLES = ImuSamples(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3)))
GROUPS = ("beacons", "moments", "phase", "magnetometer", "extrinsics", "time-offset")


def axis(gain: float, phase: float) -> FrequencyResponse:
    return FrequencyResponse(
        FREQUENCIES, np.array([1.0, gain, gain**2]), np.array([0, 1, 2]) * phase
    )


def two_magnetometers(site: Site | None = None) -> Site:
    """Both uneven, 0.27 m apart, by different clocks; the second by axes that answer apart."""
    site = mixed_site() if site is None else site
    known = site.platform.magnetometer
    remaining = replace(known, name="left", position_body=np.array([0.13, 0.02, 0.01]))
    right = replace(
        known,
        name="right",
        position_body=np.array([-0.14, 0.03, -0.02]),
        body_from_sensor=Rotation.from_euler("xyz", (1.0, 2.0, 0.4)).as_matrix(),
        matrix=np.array([[0.9, 0.01, 0.0], [0.03, 1.1, 0.02], [0.0, -0.02, 1.0]]),
        response=AxisResponses(axis(0.9, -0.2), axis(0.8, 0.1), axis(0.95, -0.05)),
        clock_offset=0.004,
        sigma=replace(known.sigma, clock_offset=5e-4),
    )
    return replace(site, platform=site.platform.with_magnetometers((remaining, right)))


def only(site: Site, which: int) -> Site:
    return replace(
        site, platform=site.platform.with_magnetometers((site.platform.magnetometers[which],))
    )


def poses(count: int, seed: int = 2) -> Trajectory:
    rng = np.random.default_rng(seed)
    return Trajectory(
        time=np.arange(float(count)),
        world_from_body=Rotation.random(count, rng=rng).as_matrix(),
        position_world=rng.uniform([0.5, 0.5, 0.3], [4.0, 3.0, 1.8], (count, 3)),
    )


def real(phasor: np.ndarray) -> np.ndarray:
    return np.concatenate([phasor.real, phasor.imag], axis=-1)


def test_the_model_agrees_with_the_simulator_which_does_not_know_it() -> None:
    site, at = two_magnetometers(), poses(4)
    simulated = simulate_fields(site, at, 1e-30, np.random.default_rng(0))
    result = predict_channels(
        initial_calibration(site, 0.0), at.time, at.world_from_body, at.position_world
    )
    size = np.max(np.abs(simulated.phasor_sensor))
    assert np.max(np.abs(result - simulated.phasor_sensor)) < 1e-9 * size
    assert simulated.magnetometers == ("left",) * 6 + ("right",) * 6


def test_every_channel_is_that_of_its_magnetometer_alone() -> None:
    site, at = two_magnetometers(), poses(3)
    place = at.time, at.world_from_body, at.position_world
    whole = predict_channels(initial_calibration(site, 0.0), *place)
    for which in range(2):
        own = predict_channels(initial_calibration(only(site, which), 0.0), *place)
        np.testing.assert_array_equal(whole[:, site.of_sensor(which)], own)


def test_the_jacobian_is_the_derivative_of_the_prediction() -> None:
    site, at = two_magnetometers(), poses(2)
    blocks = choose_blocks(site, GROUPS)
    assert {"left.matrix", "right.matrix", "left.rotation", "right.position"} <= {
        block.name for block in blocks
    }
    rng = np.random.default_rng(1)
    start = initial_calibration(site, 0.3)
    start = replace(start, drift=rng.normal(0.0, 1e-5, 4), phase=np.tile(rng.normal(size=6), 2))
    still = np.zeros((2, 6))
    value, by_pose, columns = linearize_channels(
        start, blocks, at.time, at.world_from_body, at.position_world, still
    )

    def seen(calibration: Calibration, step: np.ndarray) -> np.ndarray:
        rotated = at.world_from_body @ Rotation.from_rotvec(step[:3]).as_matrix()
        place = at.position_world + at.world_from_body @ step[3:]
        return real(predict_channels(calibration, at.time, rotated, place))

    assert relative_to_group(value, seen(start, np.zeros(6))) < 1e-14
    assert relative_to_group(by_pose, central_difference(lambda s: seen(start, s), 6, 1e-5)) < 1e-8
    for block in blocks:
        if block.owner == "imu":
            continue

        def moved(step: np.ndarray, block: Block = block) -> np.ndarray:
            whole = np.zeros(dimension(blocks))
            whole[block.columns] = step
            return seen(retract(start, blocks, whole), np.zeros(6))

        expected = central_difference(moved, len(block.sigma), 1e-6)
        assert relative_to_group(columns[..., block.columns], expected) < 1e-6, block.name


def test_a_site_keeps_its_magnetometers(tmp_path: Path) -> None:
    site = two_magnetometers()
    save_site(site, tmp_path / "site.yaml")
    result = load_site(tmp_path / "site.yaml", several=True)
    for mine, others in zip(
        site.platform.magnetometers, result.platform.magnetometers, strict=True
    ):
        assert (mine.name, mine.clock_offset) == (others.name, others.clock_offset)
        assert mine.sigma.clock_offset == others.sigma.clock_offset
        np.testing.assert_allclose(mine.position_body, others.position_body)
    answer = result.platform.further[0].response
    assert isinstance(answer, AxisResponses)
    np.testing.assert_allclose(answer.y.gain, axis(0.8, 0.1).gain)
    save_site(result, tmp_path / "again.yaml")
    assert (tmp_path / "again.yaml").read_text() == (tmp_path / "site.yaml").read_text()


NAMED = "  magnetometers:\n  - name: left\n"


@pytest.mark.parametrize(
    ("change", "findings"),
    [
        (("name: right", "name: left"), r"magnetometers\[1\].name: found 'left'; give it another"),
        (("name: right", "name: A"), r"magnetometers\[1\].name: found 'A'.*beacons\[0\]"),
        ((NAMED, "  magnetometers:\n  - clock_offset_s: 0.0\n"), r"\[0\].name: is missing; add it"),
        (("clock_offset_s: 0.0005", "clock_offset_s: 0.1"), r"sigma.clock_offset_s.*by one clock"),
        ((NAMED, NAMED + "    clock_offset_s: 0.1\n"), r"\[0\].clock_offset_s.*is that of the log"),
        ((NAMED, NAMED + "    axes: [x]\n"), r"\[0\].axes.*give all three axes"),
        (("frequency_hz: 60.0", "frequency_hz: 30.0"), r"axis_responses.x: found .*as far as"),
    ],
)
def test_what_does_not_fit_is_refused(
    tmp_path: Path, change: tuple[str, str], findings: str
) -> None:
    save_site(two_magnetometers(), tmp_path / "site.yaml")
    text = (tmp_path / "site.yaml").read_text()
    assert change[0] in text
    (tmp_path / "site.yaml").write_text(text.replace(*change, 1))
    with pytest.raises(InputError, match=findings):
        load_site(tmp_path / "site.yaml", several=True)


def by_own_clock(site: Site, at: Trajectory, which: int, seed: int) -> FieldSamples:
    """Return what one magnetometer recorded, as it stamps it."""
    own = only(site, which)
    result = simulate_fields(own, at, 1e-10, np.random.default_rng(seed))
    sensor = own.platform.magnetometer
    tones = np.concatenate([beacon.tone_frequencies_hz for beacon in own.beacons])
    turn = np.exp(2j * np.pi * tones * sensor.clock_offset)
    return replace(
        result,
        time=result.time - sensor.clock_offset,
        phasor_sensor=result.phasor_sensor * turn[:, None],
        magnetometers=(sensor.name,) * len(own.channels),
    )


def recorded(site: Site, path: Path) -> tuple[FieldSamples, Trajectory]:
    """Write and read what both recorded, the second at twice the rate."""
    at = poses(9)
    rare = Trajectory(at.time[::2], at.world_from_body[::2], at.position_world[::2])
    parts = [by_own_clock(site, rare, 0, 1), by_own_clock(site, at, 1, 2)]
    tables = []
    for k, part in enumerate(parts):
        write_fields(part, path / f"{k}.parquet", 0)
        tables.append(parquet.read_table(path / f"{k}.parquet"))
    parquet.write_table(pa.concat_tables(tables).sort_by("time_ns"), path / "fields.parquet")
    return read_fields(path / "fields.parquet", Span(0)), at


def test_fields_are_arranged_by_the_clock_of_the_log(tmp_path: Path) -> None:
    site = two_magnetometers()
    raw, at = recorded(site, tmp_path)
    result = order_channels(raw, site)
    np.testing.assert_allclose(result.time, at.time, atol=1e-9)
    assert result.channels == site.channels
    remaining, right = (result.valid[:, site.of_sensor(k)] for k in range(2))
    assert np.all(right)
    assert np.all(remaining[::2])
    assert not np.any(remaining[1::2])
    expected = predict_channels(
        initial_calibration(site, 0.0), at.time, at.world_from_body, at.position_world
    )
    error = np.abs(result.phasor_sensor - expected)[result.valid]
    assert np.max(error) < 1e-9


def test_a_fix_is_of_all_magnetometers_of_an_epoch(tmp_path: Path) -> None:
    site = two_magnetometers()
    exact = replace(
        site,
        model_error=1e-4,
        beacons=tuple(replace(b, synchronised=True) for b in site.beacons),
    )
    raw, at = recorded(exact, tmp_path)
    samples = order_channels(raw, exact)
    fixes = fix_epochs(samples, initial_calibration(exact, 0.0), survey_error=False)
    error = np.linalg.norm(fixes.position_world[:, 0] - at.position_world, axis=1)
    assert np.max(error) < 2e-3
    alone = fix_epochs(
        order_channels(raw, only(exact, 1)), initial_calibration(only(exact, 1), 0.0)
    )
    both = np.trace(fixes.pose_cov[::2, 0], axis1=1, axis2=2)
    assert np.all(both < np.trace(alone.pose_cov[::2, 0], axis1=1, axis2=2))


def test_fields_that_do_not_say_whose_they_are_are_refused(tmp_path: Path) -> None:
    site = two_magnetometers()
    raw, _ = recorded(site, tmp_path)
    with pytest.raises(InputError, match="add a column magnetometer with its name"):
        order_channels(replace(raw, magnetometers=()), site)
    strange = tuple("middle" if name == "left" else name for name in raw.magnetometers)
    with pytest.raises(InputError, match=r"magnetometer middle.*it has left, right"):
        order_channels(replace(raw, magnetometers=strange), site)


def test_one_that_hears_nothing_is_named_and_left_out() -> None:
    site = two_magnetometers()
    at = poses(12)
    result = simulate_fields(site, at, 1e-10, np.random.default_rng(0))
    noise = np.random.default_rng(1).normal(0.0, 1e-10, (2, 12, 6, 3))
    quiet = result.phasor_sensor.copy()
    quiet[:, site.of_sensor(1)] = noise[0] + 1j * noise[1]
    log = Log("two", 0, "simulation", NO_SAMPLES, fields=replace(result, phasor_sensor=quiet))
    remaining, alone = without_silent(log, site)
    assert [finding.code for finding in remaining.findings] == ["magnetometer_silent"]
    assert "right detects no beacon in 12 epochs" in remaining.findings[0].text
    assert [sensor.name for sensor in alone.platform.magnetometers] == ["left"]
    assert remaining.fields is not None
    np.testing.assert_array_equal(remaining.fields.phasor_sensor, quiet[:, site.of_sensor(0)])
    both = replace(log, fields=result)
    assert without_silent(both, site) == (both, site)


def test_the_first_that_hears_nothing_stays_in_the_file_and_keeps_the_clock(tmp_path: Path) -> None:
    """The clock of the second is told against it; a file without it would be refused."""
    first, second = two_magnetometers().platform.magnetometers
    third = replace(second, name="third", clock_offset=-0.002)
    site = two_magnetometers()
    site = replace(site, platform=site.platform.with_magnetometers((first, second, third)))
    result = simulate_fields(site, poses(12), 1e-10, np.random.default_rng(0))
    noise = np.random.default_rng(1).normal(0.0, 1e-10, (2, 12, 6, 3))
    for dead in ((0,), (0, 1), (1, 2), (0, 2)):
        quiet = result.phasor_sensor.copy()
        for which in dead:
            quiet[:, site.of_sensor(which)] = noise[0] + 1j * noise[1]
        fields = replace(result, phasor_sensor=quiet)
        log, alone = without_silent(Log("three", 0, "simulation", NO_SAMPLES, fields=fields), site)
        assert log.fields is not None
        assert len(alone.platform.magnetometers) == 3 - len(dead)
        save_site(alone, tmp_path / "site.yaml")
        again = load_site(tmp_path / "site.yaml", several=True).platform.magnetometers
        assert [(one.name, one.clock_offset) for one in again] == [
            ("left", 0.0),
            ("right", 0.004),
            ("third", -0.002),
        ]


def walked(seed: int) -> tuple[Log, Site, SimulatedLog]:
    """Return a walk with both, ten and seven times a second."""
    site = two_magnetometers(demo_site(coil_radius=None))
    box = np.array([[1.0, 1.0, 0.5], [4.0, 3.0, 1.5]])
    rng = np.random.default_rng(seed)
    walk = simulate_log(site, SimulationConfig(box_world=box, duration=12.0), rng)
    parts = []
    for which, rate in enumerate((10.0, 7.0)):
        at = walk.motion.trajectory(np.arange(0.5, 11.5, 1.0 / rate))
        parts.append(by_own_clock(walk.true_site, at, which, seed))
    fields = side_by_side(
        [on_log_clock(part, only(site, which)) for which, part in enumerate(parts)], site
    )
    return replace(walk.log, waveforms={}, fields=fields), site, walk


@pytest.mark.slow
def test_the_clock_of_the_second_is_found_by_the_phases() -> None:
    log, site, walk = walked(3)
    result = smooth(log, site, SmootherSettings(tune=False))
    true = walk.true_site.platform.further[0].clock_offset - 0.004
    late = result.calibration.clock_offsets[1]
    names = [block.name for block in result.blocks]
    assert "right.clock_offset" in names
    column = result.blocks[names.index("right.clock_offset")].columns.start
    sigma = np.sqrt(result.calibration_cov[column, column])
    assert abs(late - true) < 4.0 * sigma < 1e-4
    assert trajectory_errors(result.states, walk.motion.trajectory(result.states.time)).ate < 5e-3


@pytest.mark.slow
def test_one_that_is_mounted_otherwise_is_named_and_the_other_goes_on() -> None:
    log, site, _ = walked(4)
    remaining, right = site.platform.magnetometers
    turn = Rotation.from_euler("x", 8.0, degrees=True).as_matrix()
    wrong = replace(right, body_from_sensor=right.body_from_sensor @ turn)
    site = replace(site, platform=site.platform.with_magnetometers((remaining, wrong)))

    def solve(log: Log, site: Site) -> Smoothed:
        return smooth(log, site, SmootherSettings(tune=False))

    result = agreed(solve(log, site), log, site, solve, solve)
    assert [finding.code for finding in result.findings] == ["magnetometer_excluded"]
    assert "Magnetometer right" in result.findings[0].text
    assert [sensor.name for sensor in result.site.platform.magnetometers] == ["left"]


@pytest.mark.slow
def test_online_as_offline_it_is_named_at_the_start_and_the_other_is_not_blamed() -> None:
    log, site, walk = walked(4)
    remaining, right = site.platform.magnetometers
    turn = Rotation.from_euler("x", 8.0, degrees=True).as_matrix()
    wrong = replace(right, body_from_sensor=right.body_from_sensor @ turn)
    site = replace(site, platform=site.platform.with_magnetometers((remaining, wrong)))
    navigator, states = Navigator(site, NavigatorSettings("ekf")), list[JudgedState]()
    for _, piece in Replay(log).pieces():
        feed(navigator, piece)
        states += navigator.take()
    assert states
    for state in states:
        reasons = state.judgement.reasons
        named = [f for f in reasons if f.code == "magnetometer_excluded"]
        assert len(named) == 1
        assert named[0].text.startswith("Magnetometer right contradicts the others")
        assert not any("left.rotation" in f.text or f.code == "mounting" for f in reasons)
    result = as_trajectory(states)
    errors = trajectory_errors(result, walk.motion.trajectory(result.time))
    assert errors.ate < 0.02
