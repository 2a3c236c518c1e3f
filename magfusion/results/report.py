"""Common figures of several jobs, and their output file."""

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from magfusion.errors import InputError
from magfusion.estimation.batch.batch import Smoothed
from magfusion.estimation.batch.hypothesis_selection import AMBIGUOUS_CHI_SQUARE
from magfusion.estimation.batch.self_survey import Placement
from magfusion.estimation.snapshot.ambiguity import ambiguities, relations
from magfusion.estimation.snapshot.fix import Fixes
from magfusion.model.one_axis import roll_is_open
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.results.errors import TrajectoryErrors, trajectory_errors
from magfusion.results.figures import (
    DETERMINED_RATIO,
    ErrorColumn,
    Figure,
    Figures,
    ParameterEstimate,
    Section,
    Value,
    determined_figures,
)
from magfusion.results.observability import CalibrationObservability, observability
from magfusion.results.page import write_page
from magfusion.results.page_motion import MotionPage
from magfusion.results.refinement import parameter_estimates
from magfusion.units import Array

FAILED = "failed"  # directory of what was found where the verdict is that
POOR_FIT = 3.0  # whitened residual, one where noise and model are as declared
_REPORT, _ERRORS, _SUMMARY = Section.REPORT, Section.ERRORS, Section.SUMMARY


def write_report(directory: Path, figures: Figures, motion: MotionPage | None = None) -> None:
    """Write ``report.json``, and ``report.html`` with the result: in `FAILED` if that exists.

    `motion`: content of the page in addition to the figures and the pictures in the directory.
    """
    text = json.dumps(dict(figures), indent=1, allow_nan=False, default=float)
    (directory / "report.json").write_text(text + "\n")
    failed = directory / FAILED
    write_page(failed if failed.is_dir() else directory, figures, motion)


def where_found(name: str, result: bool, value: Value) -> Figure:
    """Return a figure that the screen shows only where it matters."""
    return Figure(name, value, section=_SUMMARY if result else _REPORT)


def error_figures(
    errors: TrajectoryErrors, column: ErrorColumn = ErrorColumn.RMS, prefix: str = ""
) -> Figures:
    """Return the errors against the truth: absolute, aligned, relative, and their consistency.

    `column`: of the screen's table; consistency is shown only for errors of the result itself.
    `prefix`: of the keys.
    """
    own, aligned = (_REPORT, _REPORT) if prefix else (_SUMMARY, _ERRORS)
    relative, attitude_deg = errors.relative, errors.aligned_attitude_rmse_deg
    rows = (
        ("ate_m", errors.ate, "m", _ERRORS, "position", column),
        ("attitude_rmse_deg", errors.attitude_rmse_deg, "deg", _ERRORS, "attitude", column),
        ("aligned_ate_m", errors.aligned_ate, "m", aligned, "position", ErrorColumn.ALIGNED),
        (
            "aligned_attitude_rmse_deg",
            attitude_deg,
            "deg",
            aligned,
            "attitude",
            ErrorColumn.ALIGNED,
        ),
        ("rpe_translation_m", relative.translation_rmse, "m", _ERRORS, "step, position", column),
        ("rpe_rotation_deg", relative.rotation_rmse_deg, "deg", _ERRORS, "step, attitude", column),
    )
    figures = [
        Figure(name, value, unit, None, section, row, place)
        for name, value, unit, section, row, place in rows
        if np.isfinite(value)  # of a truth with positions or attitudes alone
    ]
    skipped = int(np.sum(~errors.compared))
    covers = "estimate" if errors.at_truth else "truth"
    of = "samples of the truth" if errors.at_truth else "epochs"
    note = (
        f"The {covers} does not cover {skipped} of {len(errors.compared)} {of}:"
        f" {errors.not_covered}."
    )
    epochs = Figure("compared_epochs", len(errors.time), section=own)
    if errors.at_truth:
        epochs = replace(epochs, remark="compared at the samples of the truth, which is coarser")
    figures.append(replace(epochs, note=note) if skipped and not prefix else epochs)
    if errors.nees is not None and errors.pose_cov is not None:
        sigma = np.sqrt(np.diagonal(errors.pose_cov, axis1=1, axis2=2))
        ratio = np.abs(errors.pose_body) / sigma
        mean, inside = float(np.mean(errors.nees)), errors.inside_3_sigma
        expected = errors.degrees_of_freedom
        figures += [
            Figure("nees_mean", mean, section=own, label=f"mean NEES ({expected} expected)"),
            Figure("nees_median", float(np.median(errors.nees)), section=_REPORT),
            Figure("inside_3_sigma", inside, section=own, label="share within 3 sigma"),
            *(
                Figure(
                    f"{part}_inside_3_sigma", float(np.mean(ratio[:, k] <= 3.0)), section=_REPORT
                )
                for part, k in (("position", slice(3, 6)), ("attitude", slice(0, 3)))
                if np.isfinite(ratio[:, k]).all()
            ),
        ]
    return Figures(*(replace(f, name=prefix + f.name) for f in figures))


