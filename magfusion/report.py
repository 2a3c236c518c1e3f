"""The flat object of figures that every job writes and prints."""

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from magfusion.errors import InputError
from magfusion.evaluation.errors import TrajectoryErrors, trajectory_errors
from magfusion.evaluation.observability import Observability, observability
from magfusion.fixes.ambiguity import ambiguity_figures, relations
from magfusion.fixes.fix import Fixes
from magfusion.fusion.batch import Smoothed
from magfusion.fusion.earth import disturbed
from magfusion.fusion.self_survey import Placement
from magfusion.records.samples import Log
from magfusion.refinement import DETERMINED_RATIO, Finding, findings
from magfusion.site import Site
from magfusion.trajectory import Trajectory
from magfusion.units import Array

AMBIGUOUS_CHI_SQUARE = 20.0  # below this a mirrored trajectory explains the log nearly as well

Figures = dict[str, float | int | str | bool | list[str] | None]


def write_report(directory: Path, figures: Figures) -> None:
    """Write ``report.json``."""
    text = json.dumps(figures, indent=1, allow_nan=False, default=float)
    (directory / "report.json").write_text(text + "\n")


def error_figures(errors: TrajectoryErrors, prefix: str = "") -> Figures:
    """Return the errors against the truth: absolute, aligned, relative, and their consistency."""
    figures: Figures = {
        "ate_m": errors.ate,
        "attitude_rmse_deg": errors.attitude_rmse_deg,
        "aligned_ate_m": errors.aligned_ate,
        "aligned_attitude_rmse_deg": errors.aligned_attitude_rmse_deg,
        "rpe_translation_m": errors.relative.translation_rmse,
        "rpe_rotation_deg": errors.relative.rotation_rmse_deg,
        "compared_epochs": len(errors.time),
    }
    if errors.nees is not None and errors.pose_cov is not None:
        sigma = np.sqrt(np.diagonal(errors.pose_cov, axis1=1, axis2=2))
        ratio = np.abs(errors.pose_body) / sigma
        figures |= {
            "nees_mean": float(np.mean(errors.nees)),
            "nees_median": float(np.median(errors.nees)),
            "inside_3_sigma": errors.inside_3_sigma,
            "position_inside_3_sigma": float(np.mean(ratio[:, 3:] <= 3.0)),
            "attitude_inside_3_sigma": float(np.mean(ratio[:, :3] <= 3.0)),
        }
    return {prefix + key: value for key, value in figures.items()}


def dropped_figures(dropped: Mapping[str, int]) -> Figures:
    """Return how many windows were dropped, in all and for each reason."""
    figures: Figures = {"windows_dropped": sum(dropped.values())}
    for reason, count in dropped.items():
        figures["windows_dropped_" + reason.replace(" ", "_")] = count
    return figures


def residual_figures(residual: Array, channels: tuple[tuple[str, int], ...]) -> Figures:
    """Return the whitened residual of each beacon: one where noise and model are as declared."""
    figures: Figures = {}
    for name in dict.fromkeys(beacon for beacon, _ in channels):
        own = residual[:, [beacon == name for beacon, _ in channels]]
        if np.any(np.isfinite(own)):
            figures[f"residual_rms_{name}"] = float(np.sqrt(np.nanmean(own**2)))
    return figures


def _earth_figures(result: Smoothed) -> Figures:
    """Return how the Earth field was explained, and where it had to do without beacons."""
    residual, fields = result.earth_residual, result.problem.fields
    if residual is None or fields is None or fields.measurements.earth_repeats is None:
        return {}
    held = result.fields.valid.any(axis=1)
    return {
        "earth_residual_rms": float(np.sqrt(np.mean(residual**2))),
        "earth_disturbed_epochs": int(
            np.sum(disturbed(residual, fields.measurements.earth_repeats))
        ),
        "epochs_without_beacon": int(np.sum(~held)),
    }


