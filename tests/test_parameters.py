"""Calibration parameters: how they move a site, what the phasors say of them, how they are told."""

from dataclasses import replace

import numpy as np
import pytest
from derivatives import central_difference, relative_to_group
from example_site import UNEVEN, mixed_site
from scipy.spatial.transform import Rotation

from magfusion.files.site import load_site, save_site
from magfusion.model.parameters import (
    BEACON_POSITION,
    BEACON_ROTATION,
    GAIN,
    GROUPS,
    LOG_MOMENT,
    PHASE,
    PHASE_SIGMA,
    PHASOR_PARAMETERS,
    Block,
    Parameter,
    ParameterUnit,
    choose_blocks,
    considered_blocks,
    corrected_imu,
    difference,
    dimension,
    inertial_blocks,
    initial_calibration,
    linearize_channels,
    predict_channels,
    prior_sigma,
    retract,
)
from magfusion.model.samples import ImuSamples
from magfusion.model.site import ClockModel, MagnetometerSigma
from magfusion.results.figures import DETERMINED_RATIO
from magfusion.results.observability import observability, parameter_names
from magfusion.results.refinement import parameter_estimates, refined_site
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.units import DEGREE

REFERENCE_TIME = 40.0  # s
# Of the difference quotients: an epoch is 60 s away, where a drift of 1e-5 turns a tone by 0.1 rad.
STEPS = {"drift": 1e-8, "clock_rate": 1e-7}

ALL = choose_blocks(mixed_site(), GROUPS)
GAINS = tuple(Block(GAIN, name, slice(i, i + 1), np.array([0.2])) for i, name in enumerate("ABC"))


def moved_calibration(seed=1):
    """Return a calibration away from the declared one in every parameter."""
    declared = initial_calibration(mixed_site(), REFERENCE_TIME)
    gained = retract(declared, GAINS, np.array([0.1, -0.2, 0.3]))
    return retract(gained, ALL, small_step(seed))


def small_step(seed):
    """About a prior sigma in each parameter, a radian in the phases."""
    return np.random.default_rng(seed).normal(size=dimension(ALL)) * np.minimum(
        prior_sigma(ALL), 1.0
    )


def epochs(count=5):
    rng = np.random.default_rng(2)
    rotation = Rotation.random(count, random_state=3).as_matrix()
    position = rng.uniform(*DEMO_BOX_WORLD, (count, 3))
    return np.linspace(0.0, 100.0, count), rotation, position


def real(phasor):
    return np.concatenate([phasor.real, phasor.imag], axis=-1)


def kinds(blocks):
    return {(b.group, b.kind) for b in blocks}


def renamed(site, names):
    beacons = tuple(replace(b, name=n) for b, n in zip(site.beacons, names, strict=True))
    return replace(site, beacons=beacons)


def with_magnetometer_sigma(site, **sigmas):
    sensor = site.platform.magnetometer
    sensor = replace(sensor, sigma=replace(sensor.sigma, **sigmas))
    return replace(site, platform=replace(site.platform, magnetometer=sensor))


def well_surveyed():
    """Every prior so small that it is not worth estimating."""
    site = with_magnetometer_sigma(demo_site(), matrix=np.full((3, 3), 9e-4))
    imu = replace(site.platform.imu, time_offset_sigma=9e-5, clock_rate_sigma=9e-8)
    return replace(site, platform=replace(site.platform, imu=imu))


@pytest.mark.parametrize("seed", [4, 5, 6])
def test_difference_undoes_retract(seed):
    start, step = moved_calibration(), small_step(seed)
    result = difference(start, retract(start, ALL, step), ALL)
    np.testing.assert_allclose(result, step, rtol=1e-9, atol=1e-15)


def test_retract_undoes_difference():
    a, b = moved_calibration(7), moved_calibration(8)
    again = retract(a, ALL, difference(a, b, ALL))
    time, rotation, position = epochs()
    result, expected = (predict_channels(c, time, rotation, position) for c in (again, b))
    assert relative_to_group(result, expected) < 1e-12
    assert again.time_offset == pytest.approx(b.time_offset, rel=1e-12)


