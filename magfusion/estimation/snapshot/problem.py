"""Input of a fix: the weighted phasors of many epochs, and other information."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from magfusion.errors import EstimationError
from magfusion.estimation.snapshot.fix import Gravity
from magfusion.model.noise import measurement_cov, sensors_at, stacked, whitening
from magfusion.model.parameters import GAIN, PHASE, Block, Calibration, placed
from magfusion.model.samples import FieldSamples
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.units import Array, BoolArray, IntArray

ESTIMABLE = ("phase", "gain")  # parameters that may be estimated with the pose, whatever the site
GAIN_SIGMA = 0.2  # of a log-gain; smooth errors of real installations (paper 004, Table 1)
CHUNK = 1000  # epochs solved at once: they fit into the cache
Chosen = IntArray | BoolArray | slice


class PosePrior(NamedTuple):
    """Prior of the body's pose."""

    rotation: Array  # (m, 3, 3) world_from_body
    position: Array  # (m, 3)
    sqrt_information: Array | None  # (m, 6, 6) whitening; None if it is only a candidate

    def rows(self, chosen: Chosen) -> "PosePrior":
        """Return selected rows, possibly repeated."""
        sqrt_information = None if self.sqrt_information is None else self.sqrt_information[chosen]
        return PosePrior(self.rotation[chosen], self.position[chosen], sqrt_information)


class CycleMotion(NamedTuple):
    """Displacement of a platform until each channel of a cycle is measured."""

    shift_world: Array  # (m, channels, 3) (m)
    spread: Array  # (m, channels); one sigma of it along each axis, fully correlated (m)

    def rows(self, chosen: Chosen) -> "CycleMotion":
        """Return selected rows, possibly repeated."""
        return CycleMotion(self.shift_world[chosen], self.spread[chosen])


def _prior(prior: Trajectory) -> PosePrior:
    cov = prior.pose_cov
    sqrt_information = None if cov is None else np.linalg.inv(np.linalg.cholesky(cov))
    return PosePrior(prior.world_from_body, prior.position_world, sqrt_information)


class FixState(NamedTuple):
    """Estimated quantities of each row."""

    rotation: Array  # (m, 3, 3) world_from_body
    position: Array  # (m, 3)
    phase: Array  # (m, channels), beyond the calibration's
    log_gain: Array  # (m, channels), beyond the calibration's

    def rows(self, chosen: IntArray | BoolArray) -> "FixState":
        """Return a subset of the rows."""
        return FixState(*(part[chosen] for part in self))


@dataclass(frozen=True, eq=False)
class FixProblem:
    """Phasors with their weights, and other information; a row for each pose to estimate."""

    calibration: Calibration
    time: Array  # (m,)
    measured: Array  # (m, channels, 6), real parts, then imaginary parts (T)
    sqrt_information: Array  # (m, channels, 3, 3), whitening (1/T); zero where a channel is missing
    # (m, channels, 3, 3), covariance of the whitened noise, if the whitening includes more than
    # noise
    noise: Array | None
    blocks: tuple[Block, ...]  # nuisances estimated with the pose
    gravity: Gravity | None
    prior: PosePrior | None  # poses with their whitening
    # (m, channels, 3, 3), as of `magfusion.model.samples.FieldSamples`
    channel_rotation: Array | None = None
    motion: CycleMotion | None = None  # if channels are measured in turn by a moving platform

    def rows(self, chosen: Chosen) -> "FixProblem":
        """Return selected rows, possibly repeated."""
        return replace(
            self,
            time=self.time[chosen],
            measured=self.measured[chosen],
            sqrt_information=self.sqrt_information[chosen],
            noise=None if self.noise is None else self.noise[chosen],
            gravity=None if self.gravity is None else self.gravity.rows(chosen),
            prior=None if self.prior is None else self.prior.rows(chosen),
            channel_rotation=None
            if self.channel_rotation is None
            else self.channel_rotation[chosen],
            motion=None if self.motion is None else self.motion.rows(chosen),
        )

    @property
    def residuals(self) -> int:
        """Number of residuals of each row."""
        gains = sum(block.parameter == GAIN for block in self.blocks)
        informed = self.prior is not None and self.prior.sqrt_information is not None
        return (
            6 * int(self.sqrt_information.shape[1])
            + 3 * (self.gravity is not None)
            + 6 * informed
            + gains
        )

    def start(self, rotation: Array, position: Array, phase: Array | None = None) -> FixState:
        """Return the state at given poses."""
        none = np.zeros((len(position), self.sqrt_information.shape[1]))
        return FixState(rotation, position, none if phase is None else phase, none)

    def at(self, state: FixState) -> Calibration:
        """Return the calibration with each row's own phases and gains."""
        known = self.calibration
        return replace(
            known, phase=known.phase + state.phase, log_gain=known.log_gain + state.log_gain
        )


