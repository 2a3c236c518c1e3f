"""Test for steel: a distortion of space that all beacons share, in place of other causes.

Its amplitudes have the prior of `magfusion.estimation.measurements.steel`, so that its evidence is
on the scale of `ReleaseGain.gain`: the decrease of -2 log likelihood, marginalised over amplitudes.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.special import logsumexp

from magfusion.estimation.batch.batch import Smoothed
from magfusion.estimation.integrity.fault_candidates import fault_candidates
from magfusion.estimation.integrity.fixed_parameter_test import MARGIN, MIN_EVIDENCE
from magfusion.estimation.integrity.hypothesis_tests import world_model_error
from magfusion.estimation.integrity.released_fault import release_gain
from magfusion.estimation.integrity.score import Score, answered, scores_of
from magfusion.estimation.integrity.test_result import Case, TestResult
from magfusion.estimation.measurements.joint_phasors import JointPhasors
from magfusion.estimation.measurements.steel import (
    UNIT,
    SteelBasis,
    SteelModes,
    along_path,
    region_modes,
    steel_modes,
)
from magfusion.estimation.posterior.noise_tuning import as_declared, tuned_site
from magfusion.files.site_changes import changed_keys
from magfusion.model.parameters import Block, dimension, placed
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.model.trust import Finding, Verdict
from magfusion.model.without_imu import logged
from magfusion.units import Array, BoolArray

STEEL = "steel"  # code
# Relative distortion in units of `UNIT`, of shared modes and of those of each tone.
SIZES = (0.0, 0.125, 0.25, 0.5, 1.0, 2.0, 4.0)
NO_SIZE = 1e-6
DRAWS = 64  # of the amplitudes, for the place of the strongest steel
FAR = 1.5  # m; a place less certain than this is not given
ROUNDED_UP = (1.0, 2.0, 3.0, 5.0, 10.0)  # steps of the remedy


class SteelEstimate(NamedTuple):
    """Steel that explains a log."""

    distortion: float  # of the fields, relative, rms over beacons and path
    place_world: Array  # (3,), of the strongest steel (m)
    place_sigma: float  # (m)
    gain: float  # decrease of -2 log likelihood, marginalised over amplitudes and size
    spread: Array  # (states, 6, 6), second moment of the effect on the poses, given the residuals

    def described(self, site: Site) -> str:
        """Return a sentence on the steel."""
        where, declared = "near the path", 100.0 * site.model_error
        if self.place_sigma < FAR:
            x, y, z = self.place_world
            where = f"near ({x:.1f}, {y:.1f}, {z:.1f}) m, ± {self.place_sigma:.1f} m,"
        return (
            f"Steel {where} distorts the fields of all beacons by about"
            f" {100.0 * self.distortion:.2g} % along the path (declared {declared:.2g} %)."
        )

    @property
    def weight(self) -> float:
        """Weight of its finding: the evidence in sigma."""
        return float(np.sqrt(max(self.gain, 0.0)))

    def finding(self, site: Site, *, mapped: bool = False) -> Finding:
        """Return the finding: a remark where the site declares so much.

        Without the advice to map it where it was ``mapped``.
        """
        text = self.described(site)
        if self.distortion <= site.model_error:
            text += " The covariance includes its effect."
            return Finding(STEEL, text, Verdict.TRUSTWORTHY, self.weight)
        needed = _rounded_up(self.distortion)
        new = site.without_steel() is site
        again = "Map it" if new else "The map of the site does not explain it: map it again"
        text += (
            " No error of single parameters explains the log as well."
            f" {'Map' if mapped else f'{again} (magfusion smooth --map-steel), map'} the field"
            f" (magfusion calibrate fieldmap), or declare {world_model_error(site, needed)}."
        )
        beacons = tuple(replace(beacon, model_error=None) for beacon in site.beacons)
        remedy = changed_keys(site, replace(site, model_error=needed, beacons=beacons))
        return Finding(STEEL, text, Verdict.DOUBTFUL, self.weight, remedy=remedy)


def steel(case: Case, rival: float, *, doubted: bool = False) -> TestResult | None:
    """Test for steel; None if it does not explain a log better than other causes.

    `rival`: gain of the causes that are named. `doubted`: whether it is tested even where no
    parameter would explain anything.
    """
    rival = max(rival, _best_parameter(case))
    if rival < MIN_EVIDENCE and not doubted:
        return None
    if case.in_region is None:
        estimate = estimate_steel(case, rival)
    else:
        estimate = steel_of_score(case.in_region, rival)
    if estimate is None:
        return None
    finding = estimate.finding(declared_site(case.result))
    return TestResult((finding,), spread=estimate.spread, gain=estimate.gain)


def declared_site(result: Smoothed) -> Site:
    """Return the site without the noise that was estimated for its beacons."""
    site = tuned_site(result.declared.site, as_declared(result.noise))
    beacons = (
        replace(beacon, model_error=None) if beacon.model_error == site.model_error else beacon
        for beacon in site.beacons
    )
    return replace(site, beacons=tuple(beacons))


def _best_parameter(case: Case) -> float:
    """Return the gain of the fixed parameter that explains most, mistake or not."""
    if case.score is None:
        return 0.0
    declared = case.score.with_declared(tolerance=False)
    every = fault_candidates(case.result.declared.site, case.score.fixed)
    return max(
        (one.gain for fault in every if (one := release_gain(fault, *declared))), default=0.0
    )


def steel_explains(result: Smoothed, log: Log, rival: float) -> bool:
    """Return whether steel explains a log better than a rival cause of a known gain."""
    cov, (log, _) = result.states.pose_cov, logged(log, result.declared.site)
    return cov is not None and steel(Case(result, log, None, cov), rival) is not None


def estimate_steel(case: Case, rival: float) -> SteelEstimate | None:
    """Return the steel that explains a log; None if not better than a rival cause of a gain."""
    result = case.result
    if has_close_tones(result):
        return None
    poses = poses_of_fields(result)
    modes = steel_modes(result.calibration.site, poses.time, poses)
    scores = scores_of(result, case.log.imu, modes) if modes else None
    known = None if scores is None else best_explanation(scores.every, rival)
    if scores is None or known is None:
        return None
    score = answered(result, scores.every, case.log.imu)
    return estimated_steel(score, *known, distortion_of(known[1]))


def score_with_steel(score: Score | None, result: Smoothed, log: Log, site: Site) -> Score | None:
    """Return a score with the `region_modes` of a site, as continued online; None without any."""
    modes = region_modes(site)
    if score is None or not modes or result.calibration.site.channels != site.channels:
        return None
    if has_close_tones(result):
        return _without_evidence(score, modes)
    poses, parameter = poses_of_fields(result), modes[-1].parameter
    assert isinstance(parameter, SteelModes)
    here = along_path(parameter.basis, result.calibration.site, poses.time, poses)
    scores = scores_of(result, log.imu, here, responses=True)
    if scores is None:
        return None
    return replace(scores.every, fixed=placed((*score.fixed, *modes)))


def has_close_tones(result: Smoothed) -> bool:
    """Return whether samples of short windows are not at the epochs, where the modes are."""
    return any(isinstance(m, JointPhasors) for m in result.graph.measurements)


def _without_evidence(score: Score, more: tuple[Block, ...]) -> Score:
    """Return a score with more parameters, which affect nothing."""
    fixed = placed((*score.fixed, *more))
    last = (0, dimension(fixed) - dimension(score.fixed))
    return Score(
        fixed,
        np.pad(score.information, (last, last)),
        np.pad(score.gradient, last),
        np.pad(score.spread, (last, (0, 0))),
        np.pad(score.by_state, ((0, 0), (0, 0), last)),
        np.pad(score.by_calibration, ((0, 0), last)),
    )


def steel_of_score(score: Score, rival: float) -> SteelEstimate | None:
    """Return the steel of a score's last block of `SteelModes`, with the effect on its poses.

    None if it does not explain the data better than a rival cause of a known gain.
    """
    known = best_explanation(score, rival)
    return None if known is None else estimated_steel(score, *known, distortion_of(known[1]))


def best_explanation(score: Score, rival: float) -> tuple[float, Array] | None:
    """Return gain and sigmas of the amplitudes of steel; None if a rival cause is as good."""
    block = block_of(score)
    shared = np.arange(len(block.sigma)) < basis_of(score).shared
    gain, sigma = best_size(*amplitude_evidence(score), shared)
    if gain < max(rival + MARGIN, MIN_EVIDENCE) or np.max(sigma) >= SIZES[-1]:
        return None  # the largest size stands for gross mistakes that no mode explains
    return gain, sigma


def block_of(score: Score) -> Block:
    """Return the last block of steel's amplitudes."""
    return next(b for b in reversed(score.fixed) if isinstance(b.parameter, SteelModes))


