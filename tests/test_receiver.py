"""One receiver: the same windows and reasons, whether a log is read at once or as it arrives."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import run_command
from scipy.spatial.transform import Rotation
from time_slots_and_mains import tracker

from magfusion.estimation.batch.batch import SmootherSettings
from magfusion.jobs.inputs import Job
from magfusion.jobs.smooth import run_smooth
from magfusion.model.samples import FieldSamples, ImuSamples, Waveform
from magfusion.model.site import Site, Slots
from magfusion.receiver.lockin_receiver import LockinReceiver
from magfusion.receiver.receiver import Receiver
from magfusion.receiver.receivers import received
from magfusion.receiver.slot_receiver import SlotReceiver
from magfusion.receiver.windows import LockinSettings
from magfusion.simulation.demo_site import demo_site
from magfusion.simulation.field import synchronised_drives
from magfusion.simulation.motion import static_motion
from magfusion.simulation.waveform import simulate_waveform
from magfusion.units import BoolArray

WINDOW = LockinSettings(window=0.4, step=0.2)
DURATION = 12.0  # s
Fault = Callable[[Waveform, ImuSamples], tuple[Waveform, ImuSamples]]


def _recorded(site: Site, rate_hz: float, place: tuple[float, float, float]) -> Waveform:
    motion = static_motion(np.array(place), Rotation.from_rotvec([0.1, -0.2, 0.7]))
    rng = np.random.default_rng(1)
    return simulate_waveform(motion, site, synchronised_drives(site), rate_hz, DURATION, rng)


def _imu() -> ImuSamples:
    time = np.arange(0.0, DURATION + 0.1, 0.005)
    return ImuSamples(time, np.zeros((len(time), 3)), np.tile([0.0, 0.0, 9.81], (len(time), 1)))


def _of_imu(imu: ImuSamples, kept: BoolArray) -> ImuSamples:
    return ImuSamples(imu.time[kept], imu.gyro_body[kept], imu.accel_body[kept])


def _between(waveform: Waveform, begin: float, end: float) -> BoolArray:
    return (waveform.time >= begin) & (waveform.time < end)


def _of_waveform(waveform: Waveform, kept: BoolArray) -> Waveform:
    return Waveform(waveform.time[kept], waveform.measured_sensor[kept])


def _nothing(waveform: Waveform, imu: ImuSamples) -> tuple[Waveform, ImuSamples]:
    return waveform, imu


def _missing_sample(waveform: Waveform, imu: ImuSamples) -> tuple[Waveform, ImuSamples]:
    kept = np.ones(len(waveform), dtype=bool)
    kept[[len(kept) // 3, 2 * len(kept) // 3 + 1]] = False
    return _of_waveform(waveform, kept), imu


def _gap(waveform: Waveform, imu: ImuSamples) -> tuple[Waveform, ImuSamples]:
    return _of_waveform(waveform, ~_between(waveform, 4.0, 5.5)), imu


def _slow(waveform: Waveform, imu: ImuSamples) -> tuple[Waveform, ImuSamples]:
    step = 1.25 * (waveform.time[1] - waveform.time[0])
    before, after = waveform.time < 8.0, waveform.time >= 9.0
    slow = 8.0 + step * np.arange(int(1.0 / step))
    time = np.concatenate([waveform.time[before], slow, waveform.time[after]])
    kept = np.flatnonzero(before | after)
    kept = np.insert(kept, np.sum(before), np.sum(before) + np.arange(len(slow)))
    return Waveform(time, waveform.measured_sensor[kept]), imu


def _clipped(waveform: Waveform, imu: ImuSamples) -> tuple[Waveform, ImuSamples]:
    """Clip a second of it, and later make the field larger without."""
    measured = waveform.measured_sensor.copy()
    measured[_between(waveform, 3.0, 4.0), 1] = 1e-4
    later = _between(waveform, 7.0, 7.5)
    measured[later, 1] += 2e-4
    return replace(waveform, measured_sensor=measured), imu


def _imu_gap(waveform: Waveform, imu: ImuSamples) -> tuple[Waveform, ImuSamples]:
    return waveform, _of_imu(imu, (imu.time < 4.0) | (imu.time > 4.7))


def _late_imu(waveform: Waveform, imu: ImuSamples) -> tuple[Waveform, ImuSamples]:
    return waveform, _of_imu(imu, imu.time > 1.3)


def _all(waveform: Waveform, imu: ImuSamples) -> tuple[Waveform, ImuSamples]:
    for fault in (_clipped, _imu_gap, _gap, _late_imu, _missing_sample):
        waveform, imu = fault(waveform, imu)
    return waveform, imu


def _pushed(
    receiver: Receiver, waveform: Waveform, imu: ImuSamples, piece: float
) -> list[FieldSamples]:
    """Return the phasors as they come, of pieces of so many seconds.

    As with a navigator what is too old is forgotten, but for the last sample of it, and nothing is
    judged before the inertial samples have come.
    """
    begin = waveform.time < 2.0
    receiver.begin(_of_waveform(waveform, begin), _of_imu(imu, imu.time < 2.0))
    out: list[FieldSamples] = []
    before = 0.0
    for now in np.arange(2.0, DURATION + piece, piece):
        arrived, inertial = waveform.time < now, imu.time < now + 0.1
        until = min(float(waveform.time[arrived][-1]), float(imu.time[inertial][-1]))
        if not receiver.complete(until):
            continue
        oldest, before = before - receiver.history - 1.0, until
        for kept, time in ((arrived, waveform.time), (inertial, imu.time)):
            kept[: max(int(np.searchsorted(time, oldest)) - 1, 0)] = False
        out.append(receiver.push(_of_waveform(waveform, arrived), _of_imu(imu, inertial), until))
    return out


HARMLESS = (_nothing, _missing_sample)  # the windows are still full enough
FAULTS = [_nothing, _missing_sample, _gap, _slow, _clipped, _imu_gap, _late_imu, _all]


@pytest.mark.parametrize("piece", [0.05, 1.7])
@pytest.mark.parametrize("fault", FAULTS)
def test_tones_lose_the_same_windows_for_the_same_reasons(fault: Fault, piece: float) -> None:
    site = demo_site(coil_radius=None)
    waveform, imu = fault(_recorded(site, 400.0, (3.0, 2.5, 1.0)), _imu())
    whole, dropped = received(waveform, imu, site, WINDOW)
    receiver = LockinReceiver(site, WINDOW)
    pieces = FieldSamples.joined(_pushed(receiver, waveform, imu, piece))
    np.testing.assert_array_equal(pieces.time, whole.time)
    assert receiver.dropped == dropped
    assert (sum(dropped.values()) == 0) == (fault in (*HARMLESS, _slow))
    # The turn of a still body is none, so that the samples of a window alone make its phasors.
    np.testing.assert_allclose(pieces.phasor_sensor, whole.phasor_sensor, atol=1e-18)


@pytest.mark.slow
@pytest.mark.parametrize("carrier_hz", [0.0, pytest.param(1e3, marks=pytest.mark.slow)])
@pytest.mark.parametrize("fault", FAULTS)
def test_time_slots_lose_the_same_slots_for_the_same_reasons(
    fault: Fault, carrier_hz: float
) -> None:
    site = tracker(carrier_hz, Slots(5e-3, 4), density=1e-10)
    waveform, imu = fault(_recorded(site, 4e3, (0.5, 0.1, -0.2)), _imu())
    whole, dropped = received(waveform, imu, site)
    receiver = SlotReceiver(site)
    pieces = FieldSamples.joined(_pushed(receiver, waveform, imu, 0.05))
    ended = whole.rows(whole.time < pieces.time[-1] + 1e-9)
    assert len(whole) - len(ended) <= 3  # the last cycle is not whole
    np.testing.assert_allclose(pieces.time, ended.time, rtol=0.0, atol=1e-9)
    assert receiver.dropped == dropped
    assert (sum(dropped.values()) > 0) == (
        fault not in (*HARMLESS, *((_clipped,) if carrier_hz == 0.0 else ()))
    )
    if carrier_hz == 0.0 and fault in (_clipped, _all):
        return  # a step of the ambient field: before it and after it are not the same
    error = np.abs(pieces.phasor_sensor - ended.phasor_sensor)[ended.valid]
    sigma = np.sqrt(np.einsum("ncii->nci", ended.phasor_cov)[ended.valid])
    # The whole log knows the ambient field after a slot, too; a carrier does not ask for it.
    assert np.max(error / sigma) < (1e-6 if carrier_hz else 6.0)
    assert np.sqrt(np.mean((error / sigma) ** 2)) < 1.2


@pytest.mark.slow
def test_a_job_demodulates_as_its_settings_ask(tmp_path: Path) -> None:
    requested = LockinSettings(window=0.8, step=0.8)
    run_command("simulate", "-o", tmp_path / "log", "--duration", 20)
    job = Job(tmp_path / "log", None, tmp_path / "run")
    run_smooth(job, SmootherSettings(lockin=requested))
    written = json.loads((tmp_path / "run" / "report.json").read_text())
    assert written["epochs"] == 25
