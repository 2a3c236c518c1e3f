"""The job that plans an installation: a site in, a directory with its coverage out."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from magfusion.errors import InputError
from magfusion.evaluation.coverage import (
    Coverage,
    ExtraBeacon,
    best_extra_beacon,
    coverage,
    phasor_variance,
    usual_box,
    volume,
)
from magfusion.job import claim, named
from magfusion.plots.coverage import write_plot
from magfusion.receiver.windows import default_settings
from magfusion.records.table import write_table
from magfusion.report import Figures, write_report
from magfusion.site import Site
from magfusion.site_file import load_site
from magfusion.units import Array
from magfusion.view_coverage import write_coverage_recording

MOST_POINTS = 100_000
LONGEST_WINDOW = 3600.0  # s; a platform at rest


@dataclass(frozen=True, eq=False)
class CoverageSettings:
    """Where and how to bound; None takes what fits the site.

    Parameters
    ----------
    box_world : ndarray, shape (2, 3), optional
        Lower and upper corner of the volume (m).
    height : float, optional
        Height of a single slice (m).
    spacing : float, optional
        Of the points (m).
    window : float, optional
        Time over which the tones are averaged (s).
    extra_beacon : bool
        Find where one more beacon adds most.
    """

    box_world: Array | None = None
    height: float | None = None
    spacing: float | None = None
    window: float | None = None
    extra_beacon: bool = False


def run_coverage(site_path: Path, settings: CoverageSettings, output: Path) -> Figures:
    """Bound the pose over a volume: table, picture, recording and report.

    Returns
    -------
    dict
        The figures of ``report.json``.

    Raises
    ------
    InputError
        Where the site cannot be read, the settings do not fit, or ``output`` is in the way.
    """
    claimed = claim(output, "coverage")
    site = load_site(site_path)
    window = _window(site, site_path, settings.window)
    box = usual_box(site) if settings.box_world is None else settings.box_world
    spacing = _spacing(box, settings)
    heights = None if settings.height is None else np.array([settings.height])
    points = volume(box, spacing, heights)
    found = coverage(site, points, window)
    extra = None
    if settings.extra_beacon:
        extra = best_extra_beacon(site, box, lambda s, p: coverage(s, p, window), points)
    figures = _figures(site_path, site, window, spacing, found, extra)
    beacon = None if extra is None else extra.beacon
    with claimed as directory:
        _write_points(directory / "coverage.parquet", found)
        write_plot(directory / "coverage.png", site, found, beacon)
        write_coverage_recording(directory / "run.rrd", site, found, spacing, beacon)
        write_report(directory, figures)
    return figures


def _window(site: Site, site_path: Path, given: float | None) -> float:
    if given is None:
        in_turn = [b.name for b in site.beacons if any(slot is not None for _, slot in b.tones)]
        if in_turn:
            raise InputError(
                f"{site_path}: beacon {in_turn[0]} is driven in time slots, whose length the site"
                " does not tell; give the time of one round with --window"
            )
        with named(site_path):
            return default_settings(site).window
    if not 1e-3 <= given <= LONGEST_WINDOW:
        raise InputError(f"--window must lie between 0.001 and 3600 s; got {given:g}")
    return given


def _spacing(box: Array, settings: CoverageSettings) -> float:
    size = box[1] - box[0]
    if settings.height is not None:
        if not abs(settings.height) < 1e6:
            raise InputError(f"--height must be a height in metres; got {settings.height:g}")
        size = size[:2]
    spacing = float(np.max(size)) / 20.0 if settings.spacing is None else settings.spacing
    if not 0.0 < spacing < np.inf:
        raise InputError(f"--spacing must be above 0 m; got {spacing:g}")
    if float(np.prod(size / spacing + 1.0)) > MOST_POINTS:
        raise InputError(
            f"--spacing {spacing:g} gives more than {MOST_POINTS} points in the box; choose a"
            " larger spacing, or one height"
        )
    return spacing


def _figures(
    site_path: Path,
    site: Site,
    window: float,
    spacing: float,
    found: Coverage,
    extra: ExtraBeacon | None,
) -> Figures:
    figures: Figures = {
        "job": "coverage",
        "log": site_path.stem,
        "points": len(found),
        "spacing_m": spacing,
        "window_s": window,
        "noise_of_a_phasor_t": float(np.sqrt(np.max(phasor_variance(site, window)))),
        "share_determined": float(np.mean(found.determined)),
        "share_below_1_cm": float(np.mean(found.position_sigma < 0.01)),
        "share_below_10_cm": float(np.mean(found.position_sigma < 0.1)),
        "position_sigma_m_median": _finite(found.position_quantile(0.5)),
        "position_sigma_m_p90": _finite(found.position_quantile(0.9)),
        "attitude_sigma_deg_median": _finite(np.rad2deg(found.attitude_quantile(0.5))),
        "attitude_sigma_deg_p90": _finite(np.rad2deg(found.attitude_quantile(0.9))),
        "beacons_heard_least": int(np.min(found.beacons)),
    }
    if extra is not None:
        x, y, z = extra.beacon.position_world
        figures |= {"extra_beacon_x_m": x, "extra_beacon_y_m": y, "extra_beacon_z_m": z}
        figures["median_without_extra_m"] = _finite(extra.before)
        figures["median_with_extra_m"] = _finite(extra.after)
    return figures


def _finite(value: float) -> float | None:
    """Return a number as JSON has it: none where the pose is not determined."""
    return float(value) if np.isfinite(value) else None


def _write_points(path: Path, found: Coverage) -> None:
    columns: dict[str, object] = dict(
        zip(("position_x", "position_y", "position_z"), found.position_world.T, strict=True)
    )
    columns |= {"position_sigma": found.position_sigma, "attitude_sigma": found.attitude_sigma}
    columns |= dict(zip(("worst_x", "worst_y", "worst_z"), found.worst_world.T, strict=True))
    columns |= {"beacons": found.beacons, "determined": found.determined}
    write_table(columns, path)