def test_no_step_moves_nothing_and_no_step_changes_its_start():
    start = moved_calibration()
    time, rotation, position = epochs()
    before = predict_channels(start, time, rotation, position)
    unmoved = retract(start, ALL, np.zeros(dimension(ALL)))
    retract(start, ALL, small_step(9))
    assert np.array_equal(predict_channels(start, time, rotation, position), before)
    assert np.array_equal(predict_channels(unmoved, time, rotation, position), before)


def test_steps_of_all_beacons_at_once_are_those_of_each_alone():
    start, step = moved_calibration(), small_step(11)
    at_once, one_by_one = retract(start, ALL, step), start
    for block in ALL:
        one_by_one = block.parameter.moved(one_by_one, block.owner, step[block.columns])
    np.testing.assert_allclose(difference(at_once, one_by_one, ALL), 0.0, atol=1e-15)
    for block in ALL:
        alone = block.parameter.difference(start, at_once, block.owner)
        result = difference(start, at_once, ALL)[block.columns]
        np.testing.assert_allclose(result, alone, rtol=1e-13, atol=1e-16)


def test_retract_turns_on_the_right_and_shifts_beacons_in_world_axes():
    site = mixed_site()
    start, step = initial_calibration(site, 0.0), small_step(10)
    moved = retract(start, ALL, step).site
    parts = {block.name: step[block.columns] for block in ALL}
    for old, new in zip(site.beacons, moved.beacons, strict=True):
        turn = Rotation.from_rotvec(parts[f"{old.name}.rotation"]).as_matrix()
        np.testing.assert_allclose(new.world_from_beacon, old.world_from_beacon @ turn, rtol=1e-13)
        np.testing.assert_allclose(
            new.position_world, old.position_world + parts[f"{old.name}.position"], rtol=1e-13
        )
    old, new = site.platform.magnetometer, moved.platform.magnetometer
    turn = Rotation.from_rotvec(parts["sensor.rotation"]).as_matrix()
    np.testing.assert_allclose(new.body_from_sensor, old.body_from_sensor @ turn, rtol=1e-13)
    lever = old.position_body + parts["sensor.position"]
    np.testing.assert_allclose(new.position_body, lever, rtol=1e-13)


@pytest.mark.parametrize("block", ALL + GAINS, ids=lambda block: block.name)
def test_each_block_of_the_jacobian_is_the_derivative_through_retract(block):
    start, (time, rotation, position) = moved_calibration(), epochs()
    rate, velocity_body = np.random.default_rng(11).normal(size=(2, len(time), 3))
    alone = (block._replace(columns=slice(0, len(block.sigma))),)

    def predicted(step):
        moved = retract(start, alone, step)
        # A sample is taken later than stamped: at the time of an epoch the body is not yet there.
        late = (moved.imu_offset(time) - start.imu_offset(time))[:, None]
        rotated = rotation @ Rotation.from_rotvec(-rate * late).as_matrix()
        place = position - late * (rotation @ velocity_body[..., None])[..., 0]
        return real(predict_channels(moved, time, rotated, place))

    twist = np.concatenate([rate, velocity_body], axis=1)
    blocks = GAINS if block in GAINS else ALL
    value, _, columns = linearize_channels(start, blocks, time, rotation, position, twist)
    expected = central_difference(predicted, len(block.sigma), STEPS.get(block.kind, 1e-5))
    assert relative_to_group(columns[..., block.columns], expected) < 2e-8
    assert relative_to_group(value, real(predict_channels(start, time, rotation, position))) < 1e-14


def test_the_poses_block_is_the_derivative_by_the_pose():
    start, (time, rotation, position) = moved_calibration(), epochs()

    def predicted(step):
        rotated = rotation @ Rotation.from_rotvec(step[:3]).as_matrix()
        return real(predict_channels(start, time, rotated, position + rotation @ step[3:]))

    _, by_pose, by_calibration = linearize_channels(start, (), time, rotation, position)
    expected = central_difference(predicted, 6, 1e-5)
    assert relative_to_group(by_pose[..., :3], expected[..., :3]) < 1e-8
    assert relative_to_group(by_pose[..., 3:], expected[..., 3:]) < 1e-8
    assert by_calibration.shape == (*expected.shape[:-1], 0)


