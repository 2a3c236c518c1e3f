"""What the raw streams say against a log: the right cause, first, and nothing of a good one."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from spoiled_log import (
    RATE,
    Change,
    Recorded,
    beacons,
    field,
    fixed,
    frozen,
    good,
    imu,
    jittery,
    kept,
    limited,
    mounted,
    silent,
    spiky,
    stuck,
    with_line,
    without_gravity,
)

from magfusion.estimation.data_checks.data_quality import recorded
from magfusion.estimation.data_checks.gravity_and_field_checks import wrong_force
from magfusion.estimation.data_checks.inertial_noise import noisy_inertial, white_density
from magfusion.estimation.data_checks.range_step import range_step
from magfusion.estimation.data_checks.samples import clipped
from magfusion.estimation.data_checks.spectrum import aliased, mains_of
from magfusion.estimation.data_checks.stamps import timing
from magfusion.estimation.data_checks.still_means import StillMeans, still_means
from magfusion.estimation.integrity.quick_check import quick_check
from magfusion.model.samples import ImuSamples, Log
from magfusion.model.trajectory import Trajectory
from magfusion.model.trust import Verdict


def _earth(one: Recorded) -> Recorded:
    earth = one.site.earth_field_world
    assert earth is not None
    return replace(one, site=replace(one.site, earth_field_world=earth * [1.0, 1.0, -1.0]))


# What is wrong, the codes that are right, and a word that the first sentence must hold.
SPOILED: dict[str, tuple[Change, tuple[str, ...], str]] = {
    "gyro reversed": (imu(gyro=lambda v: -v), ("gyro_sign",), "sign is reversed"),
    "gyro z reversed": (imu(gyro=lambda v: v * [1, 1, -1]), ("gyro_sign",), "sign of z"),
    "gyro in deg/s": (imu(gyro=lambda v: RATE * v), ("gyro_units",), "deg/s"),
    "gyro permuted": (imu(gyro=lambda v: v[:, [1, 2, 0]]), ("mounting", "imu_axes"), "120 deg"),
    "gyro swapped": (imu(gyro=lambda v: v[:, [1, 0, 2]]), ("imu_axes",), "left-handed"),
    "gyro axis dead": (imu(gyro=stuck(0, 0.0)), ("stuck_axis",), "axis x frozen"),
    "accel in g": (imu(accel=lambda v: v / 9.81), ("accel_units",), "it is in g."),
    "accel in mg": (imu(accel=lambda v: v / 9.81e-3), ("accel_units",), "it is in mg"),
    "accel reversed": (imu(accel=lambda v: -v), ("gravity_sign",), "sign is reversed"),
    "gravity removed": (without_gravity, ("gravity_missing",), "removed gravity"),
    "imu hung": (imu(frozen(2000, 3000), frozen(2000, 3000)), ("frozen_imu",), "10.00 to 14.99 s"),
    "imu spikes": (imu(spiky(0.5), spiky(5.0)), ("imu_spikes",), "isolated samples"),
    "imu late": (imu(time=lambda t: t + 0.7), ("time_offset",), "0.70 s too late"),
    "imu clock": (imu(time=lambda t: 1.02 * t), ("imu_clock",), "clock runs +"),
    "imu gap": (kept(lambda t: (t < 8.0) | (t > 11.0), of_imu=True), ("gap",), "(3.0"),
    "imu short": (kept(lambda t: t < 12.0, of_imu=True), ("streams_apart",), "overlap by 12.0 s"),
    "field in nT": (field(lambda v: 1e9 * v), ("field_units",), "in nT"),
    "field permuted": (field(lambda v: v[:, [1, 2, 0]]), ("mounting",), "120 deg"),
    "field held": (field(fixed(2)), ("repeated_samples",), "50 %"),
    "field limited": (field(limited(0.9)), ("saturated",), "is saturated at"),
    "field wraps": (
        field(lambda v: (v + 3e-5) % 6e-5 - 3e-5),
        ("saturated",),
        "its converter overflows",
    ),
    "field axis dead": (
        field(stuck(2, 1e-5)),
        ("stuck_axis",),
        "100 % of the log: it is dead or not connected. Repair",
    ),
    "field iron": (
        field(lambda v: v + np.array([9e-6, -6e-6, 3e-6])),
        ("body_iron",),
        "iron or a magnet",
    ),
    "mounted by 90 deg": (mounted((0.0, 0.0, 90.0)), ("mounting",), "by 90 deg"),
    "mounted upside down": (mounted((180.0, 0.0, 0.0)), ("mounting",), "by 180 deg"),
    "mounted by 12 deg": (mounted((0.0, 12.0, 0.0)), ("mounting",), "by 12 deg"),
    "other hemisphere": (_earth, ("earth_field",), "hemisphere"),
    "neighbour": (with_line(25.8, 3e-8), ("undeclared_line",), "25.80 Hz"),
    "beacon off": (silent("B", 8.0, 16.0), ("silent_beacon",), "beacon B (25 Hz)"),
    "beacon at another place of the band": (
        beacons(lambda b: (replace(b[0], frequency_hz=20.6), *b[1:])),
        ("undeclared_line",),
        "probably beacon A itself",
    ),
}


@pytest.mark.parametrize("name", SPOILED)
def test_the_right_cause_comes_first(name: str) -> None:
    change, codes, words = SPOILED[name]
    spoiled = change(good())
    look = quick_check(spoiled.log, spoiled.site)
    assert look.trust.verdict is not Verdict.TRUSTWORTHY
    first = look.trust.reasons[0]
    assert first.code in codes, [f.text for f in look.trust.reasons]
    assert words in first.text


@pytest.mark.parametrize("motion", ["walk", "turn", "static"])
@pytest.mark.parametrize("seed", range(3))
def test_nothing_is_said_of_a_good_log(motion: str, seed: int) -> None:
    one = good(motion, seed)
    for site in (one.site, None):
        assert quick_check(one.log, site).trust.reasons == ()


@pytest.mark.parametrize(
    "name",
    [
        "gyro reversed",
        "gyro in deg/s",
        "gyro axis dead",
        "accel in g",
        "gravity removed",
        "imu hung",
        "imu spikes",
        "field limited",
        "field axis dead",
    ],
)
def test_without_a_site_the_recording_alone_is_judged(name: str) -> None:
    change, codes, _ = SPOILED[name]
    look = quick_check(change(good()).log, None)
    assert look.trust.reasons[0].code in codes


def test_removed_gravity_is_no_other_unit() -> None:
    """Walking leaves accelerations of the size that gravity has in g."""
    one = without_gravity(good())
    force = one.log.imu.accel_body
    strong = replace(one.log.imu, accel_body=force / np.median(np.linalg.norm(force, axis=1)))
    texts = [f.text for f in quick_check(replace(one.log, imu=strong), one.site).trust.reasons]
    assert "removed gravity" in texts[0]
    assert not any("it is in g" in text for text in texts)


def test_what_happens_at_rest_to_a_steady_instrument_is_no_fault() -> None:
    """A coarse instrument at rest repeats itself for long."""
    one = good("static")
    wave = one.log.waveform
    assert wave is not None
    coarse = 5e-8 * np.round(wave.measured_sensor / 5e-8)
    log = replace(one.log, waveform=replace(wave, measured_sensor=coarse))
    result = {f.code for f in quick_check(log, one.site).trust.findings}
    assert not result & {"frozen_magnetometer", "stuck_axis", "saturated"}


def test_held_values_are_no_limit() -> None:
    """A magnetometer that is read too fast repeats its extremes as often as anything else."""
    rng = np.random.default_rng(4)
    slow = 1e-5 * np.sin(np.arange(4000) / 90.0) + 3e-8 * rng.standard_normal(4000)
    read = np.round(np.repeat(slow, rng.integers(1, 3, 4000)) / 7.5e-8) * 7.5e-8
    assert clipped(read)[0] == 0
    cut = np.minimum(read, 8e-6)
    assert clipped(cut) == (int(np.sum(cut == 8e-6)), 8e-6)


def test_stamps_tell_jitter_from_loss() -> None:
    even = np.arange(8000) / 200.0
    lost_epochs = timing("imu", even[np.random.default_rng(5).random(8000) > 0.04])
    scattered = timing("imu", jittery(1e-3)(even))
    assert lost_epochs is not None
    assert scattered is not None
    assert lost_epochs.lost_share == pytest.approx(0.04, abs=0.007)
    assert lost_epochs.jitter == 0.0
    assert scattered.lost_share < 0.005
    assert scattered.jitter == pytest.approx(1e-3, rel=0.15)


def test_compasses_know_gravity_and_field_without_a_beacon() -> None:
    one = good("walk")
    means = still_means(one.log, one.site)
    earth = one.site.earth_field_world
    assert earth is not None
    force = np.median(np.linalg.norm(means.force_body, axis=1))
    assert force == pytest.approx(one.site.gravity, abs=0.2)
    size = np.median(np.linalg.norm(means.field_body, axis=1))
    assert size == pytest.approx(np.linalg.norm(earth), rel=0.01)
    dip = np.arccos(earth[2] / np.linalg.norm(earth))
    assert np.median(means.angle) == pytest.approx(dip, abs=0.03)


def test_means_are_rotated_to_the_poses_by_the_gyroscope() -> None:
    """In a turn of 400 deg/s a pose 0.1 s away has another attitude, by 40 deg."""
    time, rate = np.arange(0.0, 12.0, 0.005), np.array([0.0, 0.0, np.deg2rad(400.0)])
    gyro, force = (np.tile(one, (len(time), 1)) for one in (rate, [0.0, 0.0, 9.81]))
    means = still_means(Log("spin", 0, "test", ImuSamples(time, gyro, force)), None)
    poses_at = np.arange(0.1, 12.0, 0.23)
    turned = Rotation.from_rotvec(poses_at[:, None] * rate).as_matrix()
    zero = np.zeros((len(poses_at), 3))
    spans, rows, world_from_body = means.near(Trajectory(poses_at, turned, zero, zero), 0.2)
    assert np.max(np.abs(poses_at[rows] - means.time[spans])) > 0.05  # s
    true = Rotation.from_rotvec(means.time[spans, None] * rate)
    off = (true.inv() * Rotation.from_matrix(world_from_body)).magnitude()
    assert np.max(off) < np.deg2rad(0.01)


@pytest.mark.parametrize("motion", ["walk", "turn"])
def test_white_noise_is_measured_in_motion(motion: str) -> None:
    one = good(motion)
    imu_declared = one.site.platform.imu
    for value, density in (
        (one.log.imu.gyro_body, imu_declared.gyro_noise),
        (one.log.imu.accel_body, imu_declared.accel_noise),
    ):
        result = white_density(one.log.imu.time, value)
        assert result is not None
        np.testing.assert_allclose(result, density, rtol=0.25)  # the quietest blocks are below it


@pytest.mark.parametrize("name", ["gyro_noise", "accel_noise"])
def test_a_density_declared_ten_times_too_small_is_said(name: str) -> None:
    one = good("turn")
    assert not list(noisy_inertial(one.log, one.site))
    declared = one.site.platform.imu
    wrong = replace(declared, **{name: getattr(declared, name) / 10.0})
    site = replace(one.site, platform=replace(one.site.platform, imu=wrong))
    (result,) = noisy_inertial(one.log, site)
    assert result.code == "imu_noise"
    assert name in result.text


@pytest.mark.parametrize("motion", ["walk", "turn"])
def test_the_vertical_of_the_estimate_tells_whose_sign_is_reversed(motion: str) -> None:
    wrong = {
        "earth_field": _earth(good(motion)),
        "gravity_sign": imu(accel=lambda f: -f)(good(motion)),
    }
    for code, one in wrong.items():
        result = recorded(one.log, one.site, estimated=one.log.truth)
        assert {finding.code for finding in result} == {code}


def test_mains_are_known_where_sampling_folds_them_back() -> None:
    assert aliased(150.0, 250.0) == pytest.approx(100.0)
    assert mains_of(49.9, 250.0) == (50.0, 1)
    assert mains_of(60.05, 250.0) == (60.0, 1)
    assert mains_of(37.0, 250.0) is None


def test_mains_are_named_and_no_doubt() -> None:
    one = with_line(50.02, 3e-8)(good())
    trust = quick_check(one.log, one.site).trust
    assert trust.verdict is Verdict.TRUSTWORTHY
    assert "mains of 50 Hz" in trust.remarks[0].text


def test_one_axis_in_g_is_named_where_the_body_stays_level() -> None:
    force_body = np.tile([0.3, -0.2, 1.0], (5, 1)) + 0.02 * np.arange(5)[:, None]
    still = np.broadcast_to(np.eye(3), (5, 3, 3))
    means = StillMeans(
        np.arange(5.0), force_body, np.full((5, 3), np.nan), still, lambda _time: np.eye(4)[[3]]
    )
    (finding,) = wrong_force(means, None)
    assert finding.code == "accel_units"
    assert "its z is in g." in finding.text


def test_a_range_that_is_switched_is_named_with_its_instant() -> None:
    one = good()
    wave = one.log.waveform
    assert wave is not None
    at = float(np.mean(wave.time[[0, -1]]))
    doubled = wave.measured_sensor * np.where(wave.time < at, 1.0, 2.0)[:, None]
    log = replace(one.log, waveform=replace(wave, measured_sensor=doubled))
    assert not list(range_step(one.log, one.site))
    (finding,) = range_step(log, one.site)
    assert "a factor of 2 at" in finding.text
    assert abs(float(finding.text.split(" s: ")[0].split()[-1]) - at) < 0.3  # s
