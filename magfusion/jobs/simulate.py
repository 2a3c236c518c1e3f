"""The job that simulates a log, with truth, in the usual file formats."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from magfusion.errors import InputError
from magfusion.files.audio import as_recording, write_audio
from magfusion.files.log import write_log
from magfusion.files.site import load_site, save_site
from magfusion.files.steel_file import read_steel
from magfusion.jobs.rotor_inputs import is_for_ranging
from magfusion.jobs.settings import Command, option
from magfusion.jobs.simulate_ranging import ShaftSettings, simulate_ranging
from magfusion.model.samples import Log
from magfusion.model.site import Magnetometer, Site
from magfusion.model.trust import Trust
from magfusion.results.figures import Figure, Figures, Section, heading
from magfusion.results.verdict import trust_figures
from magfusion.simulation.atmosphere import Atmosphere
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.disturbance import Ambient, FieldDrift, office_noise
from magfusion.simulation.layers import layers_option
from magfusion.simulation.log import EPOCH_NS, Reference, SimulationConfig, simulate_log
from magfusion.simulation.pipe import Steel
from magfusion.simulation.rails import laid, rails_option
from magfusion.simulation.slots import Multiplexer
from magfusion.simulation.steel import SteelStructure
from magfusion.simulation.steel_worlds import KINDS, check_clear, draw_steel, structure_of
from magfusion.simulation.waveform import usual_rate_hz
from magfusion.units import Array

MAX_BOX, MIN_BOX = 1e5, 1e-3  # m
DRIFT_TIME = 600.0  # s
RECORDING = "recording.wav"
LATE = 0.037  # s; the clock of a reference


@dataclass(frozen=True, kw_only=True)
class SimulateSettings(ShaftSettings):
    """Settings of a simulation."""

    site: Path | None = option(None, "Site file", note="default: the demo's four beacons")
    motion: Literal["walk", "turn", "static", "drive"] = option("walk", "Motion of the platform")
    duration: float = option(120.0, "Length", unit="s", least=1.0, most=1e6)
    box: str | None = option(None, "Room to move in, m: xmin,xmax,ymin,ymax,zmin,zmax")
    rate: float | None = option(
        None,
        "Magnetometer sampling rate",
        unit="Hz",
        least=10.0,
        most=1e6,
        note="default: 400, or as many as the tones and time slots of the site need",
    )
    full_scale: float | None = option(
        None,
        "Record the magnetometer as a sound card of this full scale does, 24 bit at --rate",
        unit="V",
        above=0.0,
        note="default: as numbers; magfusion[audio]",
    )
    imu_rate: float = option(200.0, "Inertial sampling rate", unit="Hz", least=10.0, most=1e4)
    perturb: bool = option(True, "Draw the true calibration from the site's sigmas")
    iron: int = option(0, "Steel spheres around the room, at least 0.5 m away", least=0, most=200)
    ambient: Literal["quiet", "day-night"] = option(
        "quiet", "White ambient noise", note="day-night: 0.2 nT/sqrt(Hz) at night, 0.4 at 14:00 UTC"
    )
    drift: float = option(
        0.0,
        "Random change of the static field within ten minutes, rms",
        unit="T",
        least=0,
        most=1e-4,
    )
    storms: float = option(
        0.0,
        "Noise common to all magnetometers, density at 1 Hz, falling with its root",
        unit="T/sqrt(Hz)",
        least=0.0,
        most=1e-6,
    )
    reference: str | None = option(
        None,
        "Position of a second magnetometer with the same ambient noise, m: x,y,z",
        note="its clock is late by 37 ms",
    )
    random_field: float = option(
        0.0,
        "Smooth random error of each beacon's field, rms relative to it",
        least=0.0,
        most=1.0,
        note="correlated over the site's model_error_correlation_m",
    )
    burst: float = option(
        0.002, "Length of a burst, for a site with marked slots", unit="s", least=1e-4, most=10
    )
    pause: float = option(
        0.002, "Maximum pause between such bursts, random", unit="s", least=0.0, most=60.0
    )
    ground: str | None = option(
        None,
        "Layers of ground under air, height:S/m from above, e.g. 0:0.01,-20:0.05",
        note="default: the site's conductivity_s_m as a full space; requires empymod",
    )
    rails: str | None = option(
        None,
        "Steel bars and tubes, radius[/wall]:x,y,z:x,y,z in m, separated by semicolons",
        note="e.g. 0.05:-5,3,0:20,3,0 for a rail, 0.1/0.008:3,4,-4:3,4,4 for a casing",
    )
    steel: str | None = option(
        None,
        "Steel of the room: a file of spheres, bars and sheets, or a kind and a seed to draw it",
        note=f"kinds: {', '.join(KINDS)}; e.g. mesh,3",
    )


def box_option(text: str | None) -> Array | None:
    """Parse ``xmin,xmax,ymin,ymax,zmin,zmax`` (m) to lower and upper corner, shape (2, 3)."""
    if text is None:
        return None
    try:
        box = np.array([float(part) for part in text.split(",")]).reshape(3, 2).T
    except ValueError:
        raise InputError(
            f"--box {text!r}: give six numbers in metres, the limits of x, y and z"
        ) from None
    if not np.all(np.isfinite(box)) or np.any(box[0] >= box[1]):
        raise InputError(f"--box {text!r}: each lower limit must be below its upper limit")
    if np.max(np.abs(box)) > MAX_BOX or np.min(box[1] - box[0]) < MIN_BOX:
        raise InputError(
            f"--box {text!r}: limits must lie within {MAX_BOX:g} m of the origin and at least"
            f" {MIN_BOX:g} m apart"
        )
    return box


def reference_option(text: str | None) -> Reference | None:
    """Parse ``x,y,z`` (m)."""
    if text is None:
        return None
    try:
        place = np.array([float(part) for part in text.split(",")]).reshape(3)
    except ValueError:
        place = np.full(3, np.nan)
    if not np.all(np.abs(place) <= MAX_BOX):
        raise InputError(
            f"--reference {text!r}: give three numbers in metres, x, y, z within {MAX_BOX:g} m"
            " of the origin"
        )
    return Reference(place, late=LATE)


def run(settings: SimulateSettings, output: Path) -> Figures:
    """Simulate a log; see `run_simulate`."""
    site = demo_site()
    if settings.site is not None:
        site = load_site(settings.site, several=True, unknown=True)
        if is_for_ranging(site):
            return _simulate_ranging(settings, site, output)
        # The simulator has no model of the estimator's, and --steel has the steel of the room.
        site = load_site(settings.site, several=True).without_steel()
    _refuse_wells(settings, site)
    box = box_option(settings.box)
    box = DEMO_BOX_WORLD if box is None else box
    reference = reference_option(settings.reference)
    if reference is not None:
        site = replace(site, reference_world=reference.position_world)
    rate_hz = settings.rate or usual_rate_hz(site, settings.burst)
    config = SimulationConfig(
        box_world=box,
        duration=settings.duration,
        motion=settings.motion,
        imu_rate_hz=settings.imu_rate,
        magnetometer_rate_hz=rate_hz,
        reference=reference,
        perturb=settings.perturb,
        iron=settings.iron,
        random_field=settings.random_field,
        multiplexer=Multiplexer(settings.burst, settings.pause),
        shafts=settings.shaft_errors(),
        ambient=Ambient(
            day_night=office_noise(EPOCH_NS) if settings.ambient == "day-night" else None,
            drift=FieldDrift(settings.drift, DRIFT_TIME) if settings.drift else None,
            layers=None if settings.ground is None else layers_option(settings.ground),
            rails=_steel(settings, box, site),
            atmosphere=Atmosphere(settings.storms, settings.seed, settings.duration, 0.5 * rate_hz)
            if settings.storms
            else None,
        ),
    )
    return run_simulate(site, config, output, settings.seed, settings.full_scale)


def _steel(
    settings: SimulateSettings, box_world: Array, site: Site
) -> Steel | SteelStructure | None:
    """Return the requested steel around a room (m, shape (2, 3)) and its beacons."""
    beacons_world = np.array([beacon.position_world for beacon in site.beacons]).reshape(-1, 3)
    if settings.steel is not None:
        if settings.rails is not None or settings.iron:
            raise InputError("--steel: includes bars and spheres; omit --rails and --iron")
        return steel_option(settings.steel, box_world, beacons_world)
    if settings.rails is None:
        return None
    return laid(rails_option(settings.rails), box_world, beacons_world)


def steel_option(text: str, box_world: Array, beacons_world: Array) -> SteelStructure:
    """Read a file of steel, or draw it by ``kind,seed``."""
    kind, comma, seed = text.rpartition(",")
    if comma and kind in KINDS and seed.isdecimal():
        return draw_steel(kind, np.random.default_rng(int(seed)), box_world, beacons_world)
    if not Path(text).is_file():
        raise InputError(
            f"--steel {text!r}: found no such file; give a file, or kind,seed with one of"
            f" {', '.join(KINDS)}, e.g. mesh,3"
        )
    structure = structure_of(read_steel(Path(text)))
    check_clear(structure, box_world, beacons_world, text)
    return structure


def _simulate_ranging(settings: SimulateSettings, site: Site, output: Path) -> Figures:
    """Simulate passes of a magnet in a well, without incompatible options."""
    usual = SimulateSettings(seed=settings.seed)
    without: tuple[str, ...] = (
        "motion",
        "box",
        "iron",
        "ambient",
        "drift",
        "storms",
        "reference",
        "steel",
        "random_field",
    )
    for name in without:
        if getattr(settings, name) != getattr(usual, name):
            raise InputError(
                f"--{name.replace('_', '-')}: is not simulated for a site with a magnet in a well"
                f" ({settings.site}); omit it, or survey the beacon (no unknown) for a moving"
                " platform"
            )
    if site.platform.further:
        raise InputError(
            f"{settings.site}: platform.magnetometers: ranging uses one sensor; describe one"
        )
    return simulate_ranging(
        site,
        settings,
        output,
        rate_hz=settings.rate,
        perturb=settings.perturb,
        layers=None if settings.ground is None else layers_option(settings.ground),
        neighbour=() if settings.rails is None else rails_option(settings.rails),
    )


def _refuse_wells(settings: SimulateSettings, site: Site) -> None:
    if settings.wells is not None:
        raise InputError(
            "--wells: requires a site whose only beacon has rotor and unknown: pose; omit it"
        )
    if any(one.casing is not None for one in site.platform.magnetometers):
        raise InputError(
            f"{settings.site}: casing: is simulated only for a sensor in a well, where the site's"
            " only beacon has rotor and unknown: pose; omit it"
        )


def run_simulate(
    site: Site, config: SimulationConfig, output: Path, seed: int, full_scale_v: float | None = None
) -> Figures:
    """Simulate a log, with truth.

    `site`: the user's declared site; written with the log as ``site.yaml``. `full_scale_v`: of the
    sound card that records the magnetometer (V); numbers are written if None.
    """
    from magfusion.jobs.result_directory import claim
    from magfusion.results.report import write_report

    claimed = claim(output, "simulate")
    rng = np.random.default_rng(seed)
    imu = site.platform.imu
    if config.time_offset is None and config.perturb:
        drawn = imu.time_offset + imu.time_offset_sigma * float(rng.standard_normal())
        config = replace(config, time_offset=drawn)
    simulated = simulate_log(site, config, rng)
    rails = None if config.ambient is None else config.ambient.rails
    figures = (
        heading("simulate", simulated.log.name)
        | trust_figures(Trust())
        | Figures(
            Figure("seed", seed),
            Figure("duration_s", config.duration, "s"),
            Figure("imu_samples", len(simulated.log.imu), label="IMU samples"),
            Figure("time_offset_s", simulated.time_offset, "s", section=Section.REPORT),
            Figure("iron_spheres", config.iron),
            Figure("rails", len(rails.pipes) if isinstance(rails, Steel) else 0),
            Figure("steel_pieces", len(rails.bodies) if isinstance(rails, SteelStructure) else 0),
            Figure("random_field", config.random_field, section=Section.REPORT),
        )
    )
    with claimed as directory:
        _write_log(simulated.log, directory, full_scale_v, site.platform.magnetometer)
        save_site(site, directory / "site.yaml")
        save_site(simulated.true_site, directory / "true_site.yaml")
        write_report(directory, figures)
    return figures


def _write_log(log: Log, directory: Path, full_scale_v: float | None, sensor: Magnetometer) -> None:
    if full_scale_v is None:
        write_log(log, directory)
        return
    if log.waveform is None or not sensor.ac_coupled:
        raise InputError(
            "--full-scale: a sound card records no static field; declare coil, or ac_coupled: true,"
            " for the site's single magnetometer"
        )
    entry, samples = as_recording(log.waveform, RECORDING, full_scale_v, log.epoch_ns)
    write_log(replace(log, waveform=None), directory, entry)
    write_audio(directory / RECORDING, samples, round(entry.rate_hz))


COMMAND = Command(
    SimulateSettings,
    run,
    output_required=True,
    example="magfusion simulate --site site.yaml --duration 60 -o log",
)
