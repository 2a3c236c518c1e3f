"""Segments of a long log: drifting parameters have a value in each, with a step between them."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import gtsam
import numpy as np

from magfusion.estimation.graph.factors import CALIBRATION_KEY
from magfusion.estimation.graph.process_noise import calibration_process_noise
from magfusion.model.parameters import Block, Calibration, difference, dimension
from magfusion.units import Array, IntArray

SEGMENT = 1800.0  # s; of a long log, within which drifting parameters are constant


@dataclass(frozen=True, eq=False)
class Segments:
    """Segments of a long log, each with its own values of the drifting parameters."""

    of_epoch: IntArray  # (epochs,), segment of each epoch; empty where there is one for all
    # segment whose values are in the calibration's own variable, with all constant parameters
    main: int
    drifting: IntArray  # (k,), columns of the calibration's tangent vector
    # (segments - 1, k, k), whitening of the step from each segment to the next
    sqrt_information: Array

    def __len__(self) -> int:
        return len(self.sqrt_information) + 1

    def at(self, epoch: IntArray) -> IntArray:
        """Return the segment of some epochs."""
        return self.of_epoch[epoch] if len(self) > 1 else np.zeros_like(epoch)

    def own(self, segment: int) -> tuple[int, IntArray] | None:
        """Return key and columns of a segment's own variable; None for the main one."""
        return None if segment == self.main else (gtsam.symbol("d", segment), self.drifting)

    def variables(self) -> Iterator[tuple[int, IntArray]]:
        """Yield key and columns of every variable besides the calibration's own."""
        return filter(None, map(self.own, range(len(self))))

    def key(self, segment: int) -> int:
        """Return the key of the variable of a segment's drifting parameters."""
        own = self.own(segment)
        return CALIBRATION_KEY if own is None else own[0]

    def steps(self, calibrations: list[Calibration], blocks: tuple[Block, ...]) -> list[Array]:
        """Return the whitened step from each segment to the next."""
        return [
            whitening @ difference(before, after, blocks)[self.drifting]
            for whitening, (before, after) in zip(
                self.sqrt_information, pairwise(calibrations), strict=True
            )
        ]

    def factors(
        self, calibrations: list[Calibration], blocks: tuple[Block, ...]
    ) -> Iterator[gtsam.JacobianFactor]:
        """Yield the factor between each segment and the next, at an estimate."""
        size = dimension(blocks)
        for k, step in enumerate(self.steps(calibrations, blocks)):
            parts: list[Any] = []
            for segment, sign in ((k, -1.0), (k + 1, 1.0)):
                by = sign * self.sqrt_information[k]
                if segment == self.main:
                    whole = np.zeros((len(by), size))
                    whole[:, self.drifting] = by
                    by = whole
                parts += [self.key(segment), by]
            parts += [-step, gtsam.noiseModel.Unit.Create(len(step))]
            yield gtsam.JacobianFactor(*parts)


_NONE = np.zeros(0, dtype=np.int64)
ONE_SEGMENT = Segments(_NONE, 0, _NONE, np.zeros((0, 0, 0)))


def segments_of(time: Array, calibration: Calibration, blocks: tuple[Block, ...]) -> Segments:
    """Return the segments of a log: one where it is short, or no parameter drifts.

    `time` (epochs,) (s).
    """
    noise = calibration_process_noise(calibration.site, blocks)
    drifting = np.flatnonzero(noise.variance > 0.0)
    count = int(np.ceil((time[-1] - time[0]) / SEGMENT))
    if count < 2 or len(drifting) == 0:
        return ONE_SEGMENT
    edges = np.linspace(time[0], time[-1], count + 1)
    length, own = float(edges[1] - edges[0]), np.ix_(drifting, drifting)
    cov = [noise.cov(calibration, float(edge), length)[own] for edge in edges[1:-1]]
    of_epoch = np.searchsorted(edges[1:-1], time, side="right")
    return Segments(of_epoch, count // 2, drifting, np.linalg.inv(np.linalg.cholesky(cov)))
