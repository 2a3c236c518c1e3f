"""Windows that are demodulated one by one: keeping designs of even samples changes nothing."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from magfusion.model.samples import ImuSamples, Waveform
from magfusion.model.site import Site
from magfusion.receiver import design
from magfusion.receiver.design import Designs, Maps
from magfusion.receiver.even_samples import RATE_TOLERANCES, spacings_of
from magfusion.receiver.lockin import WindowOperator, window_operator
from magfusion.receiver.lockin_receiver import LockinReceiver
from magfusion.receiver.turn import BodyTurn, body_turn_of, on_clock
from magfusion.receiver.windows import LockinSettings
from magfusion.simulation.demo_site import demo_site
from magfusion.simulation.field import synchronised_drives
from magfusion.simulation.motion import static_motion
from magfusion.simulation.waveform import simulate_waveform
from magfusion.units import ComplexArray

RATE_HZ = 2000.0 / 7.0  # a step of 0.2 s holds no whole number of samples
SETTINGS = LockinSettings(window=0.4, step=0.2)  # s
STILL = static_motion(np.array([3.0, 2.5, 1.0]), Rotation.from_rotvec([0.1, -0.2, 0.7]))


def recorded(jitter: float) -> tuple[Site, Waveform, ImuSamples]:
    """Return ten seconds whose stamps are told in ns, and jitter (s)."""
    site, rng = demo_site(), np.random.default_rng(3)
    wave = simulate_waveform(STILL, site, synchronised_drives(site), RATE_HZ, 10.0, rng)
    stamps = np.rint(1e9 * (wave.time + jitter * rng.standard_normal(len(wave)))) * 1e-9
    time = np.arange(0.0, 10.0, 0.005)
    turning = np.array([0.2, -0.1, 0.3]) * np.sin(time)[:, None]
    return site, replace(wave, time=stamps), ImuSamples(time, turning, np.zeros((len(time), 3)))


def one_by_one(
    receiver: LockinReceiver, site: Site, wave: Waveform, imu: ImuSamples
) -> tuple[list[WindowOperator], list[WindowOperator]]:
    """Return the operators of all windows as they are kept, and as each is made by itself."""
    windows = receiver.whole(wave, imu)[0]
    known = on_clock(imu, site.platform.imu.time_offset)
    rotated, own, alone = body_turn_of(known), [], []
    for k in range(len(windows)):
        window = windows.rows(slice(k, k + 1))
        first, count = int(window.first[0]), int(window.count[0])
        samples = wave.rows(slice(first, first + count))
        here = replace(window, first=np.zeros(1, dtype=np.int64))
        turn = BodyTurn(rotated(samples.time), rotated(here.centre))
        own.append(receiver.operator_of_one(samples, known, here, site, turn))
        alone.append(window_operator(samples, known, site, SETTINGS, here))
    return own, alone


def phasors(operator: WindowOperator, wave: Waveform) -> ComplexArray:
    first = int(np.searchsorted(wave.time, operator.designs.time[0]))
    rows = slice(first, first + len(operator.designs.time))
    return operator.demodulate(wave.measured_sensor[rows])[0].phasor_sensor


def furthest(kept: list[WindowOperator], alone: list[WindowOperator], wave: Waveform) -> float:
    """Return by how much phasors differ, as a share of the largest."""
    result = np.array([[phasors(o, wave) for o in pair] for pair in zip(kept, alone, strict=True)])
    return float(np.max(np.abs(result[:, 0] - result[:, 1])) / np.max(np.abs(result)))


def test_even_samples_share_a_few_designs_and_phasors_are_the_same() -> None:
    site, wave, imu = recorded(jitter=0.0)
    receiver = LockinReceiver(site, SETTINGS)
    kept, alone = one_by_one(receiver, site, wave, imu)
    assert len(kept) > 40
    assert furthest(kept, alone, wave) < RATE_TOLERANCES[1]
    assert len(receiver._even) <= 14  # seven spacings, and what rounding makes of them


def test_what_was_asked_before_does_not_matter() -> None:
    site, wave, imu = recorded(jitter=0.0)
    kept, _ = one_by_one(LockinReceiver(site, SETTINGS), site, wave, imu)
    again, _ = one_by_one(LockinReceiver(site, SETTINGS), site, wave, imu)
    last = again[-1].designs
    fresh = replace(again[-1], designs=replace(last, even={}, kept={}, requested=set()))
    assert np.array_equal(phasors(kept[-1], wave), phasors(fresh, wave))


def test_uneven_samples_have_designs_of_their_own() -> None:
    site, wave, imu = recorded(jitter=2e-6)  # s
    receiver = LockinReceiver(site, SETTINGS)
    kept, alone = one_by_one(receiver, site, wave, imu)
    assert furthest(kept, alone, wave) < 1e-12
    assert not receiver._even


@pytest.mark.parametrize("shared_by", RATE_TOLERANCES)
@pytest.mark.parametrize("error", [0.9, 2000.0])
def test_times_are_even_within_a_phase(shared_by: float, error: float) -> None:
    fastest_hz, count = 40.0, np.array([81, 80])
    time = np.stack([np.linspace(-0.2, 0.2, 81), np.linspace(-0.1, 0.3, 81)])
    time[1, -1] = 0.0  # no sample of it
    exact, other = spacings_of(time, count, fastest_hz)
    time[1, 40] += error * shared_by / (2.0 * np.pi * fastest_hz)
    same, moved = spacings_of(time, count, fastest_hz)
    assert same == exact
    if shared_by * error > RATE_TOLERANCES[1]:
        assert moved is None
        return
    assert moved is not None
    assert (moved.step == exact.step) == (shared_by * error < RATE_TOLERANCES[0])
    assert moved != other or moved.step == exact.step
    off = np.max(np.abs(moved.times() - time[1, :80]))
    assert (
        2.0 * np.pi * fastest_hz * off
        <= (1.0 + 1e-9) * RATE_TOLERANCES[0 if shared_by * error < 1e-9 else 1]
    )


def test_windows_of_even_samples_share_their_designs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Their phasors and noise are those of designs that each of them has for itself."""
    site, wave, imu = recorded(0.0)
    missing = np.arange(len(wave)) != 1500  # a window with a gap is not even
    wave = replace(wave, time=wave.time[missing], measured_sensor=wave.measured_sensor[missing])
    result = LockinReceiver(site, SETTINGS).whole(wave, imu)[1]
    built = 0
    own = Designs._build

    def counted(self: Designs, *args: Any) -> Maps:
        nonlocal built
        built += len(args[0])
        return own(self, *args)

    monkeypatch.setattr(Designs, "_build", counted)
    again = LockinReceiver(site, SETTINGS).whole(wave, imu)[1]
    np.testing.assert_array_equal(again.phasor_sensor, result.phasor_sensor)
    assert 0 < built < 0.25 * len(result)
    monkeypatch.setattr(design, "spacings_of", lambda time, *_: [None] * len(time))
    alone = LockinReceiver(site, SETTINGS).whole(wave, imu)[1]
    size = np.nanmax(np.abs(alone.phasor_sensor))
    assert np.nanmax(np.abs(result.phasor_sensor - alone.phasor_sensor)) < 2e-6 * size
    cov = float(np.nanmax(alone.phasor_cov))
    np.testing.assert_allclose(result.phasor_cov, alone.phasor_cov, rtol=1e-4, atol=1e-6 * cov)