def test_a_gain_scales_its_beacon_and_no_other_and_difference_finds_it():
    start = initial_calibration(mixed_site(), REFERENCE_TIME)
    moved = retract(start, GAINS, np.array([0.1, -0.2, 0.0]))
    owners = [name for name, _ in start.site.channels]
    factor = np.exp([{"A": 0.1, "B": -0.2}.get(name, 0.0) for name in owners])
    plain, scaled = (predict_channels(c, *epochs()) for c in (start, moved))
    np.testing.assert_allclose(scaled, factor[:, None] * plain, rtol=1e-14)
    np.testing.assert_allclose(difference(start, moved, GAINS), [0.1, -0.2, 0.0], atol=1e-16)


def test_the_time_offset_cannot_be_linearised_without_a_twist():
    blocks = choose_blocks(mixed_site(), ["time-offset"])
    with pytest.raises(ValueError, match="twist_body"):
        linearize_channels(moved_calibration(), blocks, *epochs())


def test_phases_run_from_the_reference_time_at_the_drift_of_their_beacon():
    site = mixed_site()
    start = initial_calibration(site, REFERENCE_TIME)
    moved = replace(start, drift=np.array([0.0, 1e-5, -2e-5, 0.0]), phase=np.arange(6.0))
    at_reference = moved.drive_phase(np.array([REFERENCE_TIME]))[0]
    np.testing.assert_allclose(at_reference, np.arange(6.0), rtol=1e-15)
    cycles = np.array([0.0, 22.0 * 1e-3, 25.0 * 1e-3, 28.0 * 1e-3, -31.0 * 2e-3, 0.0])
    after = moved.drive_phase(np.array([REFERENCE_TIME + 100.0]))[0]
    np.testing.assert_allclose(after - at_reference, 2.0 * np.pi * cycles, rtol=1e-12, atol=1e-15)


def test_of_its_own_accord_it_estimates_what_the_survey_left_open():
    site = well_surveyed()
    assert choose_blocks(site) == ()
    worse = replace(
        site,
        beacons=(
            replace(
                site.beacons[0],
                sigma=replace(site.beacons[0].sigma, position_world=np.array([0.0, 3e-3, 0.0])),
            ),
            *site.beacons[1:],
        ),
    )
    (block,) = choose_blocks(worse)
    assert (block.name, block.columns) == ("A.position", slice(0, 3))
    # The axes that are known stay so, a millionth of the open one.
    np.testing.assert_allclose(block.sigma, [3e-9, 3e-3, 3e-9], rtol=1e-12)


@pytest.mark.parametrize("kind", [BEACON_POSITION, BEACON_ROTATION, LOG_MOMENT])
def test_a_sigma_at_the_negligible_is_held_and_one_above_it_is_estimated(kind):
    name = kind.sigma_attribute
    site = well_surveyed()
    first = site.beacons[0]
    for factor, expected in ((1.0, ()), (1.01, (f"A.{kind.kind}",))):
        sigma = np.full_like(getattr(first.sigma, name), factor * kind.negligible)
        changed = replace(first, sigma=replace(first.sigma, **{name: sigma}))
        worse = replace(site, beacons=(changed, *site.beacons[1:]))
        assert tuple(b.name for b in choose_blocks(worse)) == expected


def test_beacons_without_synchronisation_always_have_phase_and_drift():
    blocks = choose_blocks(demo_site(synchronised=False))
    drive = [b for b in blocks if b.group == "phase"]
    assert [b.name for b in drive[:2]] == ["A.phase", "A.drift"]
    assert len(drive) == 8
    assert drive[0].sigma == PHASE_SIGMA
    assert drive[1].sigma == ClockModel().drift_sigma


@pytest.mark.parametrize("group", sorted(set(GROUPS) - {"aiding", "ground", "earth"}))
def test_a_group_is_chosen_by_its_name_alone(group):
    blocks = choose_blocks(mixed_site(), [group])
    assert {b.group for b in blocks} == {group}
    assert kinds(blocks) == {k for k in kinds(ALL) if k[0] == group}