class FixEpochs(NamedTuple):
    """A row for each epoch, and the inputs of its weights."""

    problem: FixProblem
    samples: FieldSamples
    survey_error: bool

    def rows(self, chosen: Chosen) -> "FixEpochs":
        """Return a subset of the epochs."""
        return FixEpochs(self.problem.rows(chosen), self.samples.rows(chosen), self.survey_error)

    def reweighed(self, rotation: Array, position: Array) -> FixProblem | None:
        """Return the problem weighted at poses (n, ...); None if weights do not depend on them.

        The uncertainty of a field map depends on position, as does the magnitude of a field of
        which only some components were measured.
        """
        site = self.problem.calibration.site
        mapped = any(beacon.field_map is not None for beacon in site.beacons)
        if not mapped and not np.any(self.samples.partial):
            return None
        sensor_world = sensors_at(site, rotation, position)
        sqrt_information, noise = _weights(site, self.samples, self.survey_error, sensor_world)
        return replace(self.problem, sqrt_information=sqrt_information, noise=noise)


def nuisance_blocks(site: Site, gain_sigma: float | None = None) -> tuple[Block, ...]:
    """Return the columns of the nuisances estimated with the pose.

    `site`: the drive phases of its beacons that are not synchronised come first. `gain_sigma`:
    prior of a log-gain of each beacon; None if gains are known.
    """
    blocks = [
        Block(PHASE, beacon.name, slice(0), np.full(len(beacon.tones), np.inf))
        for beacon in site.beacons
        if not beacon.synchronised
    ]
    if gain_sigma is not None:
        sigma = np.array([gain_sigma])
        blocks += [Block(GAIN, beacon.name, slice(0), sigma) for beacon in site.beacons]
    return placed(blocks)


def epochs_of(
    samples: FieldSamples,
    calibration: Calibration,
    *,
    gravity: Gravity | None,
    prior: Trajectory | None,
    survey_error: bool,
    free_parameters: tuple[str, ...],
    gain_sigma: float,
) -> Iterator[FixEpochs]:
    """Yield the weighted epochs of a log in chunks.

    Raises EstimationError where there is no epoch.
    """
    if len(samples) == 0:
        raise EstimationError("no epoch to fix: every window was dropped")
    if not set(free_parameters) <= set(ESTIMABLE):
        raise ValueError(
            f"free must be among {ESTIMABLE}; got {sorted(set(free_parameters) - set(ESTIMABLE))}"
        )
    if "phase" in free_parameters or not samples.signed:  # an unknown sign is an unknown phase
        site = calibration.site
        loose = tuple(replace(b, synchronised=False) for b in site.beacons)
        calibration = replace(calibration, site=replace(site, beacons=loose))
    blocks = nuisance_blocks(calibration.site, gain_sigma if "gain" in free_parameters else None)
    known = None if prior is None else _prior(prior)
    for start in range(0, len(samples), CHUNK):
        rows = slice(start, start + CHUNK)
        some = samples.rows(rows)
        sqrt_information, noise = _weights(calibration.site, some, survey_error, None)
        problem = FixProblem(
            calibration=calibration,
            time=some.time,
            measured=stacked(some.phasor_sensor),
            sqrt_information=sqrt_information,
            noise=noise,
            blocks=blocks,
            gravity=None if gravity is None else gravity.rows(rows),
            prior=None if known is None else known.rows(rows),
            channel_rotation=some.channel_rotation,
        )
        yield FixEpochs(problem, some, survey_error)


def _weights(
    site: Site, samples: FieldSamples, survey_error: bool, sensor_world: Array | None
) -> tuple[Array, Array | None]:
    """Return the whitening, and the covariance of the whitened noise if the two differ."""
    there = samples.there
    known = measurement_cov(site, samples, sensor_world=sensor_world)
    if not survey_error:
        return whitening(known, there), None
    cov = measurement_cov(site, samples, survey_error=True, sensor_world=sensor_world)
    sqrt_information = whitening(cov, there)
    noise = np.where(samples.valid[..., None, None], known, 0.0)
    return sqrt_information, sqrt_information @ noise @ np.swapaxes(sqrt_information, -1, -2)
