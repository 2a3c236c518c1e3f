"""Samples that a sound card lost are found by the phases of the tones, and times corrected."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from test_recordings import FULL_SCALE, MAPS, RATE_HZ, TONES_HZ, sound_site
from test_sound_server import error_of, exact_site, navigated

from magfusion.estimation.batch.settings import SmootherSettings
from magfusion.files.audio import describe_recording
from magfusion.files.inertial_tables import write_imu
from magfusion.files.site import save_site
from magfusion.files.trajectory_table import write_trajectory
from magfusion.jobs.import_log import ImportSettings, run_import
from magfusion.jobs.inputs import Job
from magfusion.jobs.listen_sound import WARM_UP, SoundSource
from magfusion.jobs.smooth import run_smooth
from magfusion.model.bandpass import BandFilter
from magfusion.model.response import NOMINAL_T_PER_V
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.model.slip_sampler import SlipSampler
from magfusion.results.figures import Figures
from magfusion.simulation.demo_site import DEMO_BOX_WORLD
from magfusion.simulation.log import SimulationConfig, simulate_log
from magfusion.units import Array

soundfile = pytest.importorskip("soundfile")

DURATION = 22.0  # s
MAX_ERROR = 2e-3  # m
TOLERANCE = 2  # samples
FAST = 5e-5  # of a card's clock
MAX_FAST_ERROR = 4e-4  # m
MAX_NEES = 15.0  # of six numbers


def moving_tones(rng: np.random.Generator, duration: float) -> Array:
    """Return four tones whose vectors turn as a walk turns them, with noise."""
    time = np.arange(round(duration * RATE_HZ)) / RATE_HZ
    result = rng.normal(0.0, 1e-5, (len(time), 3))
    for hz in TONES_HZ:
        rate, phase = rng.normal(0.0, 2.0, 3), rng.uniform(0.0, 6.0, (2, 3))
        vector = np.cos(rate * time[:, None] + phase[0]) * np.exp(1j * phase[1])
        result += np.real(vector * np.exp(2j * np.pi * hz * time)[:, None])
    return result


def without(samples: Array, slips: list[tuple[int, int]]) -> Array:
    """Leave out samples: where, as counted in all, and how many."""
    kept = np.ones(len(samples), dtype=bool)
    for place, lost in slips:
        kept[place : place + lost] = False
    return samples[kept]


def sampler_of(samples: Array) -> SlipSampler:
    """Return the sampler of a whole recording, of blocks of 0.1 s."""
    band = BandFilter.of_site(sound_site(), RATE_HZ)
    assert band is not None
    sampler = SlipSampler(band, sound_site())
    for k in range(0, len(samples), RATE_HZ // 10):
        sampler.push(samples[k : k + RATE_HZ // 10])
    sampler.finish()
    return sampler


@pytest.mark.parametrize("lost", [137, 4000])
def test_a_slip_is_found_to_the_sample(lost: int) -> None:
    whole = moving_tones(np.random.default_rng(lost), 1.2)
    sampler = sampler_of(without(whole, [(28_210, lost)]))
    assert [slip.missing for slip in sampler.slips] == [lost]
    assert sampler.slips[0].place == pytest.approx(28_210, abs=TOLERANCE)
    assert sampler.unexplained == 0


def test_a_beacon_that_is_switched_is_no_slip() -> None:
    rng = np.random.default_rng(1)
    whole = moving_tones(rng, 1.2)
    extra = np.cos(2 * np.pi * TONES_HZ[1] * np.arange(len(whole)) / RATE_HZ)
    whole[RATE_HZ // 2 :] += extra[RATE_HZ // 2 :, None]
    assert sampler_of(whole).slips == []


def test_pulses_decide_among_the_lengths(tmp_path: Path) -> None:
    """Of a receiver at rest, tones alone leave 100 ms open: they are multiples of 10 Hz."""
    time = np.arange(4 * RATE_HZ) / RATE_HZ
    tones = sum(np.cos(2 * np.pi * hz * time) for hz in TONES_HZ) / 8.0
    columns = np.c_[tones, tones, -tones, 0.5 * (time % 1.0 < 0.1)]
    kept = without(columns, [(70_000, 5_000)])
    soundfile.write(tmp_path / "a.wav", kept, RATE_HZ, subtype="PCM_24")
    (slip,) = sampler_of(kept[: 2 * RATE_HZ, :3]).slips
    assert {slip.missing, *slip.others} >= {200, 5_000}
    entry, _ = describe_recording(tmp_path / "a.wav", "x,y,z,sync", 1.0, 0, sound_site())
    assert entry.slips == [[pytest.approx(70_000, abs=TOLERANCE), 5_000]]
    assert entry.rate_hz == pytest.approx(RATE_HZ, abs=0.1)


@pytest.fixture(scope="module")
def walk() -> Log:
    config = SimulationConfig(
        DEMO_BOX_WORLD, duration=DURATION, magnetometer_rate_hz=RATE_HZ, perturb=False
    )
    return simulate_log(exact_site(), config, np.random.default_rng(7)).log


@pytest.fixture(scope="module")
def slips() -> list[tuple[int, int]]:
    """Return four slips of a walk: where, as counted in all samples, and their lengths."""
    rng = np.random.default_rng(8)
    places = (rng.uniform(0.0, 0.6, 4) + np.arange(5.0, 18.0, 4.0)) * RATE_HZ
    return [(int(at), int(rng.integers(2000, 6001))) for at in places]


def volts(walk: Log, slips: list[tuple[int, int]]) -> Array:
    """Return what the card recorded (full scale 1)."""
    assert walk.waveform is not None
    return without(walk.waveform.measured_sensor / (NOMINAL_T_PER_V * FULL_SCALE), slips)


def check_slips(found: list[tuple[int, int]], slips: list[tuple[int, int]]) -> None:
    before = np.cumsum([0, *(lost for _, lost in slips)])[:-1]
    expected = np.array(slips) - np.c_[before, 0 * before]
    assert np.array(found) == pytest.approx(expected, abs=TOLERANCE)


def smoothed(walk: Log, recorded: Array, site: Site, tmp_path: Path) -> tuple[Figures, Figures]:
    """Import a recording and smooth it; return the figures of both."""
    assert walk.truth is not None
    soundfile.write(tmp_path / "walk.flac", recorded, RATE_HZ, subtype="PCM_24")
    write_imu(walk.imu, tmp_path / "imu.parquet", 0)
    write_trajectory(walk.truth, tmp_path / "truth.parquet", 0)
    save_site(site, tmp_path / "site.yaml")
    settings = ImportSettings(
        sources=(str(tmp_path / "walk.flac"),),
        imu=tmp_path / "imu.parquet",
        truth=tmp_path / "truth.parquet",
        map=MAPS,
        channels="x,y,z",
        full_scale=FULL_SCALE,
        epoch="0",
        site=tmp_path / "site.yaml",
    )
    imported = run_import(settings, tmp_path / "log")
    job = Job(tmp_path / "log", tmp_path / "site.yaml", tmp_path / "run")
    return imported, run_smooth(job, SmootherSettings())


@pytest.mark.slow
def test_a_recording_with_slips_is_smoothed(
    walk: Log, slips: list[tuple[int, int]], tmp_path: Path
) -> None:
    imported, figures = smoothed(walk, volts(walk, slips), exact_site(), tmp_path)
    assert any("are lost at" in note for note in imported["notes"])
    header = yaml.safe_load((tmp_path / "log" / "log.yaml").read_text())
    check_slips(header["audio"]["slips"], slips)
    assert figures["ate_m"] < MAX_ERROR
    assert figures["verdict"] == "trustworthy"


def listened(source: SoundSource, recorded: Array) -> Iterator[dict]:
    """Yield the records of a recording that begins after `WARM_UP`."""
    block = RATE_HZ // 50
    played = np.concatenate([np.zeros((round(WARM_UP * RATE_HZ), 3)), recorded])
    for k in range(0, len(played), block):
        for record in source.records(played[k : k + block], (k + block) / RATE_HZ):
            yield json.loads(json.dumps(record, default=list))


@pytest.mark.slow
def test_a_walk_by_a_fast_card_is_navigated_as_it_is_smoothed(tmp_path: Path) -> None:
    """All is on the clock of the card, by which the drives are slow, as `listen` stamps it."""
    site = exact_site()
    config = SimulationConfig(
        DEMO_BOX_WORLD,
        duration=DURATION,
        magnetometer_rate_hz=RATE_HZ * (1.0 + FAST),
        perturb=False,
    )
    log = simulate_log(site, config, np.random.default_rng(9)).log
    assert log.truth is not None
    imu, truth = (replace(part, time=(1.0 + FAST) * part.time) for part in (log.imu, log.truth))
    log = replace(log, imu=imu, truth=truth)
    sensor = replace(site.platform.magnetometer, clock_rate_sigma=FAST)
    site = replace(site, platform=replace(site.platform, magnetometer=sensor))
    _, figures = smoothed(log, volts(log, []), site, tmp_path)
    source = SoundSource("card", RATE_HZ, "x,y,z", FULL_SCALE, site)
    received = list(listened(source, volts(log, [])))
    assert source.slips == []
    states = navigated(log, received, WARM_UP, tmp_path / "site.yaml")
    error = error_of(log, states, WARM_UP)
    assert error < min(MAX_FAST_ERROR, 2.0 * figures["ate_m"])
    assert figures["verdict"] == "trustworthy"
    assert figures["nees_mean"] < MAX_NEES
    assert {state["verdict"] for state in states} == {"trustworthy"}


@pytest.mark.slow
def test_slips_are_corrected_live(walk: Log, slips: list[tuple[int, int]], tmp_path: Path) -> None:
    save_site(exact_site(), tmp_path / "site.yaml")
    source = SoundSource("card", RATE_HZ, "x,y,z", FULL_SCALE, exact_site())
    remarks, received = [], []
    for record in listened(source, volts(walk, slips)):
        received.append(record)
        remarks += source.remarks()
    for sentence, slip in zip(remarks, source.slips, strict=True):  # each by itself
        assert sentence.startswith(f"card: {slip.missing} samples")
        assert f"(sample {slip.place})" in sentence
    check_slips([(s.place - round(WARM_UP * RATE_HZ), s.missing) for s in source.slips], slips)
    states = navigated(walk, received, WARM_UP, tmp_path / "site.yaml")
    assert error_of(walk, states, WARM_UP) < MAX_ERROR
    assert not any("are lost at" in sentence for sentence in source.close())
