"""Process noise of calibration parameters."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from magfusion.model.parameters import Block, Calibration, Parameter
from magfusion.model.site import Site
from magfusion.units import HOUR, Array


@dataclass(frozen=True, eq=False)
class ProcessNoise:
    """Random walk of a calibration."""

    blocks: tuple[Block, ...]
    variance: Array  # (dimension,), gain per second

    def cov(self, calibration: Calibration, time: float, elapsed: float) -> Array:
        """Return the covariance gained over an interval, shape (dimension, dimension).

        `time`: at its end (s). `elapsed` (s).
        """
        if not self.variance.any():
            return np.zeros((len(self.variance),) * 2)
        by_walk, columns = np.eye(self._walking), self._columns
        for block in self._coupled_blocks:
            coupled = block.parameter.drags(calibration, block.owner, time)
            if coupled is not None and (coupled[0], block.owner) in columns:
                by_walk[columns[coupled[0], block.owner], block.columns] = coupled[1]
        gained, walking = np.zeros((len(self.variance),) * 2), slice(self._walking)
        gained[walking, walking] = by_walk * (self.variance[walking] * elapsed) @ by_walk.T
        return gained

    @cached_property
    def _columns(self) -> dict[tuple[Parameter, str], slice]:
        return {block.key: block.columns for block in self.blocks}

    @cached_property
    def _walking(self) -> int:
        """Number of leading parameters that have a random walk or are moved by another's."""
        coupled = {block.owner for block in self._coupled_blocks}
        return max(
            block.columns.stop
            for block in self.blocks
            if self.variance[block.columns].any() or block.owner in coupled
        )

    @cached_property
    def _coupled_blocks(self) -> list[Block]:
        """Blocks with a random walk that may move other parameters."""
        return [
            block
            for block in self.blocks
            if type(block.parameter).drags is not Parameter.drags
            and self.variance[block.columns].any()
        ]


def calibration_process_noise(
    site: Site, blocks: tuple[Block, ...], considered: int = 0
) -> ProcessNoise:
    """Return the random walk of a calibration; rigidly mounted parts have none.

    `considered`: number of parameters at the end that are only considered: they are constant.
    """
    parts = [
        np.full(len(b.sigma), b.parameter.walk_per_sqrt_hour(site, b.owner) ** 2 / HOUR)
        for b in blocks
    ]
    variance = np.concatenate(parts) if parts else np.zeros(0)
    variance[len(variance) - considered :] = 0.0
    return ProcessNoise(blocks, variance)
