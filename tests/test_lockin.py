"""From waveform to phasors: values, claimed noise, spoilt stretches, refused input."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import BPoly, BSpline
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation, RotationSpline

from magfusion.errors import InputError
from magfusion.model.samples import ImuSamples, Waveform
from magfusion.receiver.lockin import window_operator
from magfusion.receiver.lockin_receiver import LockinReceiver
from magfusion.receiver.turn import on_clock
from magfusion.receiver.windows import LockinSettings, default_settings
from magfusion.simulation.demo_site import demo_site
from magfusion.simulation.field import synchronised_drives
from magfusion.simulation.log import simulate_fields
from magfusion.simulation.motion import SimulatedMotion, static_motion
from magfusion.simulation.waveform import Mains, simulate_waveform

RATE_HZ = 400.0
PLACE = np.array([3.0, 2.5, 1.0])
STILL = static_motion(PLACE, Rotation.from_rotvec([0.1, -0.2, 0.7]))
WINDOW = LockinSettings(window=0.4, step=0.2)  # s; what the demo site's tones ask for


def noiseless(lever=True, **changes):
    site = replace(demo_site(coil_radius=None), **changes)
    sensor = replace(site.platform.magnetometer, noise_density=0.0)
    sensor = sensor if lever else replace(sensor, position_body=np.zeros(3))
    return replace(site, platform=replace(site.platform, magnetometer=sensor))


def spinning(rate_body):
    """Return a body that turns at a constant rate about the IMU."""
    knots = np.arange(21.0)
    attitude = RotationSpline(knots, Rotation.from_rotvec(knots[:, None] * rate_body))
    place = BSpline(np.array([0.0, 1.0]), PLACE[None], 0)
    return SimulatedMotion(place, attitude, BPoly(np.ones((1, 1)), np.array([0.0, 20.0])))


def imu_of(motion, duration):
    time = np.arange(0.0, duration, 0.005)
    return ImuSamples(time, motion.rate_body(time), np.zeros((len(time), 3)))


def still_imu(duration):
    return imu_of(STILL, duration)


def simulated(motion, site, duration=8.0, mains=None):
    rng = np.random.default_rng(1)
    return simulate_waveform(motion, site, synchronised_drives(site), RATE_HZ, duration, rng, mains)


def choose_windows(waveform, imu, site, settings):
    return LockinReceiver(site, settings).whole(waveform, imu)[0]


def operator_of(waveform, imu, site, settings=WINDOW):
    windows = choose_windows(waveform, imu, site, settings)
    known = on_clock(imu, site.platform.imu.time_offset)
    return window_operator(waveform, known, site, settings, windows)


def received(waveform, imu, site, settings=WINDOW):
    return operator_of(waveform, imu, site, settings).demodulate(waveform.measured_sensor)[0]


def true_phasors(site, motion, time):
    rng = np.random.default_rng(1)
    return simulate_fields(site, motion.trajectory(time), 0.0, rng).phasor_sensor


def _phasors(operator, measured):
    """Return the phasors alone, as of a waveform beside another."""
    return operator.demodulate_both(measured, measured)[2]


def worst(result, expected):
    """Return the largest error of a phasor in units of its own size."""
    size = np.linalg.norm(expected, axis=-1)
    return np.max(np.linalg.norm(result - expected, axis=-1) / size)


def rms(error):
    return np.sqrt(np.mean(np.abs(error) ** 2))


def test_a_still_magnetometer_has_the_simulators_phasors_to_rounding():
    site = noiseless()
    fields = received(simulated(STILL, site), still_imu(8.0), site)
    assert fields.channels == site.channels
    assert fields.phasor_sensor.shape == (39, 4, 3)
    assert worst(fields.phasor_sensor, true_phasors(site, STILL, fields.time)) < 1e-11
    # What is left beside the tones is the rounding of the Earth's field.
    assert np.max(np.trace(fields.phasor_cov, axis1=2, axis2=3)) < (1e-17) ** 2


def test_matrix_and_offset_are_left_in_the_phasors_as_the_instrument_gave_them():
    site = noiseless()
    matrix = np.array([[1.05, 0.02, -0.03], [0.01, 0.93, 0.04], [-0.02, 0.05, 1.08]])
    sensor = replace(site.platform.magnetometer, matrix=matrix, offset=np.full(3, 3e-6))
    site = replace(site, platform=replace(site.platform, magnetometer=sensor))
    fields = received(simulated(STILL, site), still_imu(8.0), site)
    assert worst(fields.phasor_sensor, true_phasors(site, STILL, fields.time)) < 1e-11


@pytest.mark.parametrize("matrix", [np.eye(3), np.diag([1.05, 0.93, 1.1])])
def test_the_gyro_takes_a_turn_on_the_spot_out_altogether(matrix):
    site = noiseless(lever=False)
    sensor = replace(site.platform.magnetometer, matrix=matrix)
    site = replace(site, platform=replace(site.platform, magnetometer=sensor))
    motion = spinning(np.array([0.6, -0.48, 0.64]))  # 1 rad/s
    fields = received(simulated(motion, site), imu_of(motion, 8.0), site)
    assert worst(fields.phasor_sensor, true_phasors(site, motion, fields.time)) < 1e-10


def test_the_gyro_lessens_the_error_of_a_turn_by_more_than_two_orders():
    site = noiseless()
    motion = spinning(np.array([0.6, -0.48, 0.64]))  # 1 rad/s, lever arm 6 cm
    waveform, imu = simulated(motion, site), imu_of(motion, 8.0)
    fields = received(waveform, imu, site)
    blind = received(waveform, replace(imu, gyro_body=np.zeros_like(imu.gyro_body)), site)
    truth = true_phasors(site, motion, fields.time)
    with_gyro, without = (rms(f.phasor_sensor - truth) for f in (fields, blind))
    assert without > 5e-9  # T: mostly the Earth's field
    assert with_gyro < 5e-11  # T: the field's curve along the sensor's circle
    assert without / with_gyro > 200.0  # 370


def test_a_gyro_bias_that_is_told_is_taken_off():
    site = noiseless(lever=False)
    motion, bias = spinning(np.array([0.6, -0.48, 0.64])), np.array([0.02, 0.05, -0.03])
    waveform, true_imu = simulated(motion, site), imu_of(motion, 8.0)
    imu = replace(true_imu, gyro_body=true_imu.gyro_body + bias)
    windows = choose_windows(waveform, imu, site, WINDOW)
    truth = true_phasors(site, motion, windows.centre)
    errors = []
    for reported in (None, bias, np.broadcast_to(bias, imu.gyro_body.shape)):
        known = on_clock(imu, site.platform.imu.time_offset, reported)
        operator = window_operator(waveform, known, site, WINDOW, windows)
        errors.append(worst(_phasors(operator, waveform.measured_sensor), truth))
    assert errors[0] > 1e-4
    assert max(errors[1:]) < 1e-10


def test_the_imus_time_offset_shifts_the_turn():
    site = noiseless(lever=False)
    knots = np.arange(21.0)
    swing = np.stack([0.5 * np.sin(knots), np.cos(knots), 0.3 * knots], axis=1)
    turn = RotationSpline(knots, Rotation.from_rotvec(swing))
    motion = replace(spinning(np.ones(3)), attitude=turn)
    waveform, late = simulated(motion, site), 0.004
    stamp = np.arange(0.0, 8.0, 0.005)
    imu = ImuSamples(stamp, motion.rate_body(stamp + late), np.zeros((len(stamp), 3)))
    windows = choose_windows(waveform, imu, site, WINDOW)
    truth = true_phasors(site, motion, windows.centre)
    errors = [
        rms(_phasors(operator, waveform.measured_sensor) - truth)
        for operator in (
            window_operator(waveform, on_clock(imu, offset), site, WINDOW, windows)
            for offset in (0.0, late)
        )
    ]
    assert errors[1] < 0.1 * errors[0]


def test_samples_need_not_be_regular():
    site = noiseless()
    rng = np.random.default_rng(2)
    time = (np.arange(3200) + rng.uniform(-0.2, 0.2, 3200)) / RATE_HZ
    phasor = true_phasors(site, STILL, np.zeros(1))[0]
    carrier = np.exp(2j * np.pi * np.array([20.0, 25.0, 30.0, 35.0]) * time[:, None])
    measured = np.real(carrier @ phasor) + np.array([1e-6, 2e-5, -4e-5])
    fields = received(Waveform(time, measured), still_imu(8.0), site)
    assert len(fields) >= 38
    assert worst(fields.phasor_sensor, np.broadcast_to(phasor, fields.phasor_sensor.shape)) < 1e-11


def noise_only(noise):
    """Return what the receiver makes of noise alone, in windows that do not overlap."""
    site = noiseless()
    duration = len(noise) / RATE_HZ
    waveform = Waveform(np.arange(len(noise)) / RATE_HZ, noise)
    settings = LockinSettings(window=0.4, step=0.4, mains_hz=0.0)
    return received(waveform, still_imu(duration), site, settings)


def empirical_cov(fields):
    """Return the mean outer product of the quadratures of each channel, (channels, 3, 3)."""
    parts = np.stack([fields.phasor_sensor.real, fields.phasor_sensor.imag])
    return np.einsum("qnci,qncj->cij", parts, parts) / (2.0 * len(fields))


def test_the_claimed_covariance_is_that_of_white_noise():
    sigma = 1e-9 * np.array([1.0, 2.0, 5.0])
    mixing = Rotation.from_rotvec([0.5, 0.8, -0.3]).as_matrix()
    noise = np.random.default_rng(3).normal(0.0, sigma, (200_000, 3)) @ mixing.T
    fields = noise_only(noise)
    assert len(fields) == 1250
    claimed, result = np.mean(fields.phasor_cov, axis=0), empirical_cov(fields)
    for channel in range(4):
        # Of 2500 quadratures in three axes: a variance is within 2.8 % (one sigma).
        ratio = np.linalg.eigvals(np.linalg.solve(claimed[channel], result[channel])).real
        assert np.min(ratio) > 0.88
        assert np.max(ratio) < 1.12
    # Each eigenvector of the claim is an axis of the noise, the largest first.
    value, vector = np.linalg.eigh(claimed.mean(axis=0))
    np.testing.assert_allclose(value / value[0], [1.0, 4.0, 25.0], rtol=0.1)
    assert np.min(np.abs(np.sum(vector * mixing, axis=0))) > 0.99


def test_the_claimed_covariance_holds_for_windows_of_each_kind_with_mains():
    noise = np.random.default_rng(4).normal(0.0, 1e-9, (100_000, 3))
    site, waveform = noiseless(), Waveform(np.arange(100_000) / RATE_HZ, noise)
    settings = LockinSettings(window=0.6, step=0.6, mains_hz=50.0)
    fields = received(waveform, still_imu(250.0), site, settings)
    claimed = np.mean(np.trace(fields.phasor_cov, axis1=2, axis2=3), axis=0)
    result = np.trace(empirical_cov(fields), axis1=1, axis2=2)
    # 416 windows, six quadratures each: 2.8 % (one sigma), and the claim's own 2 %.
    np.testing.assert_allclose(result / claimed, np.ones(4), atol=0.14)


def test_each_window_by_itself_is_covered_by_its_own_claim():
    fields = noise_only(np.random.default_rng(5).normal(0.0, 1e-9, (200_000, 3)))
    scaled = np.concatenate([fields.phasor_sensor.real, fields.phasor_sensor.imag])
    cov = np.concatenate([fields.phasor_cov, fields.phasor_cov])
    square = np.einsum("nci,nci->nc", scaled, np.linalg.solve(cov, scaled[..., None])[..., 0])
    # A covariance of nine windows has 36 degrees of freedom: 3 * 36 / (36 - 3 - 1) on average.
    assert 3.2 < np.mean(square) < 3.55


def test_coloured_noise_is_claimed_tone_by_tone_and_axis_by_axis():
    noise = np.random.default_rng(6).normal(0.0, 1e-9, (200_000, 3))
    noise[:, 1] = lfilter([1.0], [1.0, -0.8], noise[:, 1])  # red
    noise[:, 2] *= 4.0
    fields = noise_only(noise)
    result = np.einsum("cii->ci", empirical_cov(fields))
    ratio = np.einsum("cii->ci", np.mean(fields.phasor_cov, axis=0)) / result
    assert result[0, 1] / result[3, 1] > 2.0  # 20 Hz against 35 Hz
    np.testing.assert_allclose(result[:, 2] / result[:, 0], np.full(4, 16.0), rtol=0.15)
    assert np.all(np.abs(ratio[:, [0, 2]] - 1.0) < 0.12)  # three sigma
    # Far noise leaks into the probes more than into the tones: the claim errs to the safe side.
    assert np.all((ratio[:, 1] > 0.95) & (ratio[:, 1] < 1.5))


def test_noise_that_comes_and_goes_is_claimed_where_it_is():
    noise = np.random.default_rng(7).normal(0.0, 1e-9, (64_000, 3))
    noise[32_000:] *= 10.0  # from 80 s on
    fields = noise_only(noise)
    sigma = np.sqrt(np.mean(np.trace(fields.phasor_cov, axis1=2, axis2=3), axis=1))
    before, after = sigma[fields.time < 76.0], sigma[fields.time > 84.0]
    assert 8.0 < after.mean() / before.mean() < 12.0


def drops(waveform, imu, settings=WINDOW, site=None):
    """Return the centres that are kept, those of a log without fault, and the reasons."""
    site = site or noiseless()
    full = choose_windows(ordinary(), still_imu(8.0), site, settings)
    receiver = LockinReceiver(site, settings)
    windows, _ = receiver.whole(waveform, imu)
    return windows.centre, full.centre, dict(receiver.dropped)


def holding(centre, begin, end):
    """Tell which windows hold part of an interval (s)."""
    return (centre + 0.2 > begin) & (centre - 0.2 < end)


def check_drop(kept, full, reasons, corrupted, reason):
    np.testing.assert_allclose(kept, full[~corrupted], rtol=1e-12)
    assert reasons == {reason: int(corrupted.sum())}
    assert corrupted.sum() > 2


def ordinary(duration=8.0):
    return simulated(STILL, demo_site(coil_radius=None), duration)


def test_a_log_without_fault_loses_no_window():
    kept, full, reasons = drops(ordinary(), still_imu(8.0))
    assert len(kept) == len(full) == 39
    assert reasons == {}


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_saturated_stretch_drops_the_windows_that_hold_it(axis, sign):
    waveform = ordinary()
    measured = waveform.measured_sensor.copy()
    measured[1203:1323, axis] = sign * 1e-4  # 3.0075 s to 3.305 s
    kept, full, reasons = drops(replace(waveform, measured_sensor=measured), still_imu(8.0))
    corrupted = holding(full, 3.0075, 3.3051)
    check_drop(kept, full, reasons, corrupted, "magnetometer saturated")


def test_a_sample_at_the_declared_range_drops_the_windows_that_hold_it():
    waveform = ordinary()
    measured = waveform.measured_sensor.copy()
    measured[[1203, 2003], 1] = -2e-4  # T, at 3.0075 and 5.0075 s
    platform = noiseless().platform
    sensor = replace(platform.magnetometer, field_range=2e-4)
    site = replace(noiseless(), platform=replace(platform, magnetometer=sensor))
    spiked = replace(waveform, measured_sensor=measured)
    kept, full, reasons = drops(spiked, still_imu(8.0), site=site)
    corrupted = holding(full, 3.0075, 3.0076) | holding(full, 5.0075, 5.0076)
    check_drop(kept, full, reasons, corrupted, "magnetometer saturated")


def test_held_samples_are_no_saturation():
    """A magnetometer that is read twice as fast as it measures, and one with coarse steps."""
    waveform = ordinary()
    fixed = waveform.measured_sensor.copy()
    again = np.random.default_rng(5).random(len(fixed)) < 0.4
    for k in np.flatnonzero(again[1:]) + 1:
        fixed[k] = fixed[k - 1]
    coarse = 1e-6 * np.round(waveform.measured_sensor / 1e-6)
    for measured in (fixed, coarse):
        kept, full, reasons = drops(replace(waveform, measured_sensor=measured), still_imu(8.0))
        assert reasons == {}
        assert len(kept) == len(full)


def test_noise_that_held_samples_hide_is_not_taken_for_none():
    """Quantised, held, and with hardly more samples than columns: covariances stay definite."""
    site, waveform = demo_site(), ordinary()
    settings = replace(WINDOW, window=0.1, step=0.05, noise_windows=1)
    few = replace(site, beacons=site.beacons[:1])
    measured = 1e-6 * np.round(waveform.measured_sensor[::4] / 1e-6)
    measured[1::2] = measured[::2]
    slow = Waveform(waveform.time[::4], measured)
    fields = received(slow, still_imu(8.0), few, settings)
    least = np.linalg.eigvalsh(fields.phasor_cov)[..., 0]
    assert np.min(least) > 0.0
    with pytest.raises(InputError, match="longer window"):
        received(slow, still_imu(8.0), few, replace(settings, window=0.05))


def test_a_single_extreme_sample_is_no_saturation():
    waveform = ordinary()
    measured = waveform.measured_sensor.copy()
    measured[1203:1205] = 1e-4
    kept, full, reasons = drops(replace(waveform, measured_sensor=measured), still_imu(8.0))
    assert len(kept) == len(full)
    assert reasons == {}


@pytest.mark.parametrize(
    ("first", "after"),
    [(1600, 1840), (1610, 1833), (1600, 1700)],
    ids=["whole windows", "ragged", "most of half a window"],
)
def test_a_gap_in_the_magnetometer_drops_the_windows_that_it_leaves_too_little(first, after):
    waveform = ordinary()
    keep = np.ones(3200, dtype=bool)
    keep[first:after] = False
    cut = Waveform(waveform.time[keep], waveform.measured_sensor[keep])
    kept, full, reasons = drops(cut, still_imu(8.0))
    begin, end = full - 0.2, full + 0.2
    inside = np.clip(np.minimum(end, after / RATE_HZ) - np.maximum(begin, first / RATE_HZ), 0, 1)
    assert set(full[inside <= 0.05]) <= set(kept)  # an eighth of a window
    assert not set(kept) & set(full[inside > 0.201])
    assert set(reasons) == {"gap in the magnetometer stream"}
    assert reasons["gap in the magnetometer stream"] == len(full) - len(kept)


@pytest.mark.parametrize("share", [0.003, 0.05, 0.2])
def test_samples_that_are_lost_here_and_there_cost_what_they_would_have_told(share):
    rng = np.random.default_rng(4)
    waveform = ordinary()
    keep = rng.random(len(waveform)) > share
    keep[[0, -1]] = True
    cut = Waveform(waveform.time[keep], waveform.measured_sensor[keep])
    kept, full, reasons = drops(cut, still_imu(8.0))
    np.testing.assert_allclose(kept, full, rtol=1e-12)
    assert reasons == {}
    samples = received(cut, still_imu(8.0), noiseless())
    whole = received(waveform, still_imu(8.0), noiseless())
    sigma = np.sqrt(np.einsum("ncii->nci", samples.phasor_cov))
    off = np.abs(samples.phasor_sensor - whole.phasor_sensor) / sigma
    assert np.max(off) < 6.0


def test_a_stretch_of_slow_samples_is_too_few():
    waveform = ordinary()
    time = np.concatenate(
        [np.arange(1600) / RATE_HZ, 4.0 + np.arange(160) * 2.5 / RATE_HZ]
    )  # the last second
    cut = Waveform(time, waveform.measured_sensor[: len(time)])
    kept, _, reasons = drops(cut, still_imu(8.0))
    assert set(reasons) <= {"too few samples", "gap in the magnetometer stream"}
    assert kept.max() < 4.2


def test_a_gap_in_the_imu_drops_the_windows_that_reach_into_it():
    imu = still_imu(8.0)
    keep = (imu.time <= 3.0) | (imu.time >= 3.5)
    cut = ImuSamples(imu.time[keep], imu.gyro_body[keep], imu.accel_body[keep])
    kept, full, reasons = drops(ordinary(), cut)
    corrupted = holding(full, 3.0, 3.5)
    check_drop(kept, full, reasons, corrupted, "gap in the inertial stream")


def test_windows_beyond_the_imu_are_dropped():
    imu = still_imu(8.0)
    keep = (imu.time >= 1.0) & (imu.time <= 6.0)
    cut = ImuSamples(imu.time[keep], imu.gyro_body[keep], imu.accel_body[keep])
    kept, full, reasons = drops(ordinary(), cut)
    margin = 2.0 * 0.005 + 3.0 * 0.01  # two samples, three sigmas of the time offset (s)
    before, after = full - 0.2 < 1.0 - margin, full + 0.2 > 6.0 + margin
    np.testing.assert_allclose(kept, full[~before & ~after], rtol=1e-12)
    assert reasons == {
        "no inertial data": before.sum(),
        "gap in the inertial stream": after.sum(),
    }


def test_each_spoilt_window_is_counted_once():
    waveform, imu = ordinary(), still_imu(8.0)
    measured = waveform.measured_sensor.copy()
    measured[1600:1700] = 1e-4
    keep = np.ones(3200, dtype=bool)
    keep[1620:1640] = False
    awake = (imu.time < 4.0) | (imu.time > 4.1)
    cut = ImuSamples(imu.time[awake], imu.gyro_body[awake], imu.accel_body[awake])
    kept, full, reasons = drops(Waveform(waveform.time[keep], measured[keep]), cut)
    assert len(full) - len(kept) == sum(reasons.values())


def test_what_a_spoilt_log_keeps_is_as_good_as_ever():
    site = noiseless()
    waveform = simulated(STILL, site)
    keep = np.ones(3200, dtype=bool)
    keep[1607:1643] = False
    cut = Waveform(waveform.time[keep], waveform.measured_sensor[keep])
    fields = received(cut, still_imu(8.0), site)
    assert worst(fields.phasor_sensor, true_phasors(site, STILL, fields.time)) < 1e-11


def with_frequencies(*frequencies_hz):
    site = demo_site()
    beacons = tuple(
        replace(b, frequency_hz=f) for b, f in zip(site.beacons, frequencies_hz, strict=False)
    )
    return replace(site, beacons=beacons)


@pytest.mark.parametrize(
    ("frequencies_hz", "mains_hz", "window"),
    [
        ((20.0, 25.0, 30.0, 35.0), 50.0, 0.4),
        ((20.0, 21.0, 30.0, 35.0), 50.0, 2.0),
        ((80.0, 90.0, 110.0, 120.0), 50.0, 0.2),  # 10 Hz from the mains
        ((80.0, 90.0, 98.0, 120.0), 50.0, 1.0),  # 2 Hz from the second harmonic
        ((80.0, 90.0, 98.0, 120.0), 0.0, 0.25),
        ((5.0, 25.0, 45.0, 65.0), 0.0, 0.4),  # 5 Hz from the Earth's field
        ((20.0, 20.5, 30.0, 35.0), 50.0, 4.0),  # no longer than this
    ],
)
def test_the_window_is_two_periods_of_the_closest_lines(frequencies_hz, mains_hz, window):
    settings = default_settings(with_frequencies(*frequencies_hz), mains_hz)
    assert settings.window == pytest.approx(window)
    assert settings.step == pytest.approx(window / 2.0)
    assert settings.mains_hz == mains_hz


def is_one_sentence(message):
    return "\n" not in message and ". " not in message and len(message) < 300


def test_beacons_at_one_frequency_are_refused_by_name():
    with pytest.raises(InputError, match=r"beacons B and D both transmit at 25 Hz") as caught:
        default_settings(with_frequencies(20.0, 25.0, 30.0, 25.05))
    assert is_one_sentence(str(caught.value))


def test_time_slots_are_refused():
    site = demo_site()
    coils = tuple(replace(c, slot=i) for i, c in enumerate(site.beacons[1].coils))
    slotted = replace(site, beacons=(site.beacons[0], replace(site.beacons[1], coils=coils)))
    with pytest.raises(InputError, match="beacon B is driven in time slots") as caught:
        default_settings(slotted)
    assert is_one_sentence(str(caught.value))


def test_too_slow_a_magnetometer_is_refused():
    time = np.arange(560) / 70.0
    waveform = Waveform(time, np.zeros((560, 3)))
    with pytest.raises(
        InputError, match="sampled at 70 Hz, too slow for the tone at 35 Hz"
    ) as caught:
        choose_windows(waveform, still_imu(8.0), demo_site(), WINDOW)
    assert is_one_sentence(str(caught.value))


@pytest.mark.parametrize("count", [0, 1, 2, 100])
def test_too_short_a_log_is_refused(count):
    waveform = Waveform(np.arange(count) / RATE_HZ, np.zeros((count, 3)))
    with pytest.raises(InputError, match="magnetometer") as caught:
        choose_windows(waveform, still_imu(8.0), demo_site(), WINDOW)
    assert is_one_sentence(str(caught.value))


@pytest.mark.parametrize("count", [0, 1])
def test_an_imu_that_hardly_spoke_is_refused(count):
    imu = ImuSamples(np.arange(count) / 200.0, np.zeros((count, 3)), np.zeros((count, 3)))
    with pytest.raises(InputError, match="imu") as caught:
        choose_windows(ordinary(), imu, demo_site(), WINDOW)
    assert is_one_sentence(str(caught.value))


def test_a_log_that_is_spoilt_throughout_is_refused_with_the_reasons():
    waveform = ordinary()
    still = replace(waveform, measured_sensor=np.zeros_like(waveform.measured_sensor))
    with pytest.raises(InputError, match="magnetometer stands still: 39") as caught:
        choose_windows(still, still_imu(8.0), demo_site(), WINDOW)
    assert is_one_sentence(str(caught.value))


def test_minutes_that_are_simulated_one_by_one_are_those_of_the_whole() -> None:
    site, motion = noiseless(), spinning(np.array([0.6, -0.48, 0.64]))
    rng, drives = np.random.default_rng(1), synchronised_drives(site)
    whole, later = (
        simulate_waveform(motion, site, drives, 100.0, duration, rng, begin=begin)
        for duration, begin in ((8.0, 0.0), (4.0, 4.0))
    )
    np.testing.assert_allclose(later.time, whole.time[400:], rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(
        later.measured_sensor, whole.measured_sensor[400:], rtol=0.0, atol=1e-18
    )


def test_the_operator_is_linear_and_what_demodulate_applies():
    site, motion = noiseless(), spinning(np.array([0.6, -0.48, 0.64]))
    waveform = simulated(motion, site)
    operator = operator_of(waveform, imu_of(motion, 8.0), site)
    x = waveform.measured_sensor
    y = np.random.default_rng(8).normal(0.0, 1e-7, x.shape)
    mixed = _phasors(operator, 2.0 * x - 3.0 * y)
    assert worst(mixed, 2.0 * _phasors(operator, x) - 3.0 * _phasors(operator, y)) < 1e-10
    assert worst(operator.demodulate(y)[0].phasor_sensor, _phasors(operator, y)) < 1e-12
    assert not np.any(_phasors(operator, np.zeros_like(x)))


@pytest.mark.parametrize(("frequency_hz", "share"), [(50.0, 1e-10), (49.98, 2e-3)])
def test_hum_is_rejected_though_the_mains_be_a_little_off(frequency_hz, share):
    site, hum = noiseless(), 1e-6  # T
    waveform = simulated(STILL, site, mains=Mains(hum, frequency_hz))
    truth = true_phasors(site, STILL, received(waveform, still_imu(8.0), site).time)
    fitted = received(waveform, still_imu(8.0), site).phasor_sensor - truth
    ignored = replace(WINDOW, mains_hz=0.0)
    blind = received(waveform, still_imu(8.0), site, ignored).phasor_sensor - truth
    assert np.max(np.abs(fitted)) < share * hum
    assert np.max(np.abs(blind)) > 10.0 * share * hum


@pytest.mark.parametrize("kept", [(0, 1, 2), (0, 1)])
def test_lines_that_periodic_losses_alias_are_left_out_of_the_design(kept):
    """Three samples in 10 ms do not separate 50 and 150 Hz, two not even 100 Hz and a constant."""
    site, rows = noiseless(), np.isin(np.arange(3200) % 4, kept)
    waveform = simulated(STILL, site, mains=Mains(1e-7 * (kept != (0, 1)), 50.0))
    cut = Waveform(waveform.time[rows], waveform.measured_sensor[rows])
    operator = operator_of(cut, still_imu(8.0), site)
    fields = operator.demodulate(cut.measured_sensor)[0]
    assert len(fields.time) == 38  # the last one is not filled
    truth = true_phasors(site, STILL, fields.time)
    assert worst(fields.phasor_sensor, truth) < 1e-3
    assert np.max(operator.unexplained(cut.measured_sensor)) < 1e-15  # T^2, of 150 Hz
