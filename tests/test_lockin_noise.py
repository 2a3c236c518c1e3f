"""The covariance that the lock-in claims is that of its errors, neither less nor much more."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from magfusion.model.samples import FieldSamples, ImuSamples, StaticFields, Waveform
from magfusion.model.site import Site
from magfusion.receiver.admission import Windows
from magfusion.receiver.lockin import WindowOperator, window_operator
from magfusion.receiver.windows import LockinSettings
from magfusion.simulation.demo_site import demo_site
from magfusion.units import Array

RATE_HZ = 400.0
NOISE = 1e-9  # T a sample, one sigma


def one_beacon(frequency_hz: float) -> Site:
    site = demo_site(coil_radius=None)
    sensor = site.platform.magnetometer
    # The declared density is that of the samples: the noise reaches to the Nyquist frequency.
    sensor = replace(sensor, noise_density=NOISE / np.sqrt(RATE_HZ / 2.0))
    beacon = replace(site.beacons[0], frequency_hz=frequency_hz)
    return replace(site, beacons=(beacon,), platform=replace(site.platform, magnetometer=sensor))


def windows_of(count: int, length: float) -> tuple[Windows, Array]:
    """Return windows that follow each other, and the times of their samples (s)."""
    samples, number = round(RATE_HZ * length), np.arange(count)
    windows = Windows(
        number=number,
        centre=length * (number + 0.5),
        first=samples * number,
        count=np.full(count, samples),
        length=np.full(count, length),
        place=np.zeros_like(number),
    )
    return windows, (np.arange(samples * count) + 0.5) / RATE_HZ


def still_gyro(begin: float, end: float) -> ImuSamples:
    time = np.arange(begin, end, 0.005)
    return ImuSamples(time, np.zeros((len(time), 3)), np.zeros((len(time), 3)))


def operator(
    frequency_hz: float, count: int, length: float, imu: ImuSamples, averaged: int = 1
) -> WindowOperator:
    windows, time = windows_of(count, length)
    waveform = Waveform(time, np.zeros((len(time), 3)))
    settings = LockinSettings(length, length, mains_hz=0.0, noise_windows=averaged)
    return window_operator(waveform, imu, one_beacon(frequency_hz), settings, windows)


def of_white_noise(
    frequency_hz: float, count: int, length: float, averaged: int
) -> tuple[FieldSamples, StaticFields]:
    imu = still_gyro(-1.0, count * length + 1.0)
    lockin = operator(frequency_hz, count, length, imu, averaged)
    noise = np.random.default_rng(3).normal(0.0, NOISE, (len(lockin.still_from_body[0]), 3))
    return lockin.demodulate(noise)


def quadratures(fields: FieldSamples) -> Array:
    """Return real and imaginary parts of the one tone, shape (2, n, 3)."""
    phasor = fields.phasor_sensor[:, 0]
    return np.stack([phasor.real, phasor.imag])


@pytest.mark.parametrize(("frequency_hz", "length"), [(5.0, 0.25), (5.0, 0.4), (20.0, 0.4)])
def test_the_claimed_variance_is_that_of_both_quadratures(
    frequency_hz: float, length: float
) -> None:
    """In a window of few periods the sine shares its shape with a drift, the cosine does not."""
    count = 2000
    fields, static = of_white_noise(frequency_hz, count, length, averaged=50)
    result = np.mean(quadratures(fields) ** 2)
    claimed = np.mean(np.diagonal(fields.phasor_cov[:, 0], axis1=1, axis2=2))
    # 12,000 numbers: a variance is within 1.3 %, one sigma, and the claimed one within 1 %.
    assert result / claimed == pytest.approx(1.0, abs=0.06)
    result = np.mean(static.measured_sensor**2)
    claimed = np.mean(np.diagonal(static.cov, axis1=1, axis2=2))
    assert result / claimed == pytest.approx(1.0, abs=0.08)


def test_a_window_by_itself_claims_no_precision_that_its_few_numbers_made_up() -> None:
    """Four numbers beside a tone are a covariance of three axes that is often near singular."""
    fields, _ = of_white_noise(20.0, 5000, 0.4, averaged=1)
    error = quadratures(fields)
    cov = fields.phasor_cov[:, 0]
    square = np.einsum("qni,qni->qn", error, np.linalg.solve(cov, error[..., None])[..., 0])
    # Hotelling's distribution, of the claim's four degrees of freedom: 6 F(3, 2).
    assert np.median(square) == pytest.approx(6.81, rel=0.1)
    # By that distribution one in 330 is more than 45 sigma off; no instrument is that much
    # quieter than its data sheet says.
    assert np.mean(square > 2000.0) < 1e-3


def test_a_turn_that_no_gyro_saw_has_errors_of_the_claimed_spread() -> None:
    """A walking person turns by some 1 rad/s about each axis; the ramps do not follow its square.

    The rate is constant in a window, another in each.
    """
    count, length, frequency_hz = 800, 0.4, 20.0
    rng = np.random.default_rng(5)
    silent = still_gyro(-2.0, -1.0), still_gyro(count * length + 1.0, count * length + 2.0)
    imu = ImuSamples(*(np.concatenate(pair) for pair in zip(*map(parts, silent), strict=True)))
    lockin = operator(frequency_hz, count, length, imu)
    assert lockin.unseen.all()
    windows, time = windows_of(count, length)
    field = rng.normal(0.0, 1e-7, (count, 3))  # T, at the centre of each window
    own = np.repeat(np.arange(count), windows.count)
    rotated = rng.normal(0.0, 1.0, (count, 3))[own] * (time - windows.centre[own])[:, None]
    carrier = np.cos(2.0 * np.pi * frequency_hz * time)[:, None]
    samples = Rotation.from_rotvec(rotated).inv().apply(carrier * field[own])
    fields, _ = lockin.demodulate(samples)
    error = quadratures(fields) - np.stack([field, np.zeros_like(field)])
    result = np.mean(np.sum(error**2, axis=-1))
    claimed = np.mean(np.trace(fields.phasor_cov[:, 0], axis1=1, axis2=2))
    assert np.sqrt(result) > 1e-9  # T; what is claimed is no rounding
    # Half the square of a turn about each of two axes falls on the field, as claimed of all three.
    assert 0.25 < result / claimed < 0.7


def parts(imu: ImuSamples) -> tuple[Array, Array, Array]:
    return imu.time, imu.gyro_body, imu.accel_body
