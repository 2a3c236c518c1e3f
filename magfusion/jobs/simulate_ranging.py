"""Simulation of a rotating magnet in one well, to be ranged from another."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from magfusion.errors import InputError
from magfusion.files.log import write_log
from magfusion.files.site import save_site
from magfusion.files.wells_file import WellsEntry, read_wells
from magfusion.jobs.settings import RandomSettings, option
from magfusion.model.platform_motion import NO_IMU
from magfusion.model.samples import ImuSamples
from magfusion.model.site import Site
from magfusion.model.trust import Trust
from magfusion.results.figures import Figure, Figures, heading
from magfusion.results.verdict import trust_figures
from magfusion.simulation.layers import Layers
from magfusion.simulation.perturbed import perturb_site, with_earth_field
from magfusion.simulation.pipe import Pipe, Steel
from magfusion.simulation.rails import steel_along_wells
from magfusion.simulation.rotor import Pass, Surroundings, simulate_transits
from magfusion.simulation.shaft import ShaftErrors, draw_shaft
from magfusion.simulation.waveform import MIN_SAMPLES_PER_CYCLE
from magfusion.simulation.wells import TwoWells, drawn_steel, lean_of
from magfusion.units import DEGREE

if TYPE_CHECKING:
    import numpy as np


MIN_RATE_HZ, SAMPLES_PER_TURN = 50.0, 10.0
WAY_POINTS = 500  # of a magnet's way, where steel is too near to it
MIN_SHARE, MAX_SEGMENT = 0.05, 0.5  # of a segment of steel: of the distance, and in m
AHEAD = 2.0  # m, at most, of the magnet from where it is abreast, in the middle of its depths


@dataclass(frozen=True, kw_only=True)
class ShaftSettings(RandomSettings):
    """Rotation of magnets on shafts, and two wells."""

    wells: Path | None = option(
        None,
        "File of two wells, for a rotor whose pose is unknown",
        note="default: 25 m apart, the magnet passes two places of the sensor",
    )
    shaft_drift: float | None = option(
        None,
        "Drift of a rotor's speed, rms, at the rate of its speed_walk_hz_rts",
        unit="Hz",
        least=0.0,
        most=10.0,
        note="default: its speed_sigma_hz",
    )
    shaft_whirl: float = option(
        0.0, "Lean of a rotor's shaft in backward whirl", unit="deg", least=0.0, most=30.0
    )
    encoder: bool = option(True, "Record the angles of rotors")
    encoder_sigma: float = option(
        0.1, "Sigma of a recorded angle", unit="deg", least=0.0, most=30.0
    )

    def shaft_errors(self) -> ShaftErrors:
        """Return the errors of shafts."""
        return ShaftErrors(
            self.shaft_drift, self.shaft_whirl * DEGREE, self.encoder, self.encoder_sigma * DEGREE
        )


def laid_wells(entry: WellsEntry, rng: np.random.Generator) -> TwoWells:
    """Return the wells of a file; the magnet's angle on its shaft is drawn."""
    return TwoWells(
        distance=entry.distance_m,
        direction=entry.high_side_deg * DEGREE,
        dip=(90.0 - entry.inclination_deg) * DEGREE,
        lean=lean_of(entry.leads_right_deg * DEGREE, entry.leads_up_deg * DEGREE),
        turn=float(rng.uniform(-np.pi, np.pi)),
        ahead=float(rng.uniform(-AHEAD, AHEAD)),
        well_distance=entry.apart_m,
        reach=entry.reach_m,
        speed=entry.speed_m_s,
        depth=entry.depth_m,
    )