def test_a_group_that_is_asked_for_comes_however_small_its_sigma_unless_it_is_zero():
    assert {b.group for b in choose_blocks(well_surveyed(), GROUPS)} == (
        set(GROUPS) - {"phase", "aiding", "ground", "earth"}
    )
    known = with_magnetometer_sigma(
        well_surveyed(), matrix=np.zeros((3, 3)), position_body=np.zeros(3)
    )
    names = {b.name for b in choose_blocks(known, ["magnetometer", "extrinsics"])}
    assert names == {"sensor.rotation"}


def test_an_unknown_group_is_refused_by_name():
    with pytest.raises(ValueError, match="'wheels'"):
        choose_blocks(mixed_site(), ["moments", "wheels"])


def test_columns_follow_each_other_and_carry_the_sites_sigmas():
    stop = 0
    for block in ALL:
        assert block.columns == slice(stop, stop + len(block.sigma))
        stop = block.columns.stop
    assert dimension(ALL) == len(prior_sigma(ALL)) == stop
    sigma = {b.name: b.sigma for b in ALL}
    np.testing.assert_array_equal(sigma["B.position"], 0.01 * UNEVEN)
    np.testing.assert_array_equal(sigma["magnetometer.matrix"], 0.01 * np.arange(1.0, 10.0))
    assert dimension(()) == len(prior_sigma(())) == 0


@pytest.mark.parametrize("groups", [None, (), ("moments", "extrinsics"), GROUPS])
def test_held_and_estimated_are_together_all_that_is_uncertain(groups):
    site = mixed_site()
    estimated = choose_blocks(site, groups)
    fixed = considered_blocks(site, estimated)
    names = [{b.name for b in blocks} for blocks in (estimated, fixed)]
    assert names[0] | names[1] == {b.name for b in ALL}
    assert not names[0] & names[1]
    assert dimension(estimated) + dimension(fixed) == dimension(ALL)
    assert [b.columns.start for b in fixed[1:]] == [b.columns.stop for b in fixed[:-1]]


def test_a_beacon_may_be_called_sensor_or_magnetometer():
    plain = mixed_site()
    odd = renamed(plain, ("sensor", "magnetometer", "imu", "D"))
    blocks = choose_blocks(odd, GROUPS)
    step = small_step(12)
    plain_moved = retract(initial_calibration(plain, 0.0), ALL, step)
    odd_moved = retract(initial_calibration(odd, 0.0), blocks, step)
    result, expected = (predict_channels(c, *epochs()) for c in (odd_moved, plain_moved))
    assert np.array_equal(result, expected)
    start = initial_calibration(odd, 0.0)
    np.testing.assert_allclose(difference(start, odd_moved, blocks), step, rtol=1e-9, atol=1e-15)
    own = choose_blocks(odd, ["beacons", "moments"])
    assert dimension(own) + dimension(considered_blocks(odd, own)) == dimension(blocks)


def refined(shrink=0.1):
    declared = initial_calibration(mixed_site(), REFERENCE_TIME)
    fitted = retract(declared, ALL, small_step(13))
    cov = np.diag((shrink * prior_sigma(ALL)) ** 2)
    reported = parameter_estimates(declared, fitted, ALL, cov)
    return fitted, reported, refined_site(fitted, ALL, cov, reported, "walk")


def test_a_parameter_is_determined_where_the_data_halved_its_sigma():
    declared = initial_calibration(mixed_site(), REFERENCE_TIME)
    shrink = np.tile([0.9, 1.1], dimension(ALL))[: dimension(ALL)] * DETERMINED_RATIO
    reported = parameter_estimates(
        declared, declared, ALL, np.diag((shrink * prior_sigma(ALL)) ** 2)
    )
    assert [f.determined for f in reported] == list(shrink < DETERMINED_RATIO)
    assert {f.change for f in reported} == {0.0}