def basis_of(score: Score) -> SteelBasis:
    """Return the modes of that block."""
    parameter = block_of(score).parameter
    assert isinstance(parameter, SteelModes)
    return parameter.basis


def poses_of_fields(result: Smoothed) -> Trajectory:
    """Return the poses at the fields."""
    return result.states.rows(result.epoch)


def best_size(information: Array, gradient: Array, shared: BoolArray) -> tuple[float, Array]:
    """Return the gain, averaged over sizes of the distortion, and the most probable sigmas.

    `information`, `gradient` (k, k), (k,): of amplitudes. `shared` (k,): which are shared by all
    beacons.
    """
    sizes = [(a, b) for a in SIZES for b in SIZES if a or b]
    sigmas = [np.where(shared, *(max(s, NO_SIZE) for s in pair)) for pair in sizes]
    gains = np.array([_gain(information, gradient, sigma) for sigma in sigmas])
    mean = 2.0 * (logsumexp(0.5 * gains) - np.log(len(gains)))
    return float(mean), sigmas[int(np.argmax(gains))]


def _gain(information: Array, gradient: Array, sigma: Array) -> float:
    inner = np.eye(len(sigma)) + sigma[:, None] * information * sigma
    root = np.linalg.cholesky(inner)
    half = np.linalg.solve(root, sigma * gradient)
    return float(half @ half - 2.0 * np.sum(np.log(np.diagonal(root))))