def simulate_ranging(
    site: Site,
    settings: ShaftSettings,
    output: Path,
    *,
    rate_hz: float | None = None,
    perturb: bool = True,
    layers: Layers | None = None,
    neighbour: tuple[Pipe, ...] = (),
) -> Figures:
    """Simulate the record of a sensor in a well during passes of a magnet in another.

    `site`: as `is_for_ranging`. `rate_hz`: of the magnetometer. `neighbour`: steel near the wells.
    """
    from magfusion.jobs.result_directory import claim
    from magfusion.results.report import write_report

    entry, claimed = read_wells(settings.wells), claim(output, "simulate")
    rng = np.random.default_rng(settings.seed)
    declared = with_earth_field(site)
    true_site = perturb_site(declared, rng) if perturb else declared
    rotor = true_site.beacons[0].rotor
    assert rotor is not None
    highest = max((1, *(one.order for one in rotor.harmonics)))
    fastest_hz = highest * site.beacons[0].frequency_hz
    rate_hz = rate_hz or max(MIN_RATE_HZ, SAMPLES_PER_TURN * fastest_hz)
    if rate_hz < MIN_SAMPLES_PER_CYCLE * fastest_hz:
        raise InputError(
            f"--rate {rate_hz:g}: the rotor's fastest tone has {fastest_hz:g} Hz; give at least"
            f" {MIN_SAMPLES_PER_CYCLE * fastest_hz:g} Hz"
        )
    shaft, wells = draw_shaft(rotor, settings.shaft_errors(), rng), laid_wells(entry, rng)
    sensor = true_site.platform.magnetometer
    rolls = rng.uniform(-np.pi, np.pi, 2)
    max_iterations = wells.transits_of(rolls, sensor.position_body, rotor.axis_beacon)
    neighbour = _laid(neighbour, max_iterations, wells)
    around = _around(true_site, wells, entry, layers, neighbour, rng, perturb=perturb)
    log = simulate_transits(
        true_site, shaft, max_iterations, around, rate_hz, rng, encoder=settings.encoder
    )
    if site.platform.imu == NO_IMU:
        log = replace(log, imu=ImuSamples.empty(), inertial=False)
    figures = heading("simulate", log.name) | trust_figures(Trust())
    figures |= _figures(settings, wells, max_iterations, 1.0 + around.depth_scale)
    with claimed as directory:
        write_log(log, directory)
        save_site(site, directory / "site.yaml")
        save_site(true_site, directory / "true_site.yaml")
        write_report(directory, figures)
    return figures


def _laid(
    neighbour: tuple[Pipe, ...], transits: tuple[Pass, ...], wells: TwoWells
) -> tuple[Pipe, ...]:
    """Return steel in segments that are short relative to the distance of sensor and magnet."""
    ways_world = [np.stack([one.sensor_world for one in transits])]
    for one in transits:
        way = np.linspace(0.0, one.depth[1] - one.depth[0], WAY_POINTS)
        ways_world.append(one.start_world + way[:, None] * wells.along_world)
    return steel_along_wells(neighbour, ways_world)


def _around(
    site: Site,
    wells: TwoWells,
    entry: WellsEntry,
    layers: Layers | None,
    neighbour: tuple[Pipe, ...],
    rng: np.random.Generator,
    *,
    perturb: bool,
) -> Surroundings:
    casing, steel = site.platform.magnetometer.casing, None
    if casing is not None:
        true = drawn_steel(casing, rng) if perturb else casing
        half = 0.5 * wells.well_distance + wells.reach + wells.distance
        radius = casing.radius + 0.5 * casing.wall
        segment = min(MIN_SHARE * wells.distance, MAX_SEGMENT)
        built = true.wall, true.permeability, true.conductivity
        steel = Steel((wells.casing(half, radius, built, segment), *neighbour), about=0)
    elif neighbour:
        steel = Steel(neighbour)
    return Surroundings(
        layers,
        steel,
        float(entry.depth_scale_sigma * rng.standard_normal()) if perturb else 0.0,
        entry.depth_sigma_m,
        site.beacons[0].conductivity,
    )


def _figures(
    settings: ShaftSettings, wells: TwoWells, transits: tuple[Pass, ...], stretch: float
) -> Figures:
    """Return the true values under the names of `range`; depths of the magnet as recorded."""
    figures = [
        Figure("seed", settings.seed),
        Figure("passes", len(transits)),
        Figure("duration_s", sum(one.duration for one in transits), "s"),
        Figure("angle", "measured" if settings.encoder else "not recorded"),
    ]
    for k, one in enumerate(transits, start=1):
        distance, direction, depth = wells.truth_of(one)
        rows = (
            ("sensor_depth_m", one.sensor_depth, "m"),
            ("distance_m", distance, "m"),
            ("high_side_deg", direction / DEGREE % 360.0, "deg"),
            ("abreast_depth_m", stretch * depth, "m"),
        )
        figures += [Figure(f"place_{k}_{name}", value, unit) for name, value, unit in rows]
    right, up = wells.leads()
    figures += [
        Figure("leads_right_deg", right / DEGREE, "deg"),
        Figure("leads_up_deg", up / DEGREE, "deg"),
    ]
    return Figures(*figures)