def test_estimates_are_named_with_the_unit_of_their_figures():
    reported = {f.key: f for f in refined()[1]}
    assert len(reported) == dimension(ALL)
    step = dict(zip([f.key for f in refined()[1]], small_step(13), strict=True))
    units = {
        "A.rotation_y_deg": DEGREE,
        "B.position_z_m": 1.0,
        "B.log_moment_2": 1.0,
        "C.log_moment": 1.0,
        "B.phase_1_deg": DEGREE,
        "C.phase_deg": DEGREE,
        "C.drift_ppm": 1e-6,
        "magnetometer.matrix_yx": 1.0,
        "sensor.rotation_x_deg": DEGREE,
        "sensor.position_y_m": 1.0,
        "imu.time_offset_s": 1.0,
        "imu.clock_rate_ppm": 1e-6,
    }
    for name, unit in units.items():
        assert reported[name].change == pytest.approx(step[name] / unit, rel=1e-8), name
    assert reported["A.rotation_y_deg"].prior_sigma == pytest.approx(0.04 / DEGREE)
    assert reported["A.rotation_y_deg"].sigma == pytest.approx(0.004 / DEGREE)
    assert reported["C.drift_ppm"].prior_sigma == pytest.approx(20.0)
    assert reported["magnetometer.matrix_yx"].prior_sigma == pytest.approx(0.04)


def test_a_refined_site_has_the_fitted_values_and_the_posterior_sigmas():
    fitted, _, site = refined(shrink=0.1)
    declared = mixed_site()
    for new, old in zip(site.beacons, declared.beacons, strict=True):
        for name in ("position_world", "rotation_beacon", "log_moment"):
            expected = 0.1 * getattr(old.sigma, name)
            np.testing.assert_allclose(getattr(new.sigma, name), expected, rtol=1e-12)
    new, old = site.platform.magnetometer.sigma, declared.platform.magnetometer.sigma
    for name in ("matrix", "rotation_sensor", "position_body"):
        np.testing.assert_allclose(getattr(new, name), 0.1 * getattr(old, name), rtol=1e-12)
    assert np.array_equal(new.offset, old.offset)
    imu = site.platform.imu
    assert imu.time_offset == fitted.time_offset
    assert imu.time_offset_sigma == pytest.approx(
        0.1 * declared.platform.imu.time_offset_sigma, rel=1e-12
    )
    assert imu.clock_rate == fitted.clock_rate
    assert imu.clock_rate_sigma == pytest.approx(5e-6, rel=1e-12)
    assert np.array_equal(site.beacons[1].position_world, fitted.site.beacons[1].position_world)


def test_a_refined_site_keeps_the_sigmas_of_what_was_not_estimated():
    blocks = choose_blocks(mixed_site(), ["moments"])
    declared = initial_calibration(mixed_site(), 0.0)
    cov = np.diag((0.2 * prior_sigma(blocks)) ** 2)
    site = refined_site(
        declared, blocks, cov, parameter_estimates(declared, declared, blocks, cov), "walk"
    )
    np.testing.assert_array_equal(site.beacons[0].sigma.position_world, 0.01 * UNEVEN)
    np.testing.assert_allclose(site.beacons[0].sigma.log_moment, 0.002 * UNEVEN[:2], rtol=1e-12)
    assert site.platform.imu == mixed_site().platform.imu


def test_a_refined_site_survives_its_file_and_tells_what_was_determined(tmp_path):
    fitted, reported, site = refined()
    save_site(site, tmp_path / "site.yaml")
    again = load_site(tmp_path / "site.yaml")
    # The drive belongs to the log: phases and drifts are not the site's.
    static = tuple(block for block in ALL if block.group != "phase")
    expected, result = (
        replace(
            fitted,
            site=s,
            time_offset=s.platform.imu.time_offset,
            clock_rate=s.platform.imu.clock_rate,
        )
        for s in (site, again)
    )
    step = difference(expected, result, static)
    assert np.max(np.abs(step)) < 1e-13
    loaded = prior_sigma(choose_blocks(again, GROUPS))
    np.testing.assert_allclose(loaded, prior_sigma(choose_blocks(site, GROUPS)), rtol=1e-12)
    assert isinstance(again.platform.magnetometer.sigma, MagnetometerSigma)
    record = again.calibration
    assert record["log"] == "walk"
    assert record["determined"] == [f.key for f in reported]
    assert record["undetermined"] == []
    of_drive = [f for f in reported if ".phase" in f.name or "drift" in f.name]
    drive = {f.key: [f.change, f.sigma] for f in of_drive}
    assert len(drive) == 6
    assert record["drive"] == drive


