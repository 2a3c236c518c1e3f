"""Filters without each source, run with the estimate: online solution separation at constant cost.

A source is a beacon or an aiding sensor.  Each filter is stored as its deviation from the estimate,
linearised there, with the covariance of both.
A false source influences the estimate's prior for long, but never that of the filter without it, so
that slow faults are detected too.

All are updated in the same calls and not as one `PartialUpdateFilter` each (0.8 instead of 2.0 ms
an epoch of four beacons): filterpy inverts ``S``, which fails for a filter that has drifted by
kilometres.

Considered parameters are the same random variables in all filters: what these correlate among
themselves is stored once, and the products with it are formed once for all.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from magfusion.estimation.graph.measurement import Measurement, measured_rows
from magfusion.estimation.graph.propagation import Propagated
from magfusion.estimation.graph.state import MOTION, State, between
from magfusion.estimation.measurements.aiding import AidingMeasurement
from magfusion.estimation.measurements.joint_phasors import JointPhasors
from magfusion.estimation.measurements.phasors import FieldPhasors, leaves_out
from magfusion.estimation.online_integrity.judgement import Judgement
from magfusion.estimation.online_integrity.levels import Levels, LevelsQuery
from magfusion.estimation.posterior.separation import (
    MIN_COUNT,
    OPEN_POSITION,
    OPEN_ROTATION,
    SLACK,
    Separation,
    radii,
)
from magfusion.estimation.solve.sparse_rows import sparse_if_wide
from magfusion.model.parameters import Block, dimension
from magfusion.model.site import Site
from magfusion.model.trust import Finding, Risk, Verdict
from magfusion.units import DEGREE, Array, BoolArray, IntArray

MAX_FILTERS = 6  # filters without beacons; with more beacons some share one
# Initial uncertainty of a filter without a beacon, as the first state was estimated with all.
WIDE = np.repeat([0.2, 0.3, 0.5], 3)  # rad, m, m/s
NO_OWNER, TOGETHER = -1, -2  # groups of rows that belong to no source, or to all beacons
OPEN = np.repeat([OPEN_ROTATION, OPEN_POSITION, OPEN_POSITION], 3)  # of a filter without a sensor


class SubsetBank:
    """Filters without each beacon, or each of a few groups of them, and without each sensor.

    `blocks`: calibration parameters in the states' tangent. `considered`: parameters at the
    tangent's end that are considered, not estimated.
    """

    _step: Array | None  # (groups, n); deviation of each filter from the estimate
    _cov: Array | None  # (1 + groups, m, n); rows of what is estimated, with all and then without
    _joint: Array | None  # (groups, m, m); cross-covariance of each with the one with all
    _common: Array | None  # (n - m, n - m); covariance of considered parameters

    def __init__(
        self, site: Site, blocks: tuple[Block, ...], considered: int, risk: Risk | None = None
    ) -> None:
        self.blocks, self.considered = blocks, considered
        last = dimension(blocks) - considered
        self._estimated = tuple(block for block in blocks if block.columns.stop <= last)
        self.risk = Risk() if risk is None else risk
        self.names = [beacon.name for beacon in site.beacons]
        self._sensors = [sensor.name for sensor in site.aiding]
        self._shared = min(len(self.names), MAX_FILTERS)
        self.groups = self._shared + len(self._sensors)
        members = np.bincount(np.arange(len(self.names)) % self._shared)
        members = np.concatenate([members, np.ones(len(self._sensors))])
        self._prior = np.array(self.risk.fault * members[None], dtype=np.float64)
        self._step = self._cov = self._joint = self._common = None
        names = [name for name, _ in site.channels]
        self._owner = np.array([self.names.index(name) % self._shared for name in names])

    def check(self, size: int) -> None:
        """Check that the filters of a checkpoint fit states of a size.

        Raises ValueError if they do not.
        """
        parts = (self._step, self._cov, self._joint, self._common)
        if all(part is None for part in parts):
            return
        own, groups = size - self.considered, self.groups
        shapes = (
            (groups, size),
            (1 + groups, own, size),
            (groups, own, own),
            (self.considered, self.considered),
        )
        for part, shape in zip(parts, shapes, strict=True):
            if part is None or part.shape != shape or not np.all(np.isfinite(part)):
                raise ValueError("has filters of another shape, or not finite")

    def reset(self) -> None:
        """Discard all filters: the estimate has restarted."""
        self._step = self._cov = self._joint = self._common = None

    def absorb(
        self, predicted: Propagated, measurements: Sequence[Measurement], after: State
    ) -> None:
        """Update the filters to the new estimate.

        `predicted`: from the previous estimate. `measurements`: of this epoch, as the estimate used
        them. `after`: the estimate.
        """
        if self._step is None or self._step.shape[1] != len(after.cov):
            self._begin(after)
            return
        error, jacobian, owner = self._rows(measurements, predicted.state)
        spans = self._spans(measurements, owner)
        if leaves_out(measurements):
            kept = np.any(jacobian, axis=1)
            error, jacobian, owner = error[kept], jacobian[kept], owner[kept]
            spans = [basis[kept] for basis in spans]
        step, cov, joint, common = self._propagated(predicted)
        count = cov.shape[1]
        own, considered = slice(0, count), slice(count, None)
        by_own, by_common = jacobian[:, own], sparse_if_wide(jacobian[:, considered])

        def selected(rows: Array) -> Array:
            return self._selected(rows, owner, spans)

        def through(part: Array) -> Array:
            """Return ``by_common`` times the transpose of each filter's part, (k, rows, own)."""
            result = by_common @ part.reshape(len(part) * count, -1).T
            return np.swapaxes(result.reshape(len(error), len(part), count), 0, 1)

        shared = through(cov[:, :, considered])
        crossed = by_own @ cov[:, :, own] + shared
        spread = crossed @ by_own.T + by_own @ np.swapaxes(shared, 1, 2)
        spread += by_common @ (by_common @ common).T
        crossed = selected(crossed)
        # The gain of excluded rows is zero: what it is multiplied with needs no selection.
        gain = self._gains(crossed, selected(np.swapaxes(selected(spread), 1, 2)))
        rotated, by_gain = np.swapaxes(gain, 1, 2), gain @ by_own
        step[:, own] -= (gain[1:] @ (error + step @ jacobian.T)[..., None])[..., 0]
        step[:, own] -= between(predicted.state, after, self._estimated)
        # Joseph's form, as the gain is not optimal with considered parameters.
        half = cov.copy()
        half[:, :, own] -= gain @ crossed
        half[:, :, considered] -= by_gain @ cov[:, :, considered]
        of_common = (by_common.T @ gain.reshape(len(gain) * count, -1).T).T @ common
        half[:, :, considered] -= of_common.reshape(len(gain), count, -1)
        later = np.swapaxes(through(half[:, :, considered]), 1, 2)
        whole = half[:, :, own] @ (np.eye(count) - np.swapaxes(by_gain, 1, 2))
        whole += (gain - later) @ rotated
        joint -= by_gain[1:] @ joint + gain[1:] @ shared[0]
        joint += (gain[1:] - later[1:]) @ rotated[0] - joint @ by_gain[0].T
        half[:, :, own] = 0.5 * (whole + np.swapaxes(whole, 1, 2))
        # Far from the estimate the fields are not linear: without a sensor whose absence leaves the
        # position open, a filter has only its uncertainty, until other sources determine it.
        far = self._shared + np.flatnonzero(~_determined(half[1 + self._shared :, :6, :6]))
        step[far], joint[far] = 0.0, half[0, :, own]
        self._step, self._cov, self._joint, self._common = step, half, joint, common

    def _propagated(self, predicted: Propagated) -> tuple[Array, Array, Array, Array]:
        """Return deviations, covariances, cross-covariances and what is common, at the epoch."""
        assert self._step is not None
        assert self._cov is not None
        assert self._joint is not None
        assert self._common is not None
        motion, noise, common = predicted.transition[:MOTION], predicted.noise, self._common
        count = self._cov.shape[1]
        by_own, by_common, shared = motion[:, :count], motion[:, count:], self._cov[:, :, count:]
        step, cov, joint = (part.copy() for part in (self._step, self._cov, self._joint))
        step[:, :MOTION] = step @ motion.T
        cov[:, :MOTION, :count] = by_own @ cov[:, :, :count] + by_common @ shared.swapaxes(1, 2)
        cov[:, :MOTION, count:] = by_own @ shared + by_common @ common
        joint[:, :MOTION] = by_own @ joint + by_common @ shared[0].T
        joint[:, :, :MOTION] = np.concatenate([joint, cov[1:, :, count:]], axis=2) @ motion.T
        cov[:, :, :MOTION] = cov @ motion.T
        cov += noise[:count]
        joint += noise[:count, :count]
        return step, cov, joint, common + noise[count:, count:]

    def _whole(self) -> Array:
        """Return the whole covariance of each filter, shape (1 + groups, n, n)."""
        assert self._cov is not None
        assert self._common is not None
        count = self._cov.shape[1]
        common = np.broadcast_to(self._common, (len(self._cov), *self._common.shape))
        below = np.concatenate([np.swapaxes(self._cov[:, :, count:], 1, 2), common], axis=2)
        return np.concatenate([self._cov, below], axis=1)

    def _begin(self, state: State) -> None:
        size = len(state.cov)
        count = size - self.considered
        self._step = np.zeros((self.groups, size))
        self._joint = np.repeat(state.cov[None, :count, :count], self.groups, axis=0)
        self._cov = np.repeat(state.cov[None, :count], 1 + self.groups, axis=0)
        self._common = state.cov[count:, count:].copy()
        own = np.arange(len(WIDE))
        self._cov[1:, own, own] += WIDE**2
        self._cov[1 + self._shared :, own, own] += OPEN**2

    def _rows(
        self, measurements: Sequence[Measurement], state: State
    ) -> tuple[Array, Array, IntArray]:
        """Return error, Jacobian and group of each row; negative for rows of no single source."""
        parts = [(measured_rows([], state, self.blocks), np.zeros(0, dtype=np.int64))]
        for measurement in measurements:
            rows = measured_rows([measurement], state, self.blocks)
            if isinstance(measurement, FieldPhasors):
                owner = np.repeat(self._owner, 6)
            elif isinstance(measurement, AidingMeasurement):
                group = self._shared + self._sensors.index(measurement.sensor)
                owner = np.full(len(rows[0]), group)
            else:
                together = isinstance(measurement, JointPhasors)
                owner = np.full(len(rows[0]), TOGETHER if together else NO_OWNER)
            parts.append((rows, owner))
        error = np.concatenate([rows[0] for rows, _ in parts])
        jacobian = np.concatenate([rows[1] for rows, _ in parts])
        return error, jacobian, np.concatenate([owner for _, owner in parts])

    def _selected(self, rows: Array, owner: IntArray, spans: list[Array]) -> Array:
        """Return the rows that each filter uses, zero for those it excludes.

        `rows` (rows, k) or (1 + groups, rows, k). `spans` (rows, p) each: orthonormal basis of each
        group's part of jointly measured tones.
        """
        rows = np.broadcast_to(rows, (1 + self.groups, *rows.shape[-2:]))
        # The first filter excludes no beacon.
        kept = np.arange(-1, self.groups)[:, None] != np.where(owner < 0, self.groups, owner)
        result = np.where(kept[:, :, None], rows, 0.0)
        for i, basis in enumerate(spans, start=1):
            result[i] -= basis @ (basis.T @ rows[i])
        return result

    def _spans(self, measurements: Sequence[Measurement], owner: IntArray) -> list[Array]:
        """Return what each group spans of the rows of jointly measured tones."""
        result = []
        for measurement in measurements:
            if isinstance(measurement, JointPhasors):
                for group in range(self.groups):
                    basis = measurement.spanned((self._owner == group)[None])[0]
                    result.append(np.zeros((len(owner), basis.shape[1])))
                    result[-1][owner == TOGETHER] = basis
        return result

    def _gains(self, crossed: Array, spread: Array) -> Array:
        """Return the gain of every filter, shape (1 + groups, estimated, rows)."""
        innovation = spread + np.eye(spread.shape[1])
        return np.asarray(np.swapaxes(np.linalg.solve(innovation, crossed), 1, 2))

    def with_levels(self, judgement: Judgement, state: State) -> Judgement:
        """Return a judgement with the separation test, and with its protection levels."""
        result = self.separation(state)
        if result is None or judgement.verdict is Verdict.FAILED:
            return judgement
        excess = self._excess(result)
        if np.max(excess) <= 1.0:
            # Inflation by other monitors is unknown to the separation.
            wide, more = float(np.sqrt(judgement.inflation)), SLACK * float(np.sqrt(3.0))
            beyond = (more * judgement.shift, more * judgement.turn / DEGREE)
            requested = LevelsQuery(result, SLACK, self.risk, self._prior, wide, beyond)
            return replace(judgement, levels=Levels(query=requested))
        worst = int(np.argmax(excess))
        turn, shift = np.max(np.where(result.determined[0, :, None], result.shift[0], 0.0), axis=0)
        text = (
            f"The state with and without {self._called(worst)} differs by {1e3 * shift:.3g} mm,"
            f" {excess[worst]:.3g} times what noise and survey explain: {self._remedy(worst)}"
        )
        return replace(
            judgement,
            findings=(
                *judgement.findings,
                Finding("separation", text, weight=float(excess[worst])),
            ),
            turn=max(judgement.turn, float(turn)),
            shift=max(judgement.shift, float(shift)),
        )

    def _excess(self, result: Separation) -> Array:
        """Return the ratio of each filter's step to its threshold; zeros if all are far below."""
        step = np.add.reduceat(result.step[0] ** 2, (0, 3), axis=1)
        own = np.add.reduceat(result.cov[0].diagonal(), (0, 3))
        if (step <= SLACK**2 * own).all():
            return np.zeros(self.groups)
        return result.excess(self.risk, SLACK)[0]

    def _remedy(self, group: int) -> str:
        if group >= self._shared:
            return "it contradicts the others. Check its scale, mounting and clock in the site."
        return (
            "the beacons contradict each other. Check their drive, and iron or a shield near one."
        )

    def _called(self, group: int) -> str:
        if group >= self._shared:
            return self._sensors[group - self._shared]
        names = self.names[group :: self._shared]
        return f"beacon {names[0]}" if len(names) == 1 else f"beacons {', '.join(names)}"

    def separation(self, state: State) -> Separation | None:
        """Return the deviations of the filters from an estimate; None without filters."""
        if self._step is None or self._cov is None or self._joint is None:
            return None
        pose = np.s_[:, :6, :6]
        # A copy: a state whose levels are not yet computed must not reference the whole filters.
        subset, joint = self._cov[1:][pose].copy(), self._joint[pose]
        separate = subset + self._cov[:1][pose] - joint - np.swapaxes(joint, 1, 2)
        determined = _determined(subset)
        count = (1, self.groups)
        return Separation(
            self._step[None, :, :6].copy(),
            state.cov[None, :6, :6].copy(),
            subset[None],
            separate[None],
            determined[None],
            np.zeros(count),
            np.full(count, 6),
        )

    def grown(self, transition: Array, noise: Array) -> Array:
        """Return factors by which levels grow along a propagation, (n, 2).

        Attitude, then position.  They bound the growth of every norm in a level: of the estimate,
        of a filter without a beacon, and of their distance.
        `transition` (n, 15, 15 or 15 + calibration): from the state of the last epoch.
        `noise` (n, 15, 15): added since then.
        """
        if self._cov is None or self._joint is None:
            return np.ones((len(transition), 2))
        size, count = transition.shape[2], self._cov.shape[1]
        whole = self._whole()
        joint = np.tile(whole[0], (self.groups, 1, 1))
        joint[:, :count, :count] = self._joint
        joint[:, :count, count:] = self._cov[1:, :, count:]
        cov, joint = whole[:, :size, :size], joint[:, :size, :size]
        separate = cov[1:] + cov[:1] - joint - np.swapaxes(joint, 1, 2)
        pose = transition[:, None, :6]
        back = np.swapaxes(pose, 2, 3)
        later = pose @ np.concatenate([cov, separate]) @ back
        later[:, : len(cov)] += noise[:, None, :6, :6]
        before, after = radii(np.concatenate([cov, separate])[:, :6, :6]), radii(later)
        # Parameters known exactly, or without separation, do not contribute to a level.
        shares = [
            after[i] / np.where(before[i] > MIN_COUNT, before[i], np.inf)
            for i in range(len(before))
        ]
        return np.asarray(np.maximum(np.max(shares, axis=(0, 2)), 1.0))


def _determined(cov: Array) -> BoolArray:
    """Return whether covariances of poses (n, 6, 6) are those of determined ones."""
    variance = np.einsum("gii->gi", cov)
    rotation, position = np.sum(variance[:, :3], axis=1), np.sum(variance[:, 3:], axis=1)
    return np.asarray((rotation < OPEN_ROTATION**2) & (position < OPEN_POSITION**2))
