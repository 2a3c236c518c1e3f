"""Parameters of the online score test: all fixed ones; of many beacons, those of detected ones."""

from collections.abc import Iterable
from dataclasses import replace
from functools import cached_property

import numpy as np

from magfusion.estimation.graph.measurement import Measurement
from magfusion.estimation.graph.state import MOTION
from magfusion.estimation.integrity.fault_candidates import (
    FaultCandidate,
    fault_candidates,
    fixed_blocks,
)
from magfusion.estimation.integrity.released_fault import gains
from magfusion.estimation.measurements.joint_phasors import JointPhasors
from magfusion.estimation.measurements.phasors import FieldPhasors
from magfusion.model.parameters import BeaconParameter, Block, dimension, placed, prior_sigma
from magfusion.model.prior import prior_sqrt_covariance
from magfusion.model.site import Site
from magfusion.units import Array, IntArray


class ScoreTargets:
    """The fixed parameters that are tested, and their columns next to a state.

    Parameters
    ----------
    site : Site
        With the tested beacons.
    estimated, considered : tuple of Block
        Calibration parameters in the state's tangent, of all beacons.
    static : bool
        Whether the static field is measured.
    steel : tuple of Block
        Amplitudes of `magfusion.estimation.measurements.steel.region_modes`, tested last.
    """

    def __init__(
        self,
        site: Site,
        estimated: tuple[Block, ...],
        considered: tuple[Block, ...],
        *,
        static: bool,
        steel: tuple[Block, ...] = (),
    ) -> None:
        fixed = fixed_blocks(site, estimated, static=static)
        self.site, self.fixed_blocks, self.steel = site, placed((*fixed, *steel)), steel
        self.names = tuple(beacon.name for beacon in site.beacons)
        self.unit, self.size = prior_sigma(self.fixed_blocks), MOTION + dimension(estimated)
        in_state = (*estimated, *considered)
        self.whole, known = MOTION + dimension(in_state), {b.key for b in in_state}
        others = placed((b for b in self.fixed_blocks if b.key not in known), dimension(in_state))
        self.parameters = (*in_state, *others)
        # Columns of the fixed parameters: those that are considered have them in the state.
        start = {b.key: MOTION + b.columns.start for b in self.parameters}
        own = [start[b.key] + np.arange(len(b.sigma)) for b in self.fixed_blocks]
        self.columns = np.concatenate([np.zeros(0, dtype=np.int64), *own])
        among = [b for b in considered if _is_of(b, self.names)]
        self.spread = self._declared(tuple(among))

    @cached_property
    def fault_candidates(self) -> tuple[FaultCandidate, ...]:
        """Candidate faults of these parameters, created on demand."""
        return tuple(fault_candidates(self.site, self.fixed_blocks))

    @cached_property
    def _by_shape(self) -> list[tuple[list[int], IntArray, Array]]:
        """Candidates by shape: their numbers, parameter rows, and combinations."""
        shapes: dict[tuple[int, ...], list[tuple[int, IntArray, Array]]] = {}
        for k, one in enumerate(self.fault_candidates):
            rows = np.concatenate([np.arange(b.columns.start, b.columns.stop) for b in one.blocks])
            combine = one.combine[rows]
            shapes.setdefault(combine.shape, []).append((k, rows, combine))
        result = []
        for own in shapes.values():
            numbers, rows_of, combines = zip(*own, strict=True)
            result.append((list(numbers), np.stack(rows_of), np.stack(combines)))
        return result

    def gains(self, information: Array, gradient: Array) -> Array:
        """Return the log-likelihood gain of estimating each candidate, shape (candidates,)."""
        result = np.zeros(len(self.fault_candidates))
        for numbers, rows, combine in self._by_shape:
            own = information[rows[:, :, None], rows[:, None, :]]
            result[numbers] = gains(combine, own, gradient[rows])
        return result

    def among(self, other: "ScoreTargets") -> tuple[IntArray, IntArray]:
        """Return the columns of the parameters in both, here and there."""
        there = {block.key: block.columns for block in other.fixed_blocks}
        both = [(b.columns, there[b.key]) for b in self.fixed_blocks if b.key in there]
        here, far = (
            np.concatenate([np.arange(s.start, s.stop) for s in one] or [np.zeros(0, dtype=int)])
            for one in ([pair[k] for pair in both] for k in (0, 1))
        )
        return here, far

    def _declared(self, considered: tuple[Block, ...]) -> Array:
        """Return a root of the declared covariance of the tested parameters."""
        if not considered:
            return np.zeros((len(self.unit), 0))
        start, own = 0, []
        for block in considered:
            own.append(block._replace(columns=slice(start, start + len(block.sigma))))
            start += len(block.sigma)
        spread = prior_sqrt_covariance(self.site, tuple(own))
        at, out = (
            {b.key: b.columns for b in self.fixed_blocks},
            np.zeros((len(self.unit), len(spread))),
        )
        for block in own:
            if block.key in at:
                out[at[block.key]] = spread[block.columns]
        return out / self.unit[:, None]


def beacons_in(measurements: Iterable[Measurement], site: Site) -> list[str]:
    """Return the names of the beacons that contribute to some measurements."""
    reported = np.zeros(len(site.channels), dtype=bool)
    for one in measurements:
        if isinstance(one, FieldPhasors):
            reported |= np.any(one.sqrt_information != 0.0, axis=(0, 2, 3))
        elif isinstance(one, JointPhasors):
            reported |= np.any(one.is_predicted, axis=0)
    return [site.beacons[k].name for k in np.unique(site.owner[reported]).tolist()]


def of_beacons_named(site: Site, names: Iterable[str]) -> Site:
    """Return a site with the named beacons only, in their order."""
    wanted = set(names)
    return replace(site, beacons=tuple(b for b in site.beacons if b.name in wanted))


def _is_of(block: Block, names: tuple[str, ...]) -> bool:
    return not isinstance(block.parameter, BeaconParameter) or block.owner in names