class GyroScale(Parameter):
    """A parameter that the package does not know."""

    group, owner, kind = "gyro", "imu", "gyro_scale"
    components, unit = ("x", "y", "z"), ParameterUnit("ppm", 1e-6)
    inertial = of_log = True

    def sigma(self, site, owner):  # noqa: ARG002
        return np.full(3, 1e-3)

    def corrected_imu(self, calibration, owner, imu):
        scale = 1.0 + calibration.others.get(f"{owner}.{self.kind}", np.zeros(3))
        return replace(imu, gyro_body=imu.gyro_body / scale)


def test_a_parameter_from_outside_is_one_class():
    kinds, site = (*PHASOR_PARAMETERS, GyroScale()), mixed_site()
    blocks = choose_blocks(site, parameters=kinds)
    own = [b for b in blocks if b.name == "imu.gyro_scale"]
    assert dimension(blocks) == dimension(choose_blocks(site)) + 3
    np.testing.assert_array_equal(prior_sigma(blocks)[own[0].columns], 1e-3)
    (alone,) = choose_blocks(site, ["gyro"], parameters=kinds)
    assert (alone.key, alone.columns) == (own[0].key, slice(0, 3))
    fixed = considered_blocks(site, choose_blocks(site), parameters=kinds)
    assert "imu.gyro_scale" in [b.name for b in fixed]

    declared = initial_calibration(site, REFERENCE_TIME)
    step = np.random.default_rng(14).normal(size=dimension(blocks)) * np.minimum(
        prior_sigma(blocks), 1.0
    )
    fitted = retract(declared, blocks, step)
    np.testing.assert_allclose(difference(declared, fitted, blocks), step, rtol=1e-9, atol=1e-15)
    back = difference(fitted, retract(fitted, blocks, -step), own)
    np.testing.assert_allclose(back[-3:], -step[own[0].columns], rtol=1e-12)

    cov = np.diag((0.1 * prior_sigma(blocks)) ** 2)
    reported = parameter_estimates(declared, fitted, blocks, cov)
    finding = next(f for f in reported if f.key == "imu.gyro_scale_y_ppm")
    assert finding.change == pytest.approx(step[own[0].columns][1] / 1e-6, rel=1e-12)
    assert finding.prior_sigma == pytest.approx(1000.0)
    refined = refined_site(fitted, blocks, cov, reported, "walk")
    assert finding.key in refined.calibration["determined"]
    assert refined.calibration["drive"][finding.key] == [finding.change, finding.sigma]
    assert not [c for c in refined.correlation.parameters if c.kind == "gyro_scale"]
    result = observability(fitted, blocks, cov)
    assert len(result.ratio) == dimension(blocks)
    assert parameter_names(tuple(own), fitted)[0][0] == "imu.gyro_scale 0"


def test_a_parameter_corrects_the_inertial_stream_where_it_says_so():
    blocks = choose_blocks(mixed_site(), parameters=(*PHASOR_PARAMETERS, GyroScale()))
    start = initial_calibration(mixed_site(), 0.0)
    time, rate = np.arange(4.0), np.random.default_rng(15).normal(size=(4, 3))
    imu = ImuSamples(time, rate, rate)
    step = np.where(np.arange(dimension(blocks)) >= dimension(blocks) - 3, 0.5, 0.0)
    moved = retract(start, blocks, step)
    assert [b.name for b in inertial_blocks(blocks)] == ["imu.gyro_scale"]
    np.testing.assert_allclose(corrected_imu(moved, blocks, imu).gyro_body, rate / 1.5, rtol=1e-15)
    assert corrected_imu(moved, ALL, imu) is imu


def test_every_kind_of_parameter_has_its_own_words_and_walks_as_the_site_says():
    site = mixed_site()
    for block in ALL:
        words = {block.parameter.called(site, block.owner, i) for i in range(len(block.sigma))}
        assert block.kind == "phase" or len(words) == len(block.sigma)
        assert block.kind not in words
    walks = {b.kind: b.parameter.walk_per_sqrt_hour(site, b.owner) for b in ALL}
    assert {k: v for k, v in walks.items() if v} == {
        "log_moment": 1e-3,
        "phase": 0.02,
        "drift": 1e-8,
    }
    faster = replace(site, clock=ClockModel(phase_walk=0.5))
    assert PHASE.walk_per_sqrt_hour(faster, "") == 0.5