def amplitude_evidence(score: Score) -> tuple[Array, Array]:
    """Return information and gradient of the amplitudes of steel, others varying as declared."""
    own = block_of(score).columns
    information, gradient = score.with_declared(tolerance=False)
    return information[own, own], gradient[own]


def distortion_of(sigma: Array) -> float:
    """Return the relative distortion, rms, by the sigmas of `best_explanation`."""
    return UNIT * float(np.hypot(sigma[0], sigma[-1]))


def estimated_steel(score: Score, gain: float, sigma: Array, distortion: float) -> SteelEstimate:
    """Return the steel of a score with the responses of the poses to it."""
    mean, cov = amplitudes(score, sigma)
    by_pose = score.by_pose[..., block_of(score).columns]
    moved = by_pose @ mean
    spread = moved[:, :, None] * moved[:, None, :] + by_pose @ cov @ np.swapaxes(by_pose, 1, 2)
    place, place_sigma = _strongest(basis_of(score), mean, cov)
    return SteelEstimate(distortion, place, place_sigma, gain, spread)


def amplitudes(score: Score, sigma: Array) -> tuple[Array, Array]:
    """Return mean and covariance of the amplitudes of steel, given their sigmas before."""
    information, gradient = amplitude_evidence(score)
    inner = np.eye(len(sigma)) + sigma[:, None] * information * sigma
    cov = sigma[:, None] * np.linalg.inv(inner) * sigma
    return cov @ gradient, cov


def _strongest(modes: SteelBasis, mean: Array, cov: Array) -> tuple[Array, float]:
    """Return the place of the largest polarisability over draws of amplitudes, and its sigma."""
    root = np.linalg.cholesky(cov + 1e-12 * np.eye(len(cov)))
    noise = np.random.default_rng(0).standard_normal((len(mean), DRAWS))
    each = np.abs(modes.polarisability @ (mean[:, None] + root @ noise))
    strength = np.sqrt(np.mean(np.sum(each**2, axis=2), axis=1))  # (v, draws)
    strongest = np.argmax(strength, axis=0)
    places, edge = modes.voxels.centre_world[strongest], modes.voxels.edge[strongest]
    place = np.mean(places, axis=0)
    # Anywhere in a cube, three components have a variance of a quarter of its edge squared.
    variance = np.mean(np.sum((places - place) ** 2, axis=1) + 0.25 * edge**2)
    return place, float(np.sqrt(variance))


def _rounded_up(value: float) -> float:
    """Return the next of 1, 2, 3, 5 times a power of ten."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(power * next(step for step in ROUNDED_UP if step * power >= value * 0.999))
