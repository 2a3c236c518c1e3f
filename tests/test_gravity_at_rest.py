"""The vertical that an accelerometer at rest tells is as uncertain as it says."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from magfusion.estimation.demodulation.demodulation import gravity_at_rest
from magfusion.model.samples import ImuSamples
from magfusion.simulation.demo_site import demo_site

RATE_HZ, REST = 100.0, 2.0  # s


@pytest.mark.parametrize(("noise", "bias"), [(0.01, 0.0), (0.002, 0.05), (0.01, 0.015)])
def test_the_vertical_of_many_rests_is_off_by_the_claimed_sigma(noise: float, bias: float) -> None:
    """Each rest has an attitude, a bias (m/s^2) and white noise (m/s^2/sqrt(Hz)) of its own."""
    rng, count, each = np.random.default_rng(7), 500, round(RATE_HZ * REST)
    site = demo_site()
    imu = replace(site.platform.imu, accel_noise=noise, accel_bias_sigma=bias, time_offset=0.0)
    site = replace(site, platform=replace(site.platform, imu=imu))
    up = Rotation.random(count, random_state=2).inv().apply([0.0, 0.0, 1.0])
    force = np.repeat(site.gravity * up + rng.normal(0.0, bias, (count, 3)), each, axis=0)
    force += rng.normal(0.0, noise * np.sqrt(RATE_HZ), force.shape)
    time = np.arange(len(force)) / RATE_HZ
    middle = REST * (np.arange(count) + 0.5)
    result = gravity_at_rest(ImuSamples(time, np.zeros_like(force), force), site, middle)
    assert result is not None
    assert np.all(np.isfinite(result.sigma))
    across = result.up_body - np.sum(result.up_body * up, axis=1, keepdims=True) * up
    # Two axes of 500 rests: a sigma is known to 2.2 %.
    ratio = np.sqrt(np.mean(np.sum(across**2, axis=1) / result.sigma**2) / 2.0)
    assert ratio == pytest.approx(1.0, abs=0.09)
