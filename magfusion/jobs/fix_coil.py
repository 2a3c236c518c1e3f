"""The fix of a receiver of one axis: its position and direction, the roll about it unknown."""

import time
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from magfusion.errors import EstimationError
from magfusion.estimation.data_checks.data_quality import BRIDGED_CODES, recorded
from magfusion.estimation.snapshot.ambiguity import relations
from magfusion.estimation.snapshot.coil_fix import UNKNOWNS, CoilFixes, Gain, fix_coil
from magfusion.estimation.snapshot.coil_poses import (
    axis_sigma,
    judged_poses,
    nearest_reported,
    nearest_truth,
    poses_of,
)
from magfusion.estimation.snapshot.coil_starts import CoilEpochs
from magfusion.estimation.snapshot.fix import Fixes
from magfusion.estimation.snapshot.region_test import of_place
from magfusion.model.parameters import initial_calibration
from magfusion.model.progress import Report
from magfusion.model.samples import FieldSamples, Log
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.model.trust import StateTrust, Trust
from magfusion.results.figures import ErrorColumn, Figure, Figures, Section, heading
from magfusion.results.report import where_found
from magfusion.results.verdict import trust_figures
from magfusion.units import Array


@dataclass(frozen=True, eq=False)
class FoundCoil:
    """Poses of a receiver of one axis, with their findings."""

    log: Log  # with the truth rotated to the selected roll
    fixes: Fixes
    states: StateTrust
    trust: Trust
    figures: Figures
    relation: NDArray[np.str_]
    # additional columns of the hypotheses' table, shape (n, hypotheses) each
    columns: dict[str, Array]
    # of the reported positions nearest to the truth, with their own covariance
    compared: Trajectory | None = None


def find_coil(
    log: Log, fields: FieldSamples, site: Site, free_parameters: tuple[str, ...], report: Report
) -> FoundCoil:
    """Fix every epoch of a receiver of one axis.

    `fields`: channels in the site's order. `free_parameters`: ``gain`` where the gain is unknown,
    ``phase`` where drive phases are unknown. Raises EstimationError where no epoch has enough
    channels.
    """
    began = time.perf_counter()
    report("fixing", 1, 3)
    if "phase" in free_parameters:
        site = replace(site, beacons=tuple(replace(b, synchronised=False) for b in site.beacons))
    epochs = CoilEpochs.of(fields, site)
    gain = Gain.of(site.platform.magnetometer, free_parameters="gain" in free_parameters)
    least = UNKNOWNS - int(np.isfinite(gain.sigma))
    enough = epochs.number_count >= least
    if not np.any(enough):
        raise EstimationError(
            f"{log.name}: no epoch has {least} beacons, which position, direction and gain of a"
            " receiver of one axis require (half as many if they rotate); add beacons, write their"
            " fields at one time, or smooth, to use the inertial sensor"
        )
    kept = epochs.rows(enough)
    calibration = initial_calibration(site, float(np.mean(kept.time)))
    result = fix_coil(kept, calibration, gain)
    report("done", 3, 3)
    fixes = poses_of(result, kept.time, site, signed=kept.signed)
    verdicts = judged_poses(fixes, result, int(np.sum(~enough)), signed=kept.signed)
    fixes = verdicts.fixes
    first = (fixes.world_from_body, fixes.position_world, fixes.pose_cov)
    trust = verdicts.trust | Trust(of_place(site, fixes.time, *(part[:, 0] for part in first)))
    streams = replace(log, fields=None)  # the other axes are no silence
    trust |= Trust(recorded(streams, site, BRIDGED_CODES))
    figures = heading("fix", log.name) | trust_figures(trust)
    figures |= _figures(fixes, result, signed=kept.signed)
    figures |= Figures(Figure("elapsed_s", time.perf_counter() - began, "s"))
    compared = None
    if log.truth is not None and log.truth.has_poses:
        # A comparison with the other mirror would only measure their separation.
        compared, other = nearest_reported(verdicts.alone, log.truth, site)
        rotated = nearest_truth(log.truth, compared, site, signed=kept.signed)
        log = replace(log, truth=rotated)
        figures |= Figures(where_found("compared_rivals", bool(np.any(other)), int(np.sum(other))))
    decided = replace(fixes, determined=np.ones_like(fixes.determined))
    return FoundCoil(
        log=log,
        fixes=fixes,
        states=verdicts.states,
        trust=trust,
        figures=figures,
        relation=relations(decided, site).label,
        columns=_columns(result),
        compared=compared,
    )


def _columns(fixes: CoilFixes) -> dict[str, Array]:
    gain = np.linalg.norm(fixes.axis_world, axis=-1)
    towards = fixes.axis_world / gain[..., None]
    place = fixes.cov[..., :3, :3]
    return {f"axis_{letter}": towards[..., k] for k, letter in enumerate("xyz")} | {
        "axis_sigma_deg": np.rad2deg(axis_sigma(fixes)),
        "position_sigma_m": np.sqrt(np.trace(place, axis1=-2, axis2=-1) / 3.0),
        "gain": gain,
    }


def _figures(fixes: Fixes, estimate: CoilFixes, *, signed: bool) -> Figures:
    """Return the figures of the fixes: what one axis determines, and what it does not."""
    columns = _columns(estimate)
    sigma = float(np.median(columns["position_sigma_m"][:, 0]))
    across = float(np.median(columns["axis_sigma_deg"][:, 0]))
    share = fixes.probability
    rivals = int(np.sum(share[:, 1] > 0.05)) if share.shape[1] > 1 else 0
    determined = ["position", "direction of the axis", *(["its sign"] if signed else [])]
    undetermined = ["roll about the axis", *([] if signed else ["sign of the axis"])]
    row = (
        "position_sigma_median_m",
        sigma,
        "m",
        None,
        Section.ERRORS,
        "position",
        ErrorColumn.SIGMA,
    )
    tilt = ("axis_sigma_median_deg", across, "deg", None, Section.ERRORS, "axis", ErrorColumn.SIGMA)
    return Figures(
        Figure("epochs", len(fixes)),
        where_found("ambiguous_epochs", rivals > 0, rivals),
        where_found("undetermined_epochs", False, int(np.sum(~estimate.determined[:, 0]))),
        Figure("residual_rms_median", float(np.median(fixes.residual_rms[:, 0]))),
        Figure(*row),
        Figure(*tilt),
        Figure("determined", determined, section=Section.REPORT),
        Figure("undetermined", undetermined, section=Section.REPORT),
        Figure("gain_median", float(np.median(columns["gain"][:, 0]))),
    )
