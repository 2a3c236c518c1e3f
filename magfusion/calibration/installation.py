"""Test of an installation by fields at known marks and check distances, beacon by beacon.

Each beacon in turn is released: its position, axis, moment and polarity.  If the fields contradict
its declaration, it is the one whose release explains them best; the others are tested again with
it as found.  W. Baarda, A Testing Procedure for Use in Geodetic Networks (1968): a check proves as
much as the smallest displacement that it detects.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from magfusion.calibration.marked_snapshots import MarkedSnapshots
from magfusion.estimation.integrity.field_snapshots import (
    OF_SURVEY,
    JointEstimate,
    is_significant,
    wide_blocks,
)
from magfusion.model.parameters import (
    BEACON_POSITION,
    BEACON_ROTATION,
    LOG_MOMENT,
    Block,
    Parameter,
    choose_blocks,
    placed,
)
from magfusion.model.site import Beacon, Site
from magfusion.units import DEGREE, Array

WIDE = ((BEACON_POSITION, 1.0), (BEACON_ROTATION, 0.5), (LOG_MOMENT, 1.5))  # sigmas: m, rad, 1
DETECTABLE = 4.13  # sigmas: Baarda's smallest detectable error, at 0.1 % false alarms, 80 % power
CONTRADICTED = 4.0  # sigmas of a single quantity, from which it is named


@dataclass(frozen=True, eq=False)
class BeaconCheck:
    """What the measurements prove of one beacon."""

    name: str
    marks: int  # number of marks at which it is detected
    # step_world, step_sigma: (3,), its position less the declared one (m)
    step_world: Array
    step_sigma: Array
    # angle, angle_sigma: rotation from its declared attitude (rad), and the largest sigma
    angle: float
    angle_sigma: float
    # factor, factor_sigma: its moment over the declared one, negative if its coils are reversed
    factor: float
    factor_sigma: float
    contradicted: bool = False  # whether its declaration does not explain the measurements
    # of ``reversed``, ``moment``, ``position`` and ``axis``, largest first, if contradicted
    faults: tuple[str, ...] = ()

    @property
    def detectable(self) -> float:
        """Smallest displacement that the measurements detect (m)."""
        return DETECTABLE * float(np.max(self.step_sigma))


@dataclass(frozen=True, eq=False)
class InstallationCheck:
    """Result of a check of all beacons."""

    beacons: tuple[BeaconCheck, ...]  # in the order of the site
    # chi_square, freedom: with all wrong beacons as found
    chi_square: float
    freedom: float
    site: Site  # with these beacons as found


@dataclass(frozen=True, eq=False)
class _Released:
    """A fit with one beacon released."""

    name: str
    polarity: float
    cost: float
    estimate: JointEstimate
    information: Array
    blocks: tuple[Block, ...]


def check_installation(marked: MarkedSnapshots) -> InstallationCheck:
    """Test each beacon of a site by fields at known marks and check distances."""
    declared = marked
    released: tuple[str, ...] = ()
    poses = marked.initial_poses()
    sizes = sum(len(p.sigma(marked.site, marked.site.beacons[0].name)) for p, _ in WIDE)
    freedom = marked.freedom + 3.0 * len(marked.samples) + len(marked.distances)
    named: dict[str, BeaconCheck] = {}
    while True:
        before = marked.minimised(_joint(marked.site, released), *poses)[0]
        fits = {
            beacon.name: _released(marked, beacon, released, poses)
            for beacon in marked.site.beacons
            if beacon.name not in named
        }
        worst = min(fits.values(), key=lambda fit: fit.cost, default=None)
        tests = len(declared.site.beacons)
        if worst is None or not is_significant(before, worst.cost, sizes, freedom, tests):
            break
        check = _check_of(declared, worst)
        named[worst.name] = replace(check, contradicted=True, faults=_faults(declared, check))
        refined = worst.estimate.calibration
        # Other beacons stay as declared: only what was released has moved for good.
        others = {b.name: b for b in declared.site.beacons if b.name not in named}
        beacons = tuple(others.get(b.name, b) for b in refined.site.beacons)
        site = replace(declared.site, beacons=beacons)
        marked = replace(marked, calibration=replace(refined, site=site))
        released = (*released, worst.name)
        poses = worst.estimate.turn, worst.estimate.place
    every = named | {name: _check_of(declared, fit) for name, fit in fits.items()}
    return InstallationCheck(
        tuple(every[beacon.name] for beacon in declared.site.beacons), before, freedom, marked.site
    )


def _joint(site: Site, wide: tuple[str, ...]) -> tuple[Block, ...]:
    """Return the blocks of a survey with its sigmas, some beacons released."""
    own = list(wide_blocks(site, [(p, name, s) for name in wide for p, s in WIDE]))
    keys = {block.key for block in own}
    survey = (b for b in choose_blocks(site, (*OF_SURVEY, "phase")) if b.key not in keys)
    return placed([*survey, *own])


def _released(
    marked: MarkedSnapshots, beacon: Beacon, others: tuple[str, ...], poses: tuple[Array, Array]
) -> _Released:
    number = [b.name for b in marked.site.beacons].index(beacon.name)
    is_reversed = beacon.synchronised and marked.gains(*poses)[number] < 0.0
    site = _reversed(marked.site, beacon.name) if is_reversed else marked.site
    blocks = _joint(site, (*others, beacon.name))
    cost, estimate, information = marked.of(site).minimised(blocks, *poses)
    polarity = -1.0 if is_reversed else 1.0
    return _Released(beacon.name, polarity, cost, estimate, information, blocks)


def _check_of(declared: MarkedSnapshots, fit: _Released) -> BeaconCheck:
    # Parameters have priors; the pose of a stop that no field determines has none, and no part.
    cov = np.linalg.pinv(fit.information, hermitian=True)
    start = 6 * len(fit.estimate.turn)
    refined = fit.estimate.calibration

    def of(parameter: Parameter) -> tuple[Array, Array]:
        block = next(b for b in fit.blocks if b.parameter == parameter and b.owner == fit.name)
        rows = np.arange(block.columns.start, block.columns.stop) + start
        sigma = np.sqrt(np.diagonal(cov)[rows])
        before = declared.calibration
        if fit.polarity < 0.0 and parameter == LOG_MOMENT:
            before = declared.of(_reversed(before.site, fit.name)).calibration
        return parameter.difference(before, refined, fit.name), sigma

    step, step_sigma = of(BEACON_POSITION)
    rotation, rotation_sigma = of(BEACON_ROTATION)
    log_moment, log_sigma = of(LOG_MOMENT)
    number = [b.name for b in declared.site.beacons].index(fit.name)
    factor = float(np.exp(np.mean(log_moment)))
    return BeaconCheck(
        fit.name,
        int(declared.detected()[number]),
        step,
        step_sigma,
        float(np.linalg.norm(rotation)),
        float(np.max(rotation_sigma)),
        fit.polarity * factor,
        factor * float(np.max(log_sigma)),
    )


def _reversed(site: Site, name: str) -> Site:
    beacons = tuple(
        replace(b, coils=tuple(replace(c, moment_beacon=-c.moment_beacon) for c in b.coils))
        if b.name == name
        else b
        for b in site.beacons
    )
    return replace(site, beacons=beacons)


def _faults(declared: MarkedSnapshots, check: BeaconCheck) -> tuple[str, ...]:
    """Return what differs from the declaration, the most certain first."""
    beacon = next(b for b in declared.site.beacons if b.name == check.name)
    sigma = beacon.sigma
    moment = abs(np.log(abs(check.factor)))
    ratios = {
        "position": float(
            np.max(np.abs(check.step_world) / np.hypot(check.step_sigma, sigma.position_world))
        ),
        "axis": check.angle / float(np.hypot(check.angle_sigma, np.max(sigma.rotation_beacon))),
        "moment": float(
            moment / np.hypot(check.factor_sigma / abs(check.factor), np.max(sigma.log_moment))
        ),
    }
    order = sorted(ratios, key=lambda name: -ratios[name])
    clear = tuple(name for name in order if ratios[name] > CONTRADICTED)
    return ("reversed", *clear) if check.factor < 0.0 else clear or (order[0],)


def words_of(check: BeaconCheck) -> str:
    """Return what is wrong with a contradicted beacon, and what to do."""
    step = 100.0 * check.step_world
    texts = {
        "reversed": "its coil is wired backwards: exchange its wires",
        "moment": f"its moment is {abs(check.factor):.3g} times the declared one: check turns and"
        " current",
        "position": f"it is off by ({step[0]:.1f}, {step[1]:.1f}, {step[2]:.1f}) cm,"
        f" {np.linalg.norm(step):.1f} cm in all: move or survey it",
        "axis": f"its axis is turned by {check.angle / DEGREE:.1f} deg: turn or survey it",
    }
    return "; ".join(texts[fault] for fault in check.faults)
