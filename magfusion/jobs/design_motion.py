"""The part of `design` that proposes stops of the platform for a calibration."""

from pathlib import Path

import numpy as np

from magfusion.errors import InputError
from magfusion.files.table import write_table
from magfusion.jobs.design_settings import DesignSettings
from magfusion.model.hall import Hall
from magfusion.model.site import Site
from magfusion.model.trust import Trust
from magfusion.results.design.motion import MotionPlan, next_motion
from magfusion.results.figures import Figure, Figures, Section, heading
from magfusion.results.verdict import trust_figures
from magfusion.units import Array


def run_motion(
    settings: DesignSettings, site: Site, hall: Hall, points: Array, output: Path
) -> Figures:
    """Choose stops for a calibration: table, picture and report."""
    from magfusion.jobs.result_directory import claim
    from magfusion.results.plots.motion import write_motion_plot
    from magfusion.results.report import write_report

    assert settings.motion is not None
    claimed = claim(output, "design")
    result = next_motion(site, points, settings.motion, settings.stop, known=settings.poses_known)
    if not len(result.parameters.sigma):
        raise InputError(
            f"{settings.site}: all sigmas are zero, so that there is no parameter to calibrate;"
            " declare the uncertainty of beacons and magnetometer"
        )
    figures = _figures(settings, result)
    with claimed as directory:
        _write_stops(directory / "motion.parquet", result)
        write_motion_plot(directory / "motion.png", site, hall, result)
        write_report(directory, figures)
    return figures


def stop_instruction(result: MotionPlan, number: int) -> str:
    """Return the instruction for a stop, and its purpose."""
    stop, parameters = result.stops[number], result.parameters
    x, y, z = stop.position_world
    roll, pitch, yaw = stop.rpy_deg
    before, after = (parameters.sized(stop.worst, r) for r in (stop.before, stop.after))
    return (
        f"{number + 1}. Hold the platform at ({x:.2f}, {y:.2f}, {z:.2f}) m, turned by roll"
        f" {roll:g}, pitch {pitch:g}, yaw {yaw:g} deg: the sigma of"
        f" {parameters.names[stop.worst][0]} falls from {before} to {after}."
    )


def _figures(settings: DesignSettings, result: MotionPlan) -> Figures:
    parameters = result.parameters
    start, remaining = (parameters.excess(r) for r in (np.ones(len(result.ratio)), result.ratio))
    requested = parameters.requested
    beyond = [parameters.names[k][0] for k in np.flatnonzero(~requested)]
    notes = [stop_instruction(result, k) for k in range(len(result.stops))]
    if beyond:
        notes.append(
            f"No such stops determine {', '.join(beyond)}: only a better survey does, or"
            " measured poses; for the lever arm, rotation on the spot with an IMU."
        )
    figures = [
        Figure("stops", len(result.stops)),
        Figure("stop_s", settings.stop, "s"),
        Figure("poses_known", settings.poses_known),
        Figure("parameters", len(requested)),
        Figure("parameters_in_reach", int(np.sum(requested))),
        *(
            Figure(
                f"worst_excess_{name}",
                float(np.max(value[requested], initial=0.0)),
                label=f"worst parameter, {name}, in sigmas of the fields' noise",
            )
            for name, value in (("before", start), ("after", remaining))
        ),
        Figure("out_of_reach", beyond, section=Section.REPORT),
        Figure("notes", notes, section=Section.NOTES),
    ]
    return heading("design", settings.site.stem) | trust_figures(Trust()) | Figures(*figures)


def _write_stops(path: Path, result: MotionPlan) -> None:
    def column(of: str) -> Array:
        return np.array([getattr(stop, of) for stop in result.stops])

    parameters = result.parameters
    size = np.array([parameters.sigma[stop.worst] for stop in result.stops])
    where, rotated = column("position_world").reshape(-1, 3), column("rpy_deg").reshape(-1, 3)
    columns: dict[str, object] = dict(
        zip(("position_x", "position_y", "position_z"), where.T, strict=True)
    )
    columns |= dict(zip(("roll_deg", "pitch_deg", "yaw_deg"), rotated.T, strict=True))
    columns["parameter"] = [parameters.names[stop.worst][0] for stop in result.stops]
    columns |= {"sigma_before": size * column("before"), "sigma_after": size * column("after")}
    write_table(columns, path)
