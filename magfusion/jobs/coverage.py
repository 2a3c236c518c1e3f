"""The job that plans an installation: a site in, a directory with its coverage out."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from magfusion.errors import InputError
from magfusion.files.site import load_site
from magfusion.files.table import write_table
from magfusion.jobs.design_settings import NeedSettings
from magfusion.jobs.receiver_axes import three_axes
from magfusion.jobs.settings import Command, argument, option
from magfusion.jobs.simulate import box_option
from magfusion.model.site import Site
from magfusion.model.trust import Trust
from magfusion.receiver.windows import default_settings
from magfusion.results.coverage import (
    Coverage,
    ExtraBeacon,
    best_extra_beacon,
    coverage,
    phasor_variance,
    usual_box,
    volume,
)
from magfusion.results.figures import Figure, Figures, heading
from magfusion.results.verdict import trust_figures
from magfusion.units import Array

MAX_POINTS = 100_000


@dataclass(frozen=True, kw_only=True)
class CoverageSettings(NeedSettings):
    """Volume and grid of the bounds; None selects defaults from the site."""

    site: Path = argument("Site file of the installation")
    box: str | None = option(
        None, "Volume, m: xmin,xmax,ymin,ymax,zmin,zmax", note="default: around the beacons"
    )
    height: float | None = option(None, "A single height", unit="m")
    spacing: float | None = option(
        None, "Spacing of points", unit="m", above=0.0, note="default: a twentieth of the volume"
    )
    window: float | None = option(
        None,
        "Averaging time of the tones",
        unit="s",
        least=1e-3,
        most=3600.0,
        note="default: from the tones' spacing",
    )
    extra_beacon: bool = option(False, "Find the best position of one more beacon")


def run_coverage(settings: CoverageSettings, output: Path) -> Figures:
    """Bound the pose over a volume: table, picture, recording and report."""
    from magfusion.jobs.result_directory import claim
    from magfusion.results.plots.coverage import write_plot
    from magfusion.results.recording_coverage import write_coverage_recording
    from magfusion.results.report import write_report

    claimed, site_path = claim(output, "coverage"), settings.site
    given = box_option(settings.box)
    site = three_axes(load_site(site_path), site_path)
    window = _window(site, site_path, settings.window)
    box = usual_box(site) if given is None else given
    spacing = _spacing(box, settings)
    heights = None if settings.height is None else np.array([settings.height])
    points = volume(box, spacing, heights)
    result = coverage(site, points, window, risk=settings.risks)
    extra = None
    if settings.extra_beacon:
        extra = best_extra_beacon(site, box, lambda s, p: coverage(s, p, window), points)
    figures = heading("coverage", site_path.stem) | need_figures(result, settings.limits)
    figures |= _figures(site, window, spacing, result, extra)
    beacon = None if extra is None else extra.beacon
    with claimed as directory:
        write_points(directory / "coverage.parquet", result)
        write_plot(directory / "coverage.png", site, result, beacon)
        write_coverage_recording(directory / "run.rrd", site, result, spacing, beacon)
        write_report(directory, figures)
    return figures


def _window(site: Site, site_path: Path, given: float | None) -> float:
    from magfusion.jobs.inputs import named

    if given is None:
        in_turn = [b.name for b in site.beacons if any(slot is not None for _, slot in b.tones)]
        if in_turn:
            raise InputError(
                f"{site_path}: beacon {in_turn[0]} is driven in time slots, whose length is not in"
                " the site; give the time of one round with --window"
            )
        with named(site_path):
            return default_settings(site).window
    return given


def _spacing(box: Array, settings: CoverageSettings) -> float:
    size = box[1] - box[0]
    if settings.height is not None:
        if not abs(settings.height) < 1e6:
            raise InputError(f"--height must be finite; got {settings.height:g}")
        size = size[:2]
    spacing = float(np.max(size)) / 20.0 if settings.spacing is None else settings.spacing
    if float(np.prod(size / spacing + 1.0)) > MAX_POINTS:
        raise InputError(
            f"--spacing {spacing:g} gives more than {MAX_POINTS} points in the box; choose a"
            " larger spacing, or one height"
        )
    return spacing


def _figures(
    site: Site, window: float, spacing: float, coverage: Coverage, extra: ExtraBeacon | None
) -> Figures:
    position, attitude = coverage.position_quantile, coverage.attitude_quantile
    figures = [
        Figure("points", len(coverage)),
        Figure("spacing_m", spacing, "m"),
        Figure("window_s", window, "s"),
        Figure("noise_of_a_phasor_t", float(np.sqrt(np.max(phasor_variance(site, window)))), "T"),
        Figure("share_determined", float(np.mean(coverage.determined))),
        Figure("share_below_1_cm", float(np.mean(coverage.position_sigma < 0.01))),
        Figure("share_below_10_cm", float(np.mean(coverage.position_sigma < 0.1))),
        *(
            Figure(f"{name}_sigma_{unit}_{key}", finite(value), unit, label=f"{name} sigma, {word}")
            for name, unit, quantile in (
                ("position", "m", position),
                ("attitude", "deg", lambda q: np.rad2deg(attitude(q))),
            )
            for key, word, value in (
                ("median", "median", quantile(0.5)),
                ("p90", "90th percentile", quantile(0.9)),
            )
        ),
        *level_figures(coverage),
        Figure(
            "beacons_heard_least", int(np.min(coverage.beacons)), label="beacons in range, least"
        ),
    ]
    if extra is not None:
        figures += [
            *(
                Figure(f"extra_beacon_{axis}_m", float(value), "m")
                for axis, value in zip("xyz", extra.beacon.position_world, strict=True)
            ),
            Figure("median_without_extra_m", finite(extra.before), "m"),
            Figure("median_with_extra_m", finite(extra.after), "m"),
        ]
    return Figures(*figures)


def need_figures(
    coverage: Coverage, limits: tuple[float, ...], *, of_sigma: bool = False
) -> Figures:
    """Return whether the protection levels that are needed are reached; nothing without a need.

    `limits`: of position (m), and of attitude (deg) where it matters; empty without a need.
    `of_sigma`: whether sigmas of position and attitude are needed instead.
    """
    level_m, level_deg = coverage.protection_level_m, coverage.protection_level_deg
    if of_sigma:
        level_m, level_deg = coverage.position_sigma, np.rad2deg(coverage.attitude_sigma)
    if not limits or level_m is None or level_deg is None:
        return Figures()
    levels = (level_m, level_deg)[: len(limits)]
    within = np.all([level <= limit for level, limit in zip(levels, limits, strict=True)], axis=0)
    answer = "reached" if np.all(within) else "not reached"
    needed = (
        Figure(f"need_{unit}", limit, unit)
        for limit, unit in zip(limits, ("m", "deg"), strict=False)
    )
    share = Figure("share_reached", float(np.mean(within)), label="share of points that reach it")
    return trust_figures(Trust(), answer) | Figures(*needed, share)


def level_figures(coverage: Coverage) -> list[Figure]:
    """Return median and worst of the protection levels, and where they exist."""
    parts = (
        ("m", "position", coverage.protection_level_m),
        ("deg", "attitude", coverage.protection_level_deg),
    )
    figures = [
        Figure(
            f"protection_level_{unit}_{key}",
            finite(float(np.quantile(level, share, method="higher"))),
            unit,
            label=f"protection level, {name}, {key}",
        )
        for unit, name, level in parts
        if level is not None
        for key, share in (("median", 0.5), ("worst", 1.0))
    ]
    if coverage.protection_level_m is not None:
        share = float(np.mean(np.isfinite(coverage.protection_level_m)))
        figures.append(Figure("share_with_level", share))
    return figures


def finite(value: float) -> float | None:
    """Return a number as in JSON: null where the pose is not determined."""
    return float(value) if np.isfinite(value) else None


def write_points(path: Path, coverage: Coverage) -> None:
    """Write every point with its bounds."""
    columns: dict[str, object] = dict(
        zip(("position_x", "position_y", "position_z"), coverage.position_world.T, strict=True)
    )
    columns |= {
        "position_sigma": coverage.position_sigma,
        "attitude_sigma": coverage.attitude_sigma,
    }
    columns |= dict(zip(("worst_x", "worst_y", "worst_z"), coverage.worst_world.T, strict=True))
    columns |= {"beacons": coverage.beacons, "determined": coverage.determined}
    if coverage.protection_level_m is not None and coverage.protection_level_deg is not None:
        columns["protection_level_m"] = coverage.protection_level_m
        columns["protection_level_deg"] = coverage.protection_level_deg
    write_table(columns, path)


COMMAND = Command(
    CoverageSettings,
    run_coverage,
    output="coverage",
    example="magfusion coverage site.yaml --extra-beacon -o coverage",
)