def smoothed_figures(result: Smoothed) -> Figures:
    """Return the figures of a smoothed log."""
    told = findings(result.declared, result.calibration, result.blocks, result.calibration_cov)
    chosen = result.start.chosen
    figures: Figures = {
        "epochs": len(result.states),
        "duration_s": float(result.states.time[-1] - result.states.time[0]),
        "window_s": float(np.median(result.fields.window)),
        "passes": result.passes,
        "iterations": result.iterations,
        "converged": result.converged,
        "cost": result.cost,
        "intervals_bridged": result.bridged,
        "start_epochs_not_first_hypothesis": int(np.sum(chosen > 0)),
        "rival_chi_square": result.rival_chi_square,
        "ambiguous": result.rival_chi_square is not None
        and result.rival_chi_square < AMBIGUOUS_CHI_SQUARE,
        "time_offset_s": result.calibration.time_offset,
    }
    figures |= dropped_figures(result.dropped)
    figures |= residual_figures(result.residual, result.fields.channels) | _earth_figures(result)
    if result.states.pose_cov is not None:
        sigma = np.sqrt(np.diagonal(result.states.pose_cov, axis1=1, axis2=2))
        figures["position_sigma_median_m"] = float(np.median(sigma[:, 3:]))
        figures["attitude_sigma_median_deg"] = float(np.rad2deg(np.median(sigma[:, :3])))
    if result.blocks:
        known = observability(result.calibration, result.blocks, result.calibration_cov)
        figures |= observability_figures(told, known)
    for found in told:
        figures[found.name] = found.change
        figures[f"{found.name}_sigma"] = found.sigma
        figures[f"{found.name}_prior_sigma"] = found.prior_sigma
    figures["determined"] = [f.name for f in told if f.determined]
    figures["undetermined"] = [f.name for f in told if not f.determined]
    return figures


def observability_figures(told: list[Finding], found: Observability) -> Figures:
    """Return what a log determined of the calibration, parameter by parameter and in words."""
    figures: Figures = {
        "directions": len(found.direction_ratio),
        "directions_determined": found.determined,
        "directions_gauge": len(found.gauge),
    }
    beside = found.ratio_but_for_gauge
    for one, ratio, rest in zip(told, found.ratio, beside, strict=True):
        figures[f"{one.name}_ratio"] = float(ratio)
        figures[f"{one.name}_ratio_but_for_gauge"] = float(rest) if np.isfinite(rest) else None
    figures["determined_but_for_gauge"] = [
        one.name for one, rest in zip(told, beside, strict=True) if rest < DETERMINED_RATIO
    ]
    figures["gauge"] = [open_.words for open_ in found.gauge]
    figures["weakest_directions"] = [open_.words for open_ in found.weakest]
    return figures


def placement_figures(placed: tuple[Placement, ...], site: Site) -> Figures:
    """Return where beacons of unknown place were found, with what else would explain the log."""
    figures: Figures = {}
    if placed:
        figures["placed"] = [placement.name for placement in placed]
    final = {beacon.name: beacon for beacon in site.beacons}
    for placement in placed:
        for axis, value in zip("xyz", final[placement.name].position_world, strict=True):
            figures[f"placed_{placement.name}_{axis}_m"] = float(value)
        chi_square = [one.chi_square for one in placement.hypotheses]
        figures[f"hypotheses_{placement.name}"] = [
            f"beacon {placement.name} at ({', '.join(f'{x:.2f}' for x in place)}) m:"
            f" chi square larger by {one.chi_square:.3g}"
            f" ({'whole log' if one.smoothed else 'along the first trajectory'})"
            for one in placement.hypotheses
            for place in [one.beacon.position_world]
        ]
        figures[f"hypotheses_{placement.name}_rival_chi_square"] = (
            chi_square[1] if len(chi_square) > 1 else None
        )
    return figures


def fix_figures(fixes: Fixes, site: Site) -> Figures:
    """Return the figures of single-epoch fixes, ambiguities included and told in words."""
    share = fixes.probability
    second = share[:, 1] if share.shape[1] > 1 else np.zeros(len(fixes))
    return {
        "epochs": len(fixes),
        "ambiguous_epochs": int(np.sum(second > 0.05)),
        "undetermined_epochs": int(np.sum(~fixes.determined[:, 0])),
        "residual_rms_median": float(np.median(fixes.residual_rms[:, 0])),
        **ambiguity_figures(relations(fixes, site)),
    }


def compared_with_truth(estimate: Trajectory, log: Log) -> tuple[TrajectoryErrors | None, Figures]:
    """Return the errors against the log's truth, if it has one there, and their figures."""
    if log.truth is None:
        return None, {}
    try:
        errors = trajectory_errors(estimate, log.truth)
    except InputError as error:  # a truth elsewhere does not make the trajectory worthless
        return None, {"not_compared": str(error)}
    return errors, error_figures(errors)