def sigma_figures(pose_cov: Array) -> Figures:
    """Return the median of the estimated standard deviations of a pose's components."""
    sigma = np.median(np.sqrt(np.diagonal(pose_cov, axis1=1, axis2=2)).reshape(-1, 2, 3), (0, 2))
    rows = (
        ("position_sigma_median_m", float(sigma[1]), "m", "position"),
        ("attitude_sigma_median_deg", float(np.rad2deg(sigma[0])), "deg", "attitude"),
    )
    return Figures(
        *(
            Figure(name, value, unit, None, _ERRORS, row, ErrorColumn.SIGMA)
            for name, value, unit, row in rows
        )
    )


def dropped_figures(dropped: Mapping[str, int], what: str = "windows") -> Figures:
    """Return the number of dropped windows (or epochs), in all and for each reason."""
    total = sum(dropped.values())
    return Figures(
        where_found(f"{what}_dropped", total > 0, total),
        *(
            Figure(f"{what}_dropped_{reason.replace(' ', '_')}", count, refused=True)
            for reason, count in dropped.items()
        ),
    )


def open_figures(site: Site) -> Figures:
    """Return the undetermined directions of every pose, if any."""
    if not roll_is_open(site):
        return Figures()
    return Figures(Figure("open_directions", ["roll about the axis"], section=Section.REPORT))


def residual_figure(beacon: str, rms: float) -> Figure:
    """Return the whitened residual of a beacon: one where noise and model are as declared."""
    note = (
        f"The residual of beacon {beacon} is {rms:.3g} where about 1 is expected; check the"
        " beacon's type, position and drive in the survey."
    )
    return Figure(
        "residual_rms_{beacon}",
        rms,
        beacon=beacon,
        label="residual rms (1 expected)",
        note=note if rms > POOR_FIT else "",
    )


def residual_figures(residual: Array, channels: tuple[tuple[str, int], ...]) -> Figures:
    """Return the whitened residual of each beacon."""
    result = []
    for name in dict.fromkeys(beacon for beacon, _ in channels):
        own = residual[:, [beacon == name for beacon, _ in channels]]
        if np.any(np.isfinite(own)):
            result.append(residual_figure(name, float(np.sqrt(np.nanmean(own**2)))))
    return Figures(*result)


def rival_figures(chi_square: float | None) -> Figures:
    """Return the chi-square increase of the second-best trajectory, and a note."""
    ambiguous = chi_square is not None and chi_square < AMBIGUOUS_CHI_SQUARE
    note = (
        f"Another trajectory explains the log nearly as well (its chi square is only"
        f" {chi_square:.3g} larger); add a beacon, or record more motion."
        if ambiguous
        else ""
    )
    return Figures(
        Figure("rival_chi_square", chi_square, section=_REPORT),
        Figure("ambiguous", ambiguous, section=_REPORT, note=note),
    )


