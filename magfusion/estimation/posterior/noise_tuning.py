"""Noise tuning: estimation of the noise from the residuals of a pass.

For each beacon its noise and its model error, and the densities of gyro and accelerometer, each
with its declared value as a prior of a factor of two.  An estimate absorbs part of every error; the
part that remains in the residuals is determined by drawing errors of the declared kind and solving
the estimate's linear system for them (variance component estimation by Monte Carlo, K.-R. Koch and
J. Kusche, J. Geodesy 76, 2002).  Faults are covered first: a Student distribution of few degrees of
freedom limits the effect of temporary faults on the noise of the rest.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from magfusion.estimation.graph.graph import Graph, GraphEstimate
from magfusion.estimation.posterior.residual_redundancy import ChannelErrors, ResidualProjection
from magfusion.estimation.posterior.variance_components import (
    BeaconErrors,
    maximize_likelihood,
    parts_of,
)
from magfusion.model.parameters import Block, Calibration
from magfusion.model.samples import FieldSamples
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.units import Array, BoolArray

CONVERGED_STEP = 0.05  # of a logarithm; a smaller change is negligible
GYRO, ACCEL = slice(0, 3), slice(6, 9)  # rows of an inertial factor that each determines
FAULT = 3.0  # times a declared model error; more is no error of that kind, and not covered by it
OF_IMU = ("gyro_noise", "accel_noise")  # a beacon may be called "imu", too
# Keys of a motion prior and of the IMU field they replace; the rate is in the rows of the bias.
OF_MOTION = {"angular_accel_density": "gyro_bias_walk", "accel_density": "accel_noise"}
WALK = slice(12, 15)
PLAUSIBLE = 6.0  # by a larger factor, either way, white noise is a fault
DRAWN_EPOCHS = 2048  # of drawn errors; of few, their own noise is in the tuned noise
MAX_DRAWS = 16
MIN_REMAINING = 1e-3  # of an error; a smaller remainder is not informative


@dataclass(frozen=True)
class Tuned:
    """One standard deviation of the noise, declared and estimated."""

    owner: str  # beacon, "imu" or "motion_prior"
    key: str  # noise_factor, model_error, gyro_noise, accel_noise, or of `OF_MOTION`
    # declared, estimated: in the unit of the site's file
    declared: float
    estimated: float

    @property
    def factor(self) -> float:
        """Estimated over declared."""
        return self.estimated / self.declared


def tuned_site(site: Site, tuned: Sequence[Tuned]) -> Site:
    """Return a site with the estimated noise."""
    of_imu: dict[str, Any] = {t.key: t.estimated for t in tuned if t.key in OF_IMU}
    of_imu |= {OF_MOTION[t.key]: t.estimated for t in tuned if t.key in OF_MOTION}
    platform = replace(site.platform, imu=replace(site.platform.imu, **of_imu))
    beacons = []
    for beacon in site.beacons:
        named = (t for t in tuned if t.owner == beacon.name and t.key not in (*OF_IMU, *OF_MOTION))
        own: dict[str, Any] = {t.key: t.estimated for t in named}
        beacons.append(replace(beacon, **own))
    return replace(site, platform=platform, beacons=tuple(beacons))


def with_noise(calibration: Calibration, tuned: Sequence[Tuned]) -> Calibration:
    """Return a calibration whose site has the estimated noise."""
    return replace(calibration, site=tuned_site(calibration.site, tuned))


def plausible(tuned: Sequence[Tuned]) -> bool:
    """Return whether the estimates are plausible noise, and hide no fault."""
    white = [t.factor for t in tuned if t.key != "model_error" and t.key not in OF_MOTION]
    return all(1.0 / PLAUSIBLE < factor < PLAUSIBLE for factor in white)


def as_declared(tuned: Sequence[Tuned]) -> tuple[Tuned, ...]:
    """Return the noise with its declared values."""
    return tuple(replace(t, estimated=t.declared) for t in tuned)


def compared_with(tuned: Sequence[Tuned], declared: Site, used: Site) -> tuple[Tuned, ...]:
    """Return the noise with that of the IMU compared with what the user declares.

    `used`: the site of the first pass, whose noise of the IMU may be that of the samples; what is
    not tuned keeps it.
    """
    imu, own = declared.platform.imu, used.platform.imu
    known = {t.key for t in tuned}
    kept = [key for key in OF_IMU if key not in known and getattr(own, key) != getattr(imu, key)]
    return (
        *(replace(t, declared=float(getattr(imu, t.key))) if t.key in OF_IMU else t for t in tuned),
        *(Tuned("imu", key, float(getattr(imu, key)), float(getattr(own, key))) for key in kept),
    )


def has_converged(before: Sequence[Tuned], after: Sequence[Tuned]) -> bool:
    """Return whether two tunings differ by a negligible amount."""
    old = {(t.owner, t.key): t.estimated for t in before}
    return all(
        abs(np.log(t.estimated / old.get((t.owner, t.key), t.declared))) < CONVERGED_STEP
        for t in after
    )


def tune(
    graph: Graph,
    estimate: GraphEstimate,
    samples: FieldSamples,
    poses: Trajectory,
    declared: Site,
    windows: float,
    shared_by: Array,
    blind: BoolArray | None = None,
    considered: tuple[Block, ...] = (),
) -> tuple[Tuned, ...]:
    """Return the most probable noise for the residuals of a solved graph.

    Parameters
    ----------
    samples : FieldSamples
        As measured in the graph.
    poses : Trajectory
        At the samples.
    declared : Site
        Whose noise is the prior.
    windows : float
        Number of windows that contain each sample.
    shared_by : ndarray, shape (n,)
        Number of epochs with the same model error.
    blind : bool ndarray, shape (n,), optional
        Epochs with other noise: of a motion estimated without an IMU.
    considered : tuple of Block
        Parameters that are not estimated: the effect of their errors on residuals is no noise.
    """
    draws = int(np.clip(DRAWN_EPOCHS // len(samples), 1, MAX_DRAWS))
    system = ResidualProjection(graph, estimate, samples, poses, windows, considered, draws=draws)
    now = estimate.calibration.site
    lag = max(1, round(windows))
    prior = declared.beacons
    errors = [_errors_of(system, i, now, declared, blind) for i in range(len(now.beacons))]
    result = parts_of(errors, shared_by, lag)
    parts = {i: part for i, part in enumerate(result) if part is not None}
    modelled = [part for part in parts.values() if part.model is not None]
    less, smooth = 1.0, 0.0
    if modelled:
        # Rare large errors have little weight, so that those of a whole log seem too small.
        less = float(np.exp(np.mean(np.log([part.accepted_factor for part in modelled]))))
        smooth = float(np.mean([part.smooth for part in modelled]))
    out: list[Tuned] = []
    for i, part in parts.items():
        name, (noise, usual) = prior[i].name, part.sizes
        # Poses without an IMU follow smooth errors and, from pass to pass, the noise of windows.
        least = 0.0 if declared.platform.inertial else 1.0
        out.append(Tuned(name, "noise_factor", noise, max(part.white, least) * noise))
        if part.model is not None:
            factor = min(part.model / min(less, 1.0), FAULT)  # faults come first
            out.append(Tuned(name, "model_error", usual, max(factor, least) * usual))
    return (*out, *_tuned_imu(system, now, declared, smooth))


def _errors_of(
    system: ResidualProjection, beacon: int, now: Site, declared: Site, blind: BoolArray | None
) -> BeaconErrors:
    """Return the errors of a beacon, with the noise that the sites declare and have now."""
    prior = declared.beacons[beacon]
    usual = declared.model_error if prior.model_error is None else prior.model_error
    mapped = now.beacons[beacon].field_map is not None
    channels = [_without(channel, blind) for channel in system.channels_of(beacon)]
    return BeaconErrors(channels, (prior.noise_factor, usual), bent=not mapped and usual > 0.0)


def _without(own: ChannelErrors, blind: BoolArray | None) -> ChannelErrors:
    if blind is None:
        return own
    kept = ~blind[own.epoch]
    noise, rough, smooth, inertial = (part[kept] for part in own.residuals)
    variance = own.variance[0][kept], own.variance[1][kept]
    residual = noise, rough, smooth, inertial
    return replace(
        own, epoch=own.epoch[kept], seen=own.seen[kept], residuals=residual, variance=variance
    )


def _tuned_imu(system: ResidualProjection, now: Site, declared: Site, smooth: float) -> list[Tuned]:
    """Return the densities of gyro and accelerometer.

    `smooth`: share of the model error's variance that is smooth.
    """
    plain = system.inertial()
    result = []
    owner, of_turn, names = "imu", GYRO, {name: name for name in OF_IMU}
    if not declared.platform.inertial:
        owner, of_turn, names = "motion_prior", WALK, OF_MOTION
    for (name, key), rows in zip(names.items(), (of_turn, ACCEL), strict=True):
        scale = system.sigma[:, rows]
        square, noise, *model, own = (np.sum((p[:, rows] / scale) ** 2, axis=1) for p in plain)
        bent = (1.0 - smooth) * model[0] + smooth * model[1]
        before, usual = getattr(declared.platform.imu, key), getattr(now.platform.imu, key)
        here = system.ordinary
        every = [float(np.mean(p[here])) / 3.0 for p in (noise, bent, own)]
        if not np.any(here) or every[2] < MIN_REMAINING:
            continue
        count = int(np.sum(here))
        known = np.full((1, 1, count), every[2] * (before / usual) ** 2)
        fixed = np.full((1, count), every[0] + every[1])
        # Successive residuals are correlated.
        weight = np.full((1, count), min(1.0, (every[2] + fixed[0, 0]) ** 2 / every[2]))
        log = maximize_likelihood(square[here][None], known, fixed, weight, 3)[0]
        # Declared values below these include scale and vibration too, which are not white.
        result.append(Tuned(owner, name, before, float(before * np.exp(max(log[0], 0.0)))))
    return result
