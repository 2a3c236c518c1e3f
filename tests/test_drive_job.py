"""A sound file that drives a site's beacons: tones as the site has them, again and again."""

from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from magfusion.errors import InputError
from magfusion.files.site import save_site
from magfusion.jobs.drive import DriveSettings, run
from magfusion.model.drive_signal import common_period, drive_channels
from magfusion.model.site import Coil, MarkedSlots, Site, Slots
from magfusion.model.trajectory import Trajectory
from magfusion.simulation.demo_site import demo_site
from magfusion.simulation.log import simulate_fields
from magfusion.units import Array

soundfile = pytest.importorskip("soundfile")
RATE_HZ = 48_000
LEVEL = 10.0 ** (-3.0 / 20.0)
LSB = 2.0**-23


def sound_site(tones_hz: tuple[float, ...] = (1010.0, 1130.0, 1270.0, 1430.0)) -> Site:
    """Return dipoles of two coils in quadrature, of which the second is weaker."""
    site = demo_site(coil_radius=None)
    coils = (Coil(np.array([3.0, 0, 0]), 0.4), Coil(np.array([0, 2.0, 0]), 0.4 - np.pi / 2))
    beacons = [
        replace(b, coils=coils, frequency_hz=f) for b, f in zip(site.beacons, tones_hz, strict=True)
    ]
    return replace(site, beacons=tuple(beacons), model_error=0.0)


def played(site: Site, directory: Path, **options: Any) -> Array:
    """Return what the command writes for a site."""
    save_site(site, directory / "site.yaml")
    run(DriveSettings(site=directory / "site.yaml", **options), directory / "drive")
    samples, rate_hz = soundfile.read(directory / "drive" / "beacons.wav")
    assert rate_hz == options.get("rate", RATE_HZ)
    return samples


def test_the_field_of_what_is_played_is_that_of_the_site(tmp_path: Path) -> None:
    """Equal coils of 3 A m^2 at full level, with the signals of the file, have its phasors."""
    site, rng = sound_site(), np.random.default_rng(0)
    samples = played(site, tmp_path)
    assert len(samples) == 10 * RATE_HZ
    lines = np.fft.rfft(samples, axis=0) * (2.0 / len(samples) / LEVEL)
    attitude = Rotation.from_euler("xyz", [[0.3, -0.2, 1.0]]).as_matrix()
    pose = Trajectory(np.zeros(1), attitude, np.ones((1, 3)))
    true = simulate_fields(site, pose, 0.0, rng).phasor_sensor[0]
    for k, beacon in enumerate(site.beacons):
        total = np.zeros(3, dtype=np.complex128)
        for j in range(2):
            coil = Coil(3.0 * np.eye(3)[j])
            sigma = replace(beacon.sigma, log_moment=np.zeros(1))
            single = replace(site, beacons=(replace(beacon, coils=(coil,), sigma=sigma),))
            phasor = simulate_fields(single, pose, 0.0, rng).phasor_sensor[0, 0]
            total += lines[round(10 * beacon.frequency_hz), 2 * k + j] * phasor
        assert np.max(np.abs(total - true[k])) < 1e-5 * np.max(np.abs(true[k]))
    lines[[round(10 * b.frequency_hz) for b in site.beacons]] = 0.0
    assert np.max(np.abs(lines)) < 2 * LSB


def test_it_repeats_without_a_step(tmp_path: Path) -> None:
    """Where the file begins again, the samples go on as within it."""
    samples = played(sound_site((1010.5, 1130.0, 1270.25, 1430.0)), tmp_path, duration=4.0)
    assert len(samples) == 4 * RATE_HZ
    step = np.abs(np.diff(samples, n=2, axis=0))
    seam = np.abs(np.diff(np.concatenate([samples[-2:], samples[:2]]), n=2, axis=0))
    assert np.all(seam <= np.max(step, axis=0) + 2 * LSB)


def test_coils_are_driven_in_their_slots(tmp_path: Path) -> None:
    site = sound_site()
    beacon = site.beacons[0]
    coils = tuple(replace(c, slot=k) for k, c in enumerate(beacon.coils))
    beacon = replace(beacon, coils=coils, slots=Slots(0.05, 3))
    samples = played(replace(site, beacons=(beacon,)), tmp_path, sync=True)
    assert samples.shape == (9 * RATE_HZ, 3)  # of whole seconds, and of cycles of 0.15 s
    slot = RATE_HZ // 20
    power = np.mean(samples[: 3 * slot, :2].reshape(3, slot, 2) ** 2, axis=1)
    assert power == pytest.approx(
        0.5 * LEVEL**2 * np.array([[1, 0], [0, 4 / 9], [0, 0]]), rel=1e-2, abs=1e-12
    )
    rising = np.flatnonzero(np.diff(samples[:, 2]) > 0.5 * LEVEL) + 1
    assert list(rising) == [RATE_HZ * k for k in range(1, 9)]


def test_the_period_is_the_least_common_multiple() -> None:
    channels = drive_channels(sound_site((1000.0, 1200.0, 1400.0, 1600.0)), RATE_HZ, 0.5)
    assert common_period(channels, RATE_HZ, pulses=False) == Fraction(1, 200)
    assert common_period(channels, 44_100, pulses=False) == Fraction(1, 100)
    assert common_period(channels, RATE_HZ, pulses=True) == 1


@pytest.mark.parametrize(
    ("change", "options", "sentence"),
    [
        ({"frequency_hz": 5.0}, {}, "does not play a tone of 5 Hz; choose 10 Hz or more"),
        ({"frequency_hz": 23e3}, {}, "23000 Hz is above 21600 Hz, .* raise --rate, or lower"),
        ({"frequency_hz": 1010.001}, {}, "repeat together only after 1000 s; choose frequencies"),
        ({}, {"outputs": 4}, "need 8 outputs, the card has 4; drive coils in time slots"),
        ({"slots": MarkedSlots()}, {}, "follow no clock; give slots"),
    ],
)
def test_what_a_card_cannot_play_is_refused(
    tmp_path: Path, change: dict, options: dict, sentence: str
) -> None:
    site = sound_site()
    first = site.beacons[0]
    if "slots" in change:
        coils = tuple(replace(c, slot=k) for k, c in enumerate(first.coils))
        change = {**change, "coils": coils}
    site = replace(site, beacons=(replace(first, **change), *site.beacons[1:]))
    with pytest.raises(InputError, match=sentence):
        played(site, tmp_path, **options)
    assert not (tmp_path / "drive").exists()