def _earth_figures(result: Smoothed) -> Figures:
    """Return the residual of the Earth field, and its use without beacons."""
    if result.earth_residual is None or result.earth_disturbed is None:
        return Figures()
    rms = float(np.sqrt(np.mean(result.earth_residual**2)))
    disturbed_epochs = int(np.sum(result.earth_disturbed))
    undetected = int(np.sum(~result.fields.valid.any(axis=1)))
    return Figures(
        Figure("earth_residual_rms", rms, label="residual rms of the Earth field (1 expected)"),
        Figure("earth_disturbed_epochs", disturbed_epochs, label="epochs, Earth field disturbed"),
        Figure("epochs_without_beacon", undetected),
    )


def smoothed_figures(result: Smoothed, directions: Section = _REPORT) -> Figures:
    """Return the figures of a smoothed log.

    `directions`: section of the determined and undetermined directions of the calibration.
    """
    states = result.states
    estimates = parameter_estimates(
        result.declared, result.calibration, result.blocks, result.calibration_cov
    )
    figures = Figures(
        Figure("epochs", len(states)),
        Figure("duration_s", float(states.time[-1] - states.time[0]), "s"),
        Figure("window_s", float(np.median(result.fields.window)), "s"),
        Figure("passes", result.iteration_count, section=_REPORT),
        Figure("iterations", result.iterations, section=_REPORT),
        Figure("converged", result.converged, section=_REPORT if result.converged else _SUMMARY),
        Figure("cost", result.cost, section=_REPORT),
        where_found("intervals_bridged", result.gap_bridged > 0, result.gap_bridged),
        Figure(
            "start_epochs_not_first_hypothesis",
            int(np.sum(result.start.chosen > 0)),
            section=_REPORT,
        ),
    )
    figures |= Figures(*(replace(f, note="") for f in rival_figures(result.rival_chi_square).all))
    figures |= Figures(Figure("time_offset_s", result.calibration.time_offset, section=_REPORT))
    figures |= dropped_figures(result.dropped)
    figures |= residual_figures(result.residual, result.fields.channels) | _earth_figures(result)
    if states.pose_cov is not None:
        figures |= sigma_figures(states.pose_cov)
    if result.blocks:
        known = observability(result.calibration, result.blocks, result.calibration_cov)
        figures |= observability_figures(estimates, known, directions)
    return figures | Figures(*estimates) | determined_figures(estimates)


def observability_figures(
    estimates: list[ParameterEstimate], result: CalibrationObservability, section: Section = _REPORT
) -> Figures:
    """Return the observability of the calibration, parameter by parameter and in words."""
    count, determined = len(result.direction_ratio), result.determined
    share = f"of {count} directions of the calibration are determined"
    figures = [
        Figure("directions", count, section=_REPORT),
        Figure("directions_determined", determined, section=section, label=share),
        Figure("directions_gauge", len(result.gauge), section=_REPORT),
    ]
    others = result.ratio_but_for_gauge
    for one, ratio, rest in zip(estimates, result.ratio, others, strict=True):
        remaining = float(rest) if np.isfinite(rest) else None
        figures += [
            Figure(f"{one.name}_ratio", float(ratio), "", one.beacon, _REPORT),
            Figure(f"{one.name}_ratio_but_for_gauge", remaining, "", one.beacon, _REPORT),
        ]
    known = [e.key for e, rest in zip(estimates, others, strict=True) if rest < DETERMINED_RATIO]
    return Figures(
        *figures,
        Figure("determined_but_for_gauge", known, section=_REPORT),
        *(
            Figure(name, [one.words for one in open_], section=section, label="open")
            for name, open_ in (("gauge", result.gauge), ("weakest_directions", result.weakest))
        ),
    )


def placement_figures(placed: tuple[Placement, ...], site: Site) -> Figures:
    """Return the estimated positions of unknown beacons, and their alternatives."""
    if not placed:
        return Figures()
    figures = [Figure("placed", [placement.name for placement in placed], section=_REPORT)]
    final = {beacon.name: beacon for beacon in site.beacons}
    for placement in placed:
        name, result = placement.name, final[placement.name].position_world
        figures += [
            Figure(f"placed_{{beacon}}_{axis}_m", float(value), "m", name, _REPORT)
            for axis, value in zip("xyz", result, strict=True)
        ]
        places = [
            f"beacon {name} at ({_listed(one.beacon.position_world, 2)}) m:"
            f" chi square larger by {one.chi_square:.3g}"
            f" ({'whole log' if one.smoothed else 'along the first trajectory'})"
            for one in placement.hypotheses
        ]
        rival = placement.hypotheses[1].chi_square if len(places) > 1 else None
        note = (
            f"The log allows more than one position of beacon {name} ({'; '.join(places)}); record"
            " more motion, in all three directions."
            if rival is not None and rival <= AMBIGUOUS_CHI_SQUARE
            else ""
        )
        remark = (
            f"beacon {name} was placed at ({_listed(result, 3)}) m; {len(places)} place(s)"
            " explained its field"
        )
        figures += [
            Figure("hypotheses_{beacon}", places, "", name, _REPORT, note=note, remark=remark),
            Figure("hypotheses_{beacon}_rival_chi_square", rival, "", name, _REPORT),
        ]
    return Figures(*figures)


def _listed(place: Array, digits: int) -> str:
    return ", ".join(f"{x:.{digits}f}" for x in place)


def fix_figures(fixes: Fixes, site: Site) -> Figures:
    """Return the figures of single-epoch fixes, with sentences on their ambiguities."""
    share = fixes.probability
    second = share[:, 1] if share.shape[1] > 1 else np.zeros(len(fixes))
    epochs, ambiguous = len(fixes), int(np.sum(second > 0.05))
    undetermined = int(np.sum(~fixes.determined[:, 0]))
    notes = (
        f"{ambiguous} of {epochs} epochs are ambiguous: fixes.parquet has every pose that explains"
        " them; add a beacon, or smooth, so that the motion decides.",
        f"{undetermined} of {epochs} epochs do not determine the pose in one direction"
        " (undetermined in fixes.parquet); add a beacon or a coil.",
    )
    words = ambiguities(relations(fixes, site))
    counts = (("ambiguous_epochs", ambiguous), ("undetermined_epochs", undetermined))
    return Figures(
        Figure("epochs", epochs),
        *(
            replace(where_found(name, count > 0, count), note=note if count else "")
            for (name, count), note in zip(counts, notes, strict=True)
        ),
        Figure("residual_rms_median", float(np.median(fixes.residual_rms[:, 0]))),
        *(
            Figure(f"ambiguity_{kind}_epochs", count, section=_REPORT)
            for kind, count in words.epochs.items()
        ),
        Figure("ambiguity", words.open, section=Section.NOTES),
        Figure("ambiguity_settled", words.resolved, section=Section.REMARKS),
    )


def compared_with_truth(
    estimate: Trajectory, log: Log, column: ErrorColumn = ErrorColumn.RMS, prefix: str = ""
) -> tuple[TrajectoryErrors | None, Figures]:
    """Return the errors against the log's truth, if it has one there, and their figures."""
    if log.truth is None:
        return None, Figures()
    try:
        errors = trajectory_errors(estimate, log.truth)
    except InputError as error:  # a truth elsewhere does not make the trajectory worthless
        note = f"There is no comparison with the truth: {error}"
        missing = Figure(f"{prefix}not_compared", str(error), section=_REPORT)
        return None, Figures(missing if prefix else replace(missing, note=note))
    return errors, error_figures(errors, column, prefix)
