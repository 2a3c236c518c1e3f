"""Shared calibration of the logs of several platforms over time, with changes between logs.

A beacon that is moved or exchanged has new parameters from then on, and each platform has its own
magnetometer.  The logs share one vector of all these; each log has a part of it.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from magfusion.estimation.batch.joint import LogInformation, Shared
from magfusion.model.parameters import (
    BEACON_POSITION,
    BEACON_ROTATION,
    CONDUCTIVITY,
    DECLINATION,
    LOG_MOMENT,
    BeaconParameter,
    Block,
    Parameter,
    dimension,
    placed,
    prior_sigma,
)
from magfusion.units import DEGREE, Array, IntArray

OF_SITE = {CONDUCTIVITY.group, DECLINATION.group}  # groups that all platforms share
NEW_SIGMA = 10.0  # declared sigmas of a changed parameter without a range below
NEW_RANGE: dict[Parameter, float] = {  # 1 sigma after a change that nobody surveyed
    BEACON_POSITION: 1.0,  # m
    BEACON_ROTATION: 30.0 * DEGREE,
    LOG_MOMENT: 0.5,
}


class SiteChange(NamedTuple):
    """A beacon, or a part of a platform, that has new parameters from a time on."""

    owner: str
    time: float  # (s, Unix)
    platform: int = -1  # its index; -1 for a beacon

    @property
    def name(self) -> str:
        """Name of the changed parameters' owner."""
        day = np.datetime64(int(self.time), "s")
        return f"{_on(self.owner, self.platform)} since {day}"


class BlockName(NamedTuple):
    """Name of a block of parameters in the file of a log."""

    group: str
    owner: str
    kind: str
    beacon: bool
    site: bool  # whether all platforms share it


class LogBlocks(NamedTuple):
    """Parameters of a log."""

    time: float  # (s, Unix)
    platform: int
    # shared, considered: those shared with other logs, and those only considered in every log
    shared: tuple[BlockName, ...]
    considered: tuple[BlockName, ...]


def names_of(blocks: Iterable[Block]) -> tuple[BlockName, ...]:
    """Return the names of blocks."""
    return tuple(
        BlockName(b.group, b.owner, b.kind, _is_of_beacon(b), b.group in OF_SITE) for b in blocks
    )


def _is_of_beacon(block: Block) -> bool:
    return isinstance(block.parameter, BeaconParameter)


def _on(owner: str, platform: int) -> str:
    return owner if platform < 1 else f"{owner} of platform {platform + 1}"


class PlatformCalibration(NamedTuple):
    """Declared calibration of the site with one platform."""

    shared: Shared
    considered: tuple[Block, ...]  # shared parameters that are not estimated


@dataclass(frozen=True, eq=False)
class Calendar:
    """Changes of a site, and the parameters of all its logs."""

    platforms: tuple[PlatformCalibration, ...]  # with the same beacons
    changes: tuple[SiteChange, ...] = ()

    def owner(self, name: BlockName, platform: int, time: float) -> str:
        """Return the owner of a log's block among the parameters of all logs."""
        own = -1 if name.beacon or name.site else platform
        last = [c for c in self.changes if (c.owner, c.platform) == (name.owner, own)]
        last = [change for change in last if change.time <= time]
        return max(last, key=lambda c: c.time).name if last else _on(name.owner, own)

    @cached_property
    def shared(self) -> Shared:
        """Parameters of all logs, with the survey as their prior."""
        parts = [([*self.platforms[0].shared.blocks], self.platforms[0].shared.information)]
        for i, platform in enumerate(self.platforms[1:], 1):
            mine = [b for b in platform.shared.blocks if not _is_common(b)]
            spread = np.linalg.inv(platform.shared.information)
            columns = _columns(mine)
            part = np.linalg.inv(spread[np.ix_(columns, columns)])
            parts.append(([b._replace(owner=_on(b.owner, i)) for b in mine], part))
        for change in self.changes:
            blocks = self.platforms[max(change.platform, 0)].shared.blocks
            new = [_after_change(b, change) for b in blocks if b.owner == change.owner]
            parts.append((new, np.diag(prior_sigma(tuple(new)) ** -2.0)))
        every = placed(block for blocks, _ in parts for block in blocks)
        prior, start = np.zeros((dimension(every),) * 2), 0
        for _, part in parts:
            prior[start : start + len(part), start : start + len(part)] = part
            start += len(part)
        return Shared(self.platforms[0].shared.declared, every, prior)

    @cached_property
    def considered(self) -> tuple[Block, ...]:
        """Considered parameters of all logs."""
        every = [
            block._replace(owner=block.owner if _is_common(block) else _on(block.owner, i))
            for i, platform in enumerate(self.platforms)
            for block in platform.considered
            if i == 0 or not _is_common(block)
        ]
        return placed(every)

    def columns(self, log: LogBlocks) -> tuple[IntArray, IntArray]:
        """Return the columns of a log's shared and considered parameters."""
        before = Calendar(self.platforms)  # those considered do not change
        return (
            self._columns_of(log.shared, self, log, self._shared_columns),
            self._columns_of(log.considered, before, log, self._considered_columns),
        )

    @staticmethod
    def _columns_of(
        names: tuple[BlockName, ...],
        calendar: "Calendar",
        log: LogBlocks,
        columns: dict[tuple[str, str, str], IntArray],
    ) -> IntArray:
        parts = [
            columns[name.group, calendar.owner(name, log.platform, log.time), name.kind]
            for name in names
        ]
        return np.concatenate(parts) if parts else np.zeros(0, dtype=np.int64)

    @cached_property
    def _shared_columns(self) -> dict[tuple[str, str, str], IntArray]:
        return _by_name(self.shared.blocks)

    @cached_property
    def _considered_columns(self) -> dict[tuple[str, str, str], IntArray]:
        return _by_name(self.considered)

    def whole(self, information: LogInformation, log: LogBlocks) -> LogInformation:
        """Return the information of a log on the parameters of all logs."""
        columns, common = self.columns(log)
        size, considered = dimension(self.shared.blocks), dimension(self.considered)
        return information.among(size, columns, common, considered)

    def on(self, platform: int, time: float) -> LogBlocks:
        """Return the parameters of a log that detects all beacons at some time."""
        own = self.platforms[platform]
        return LogBlocks(time, platform, names_of(own.shared.blocks), names_of(own.considered))


def _is_common(block: Block) -> bool:
    return _is_of_beacon(block) or block.group in OF_SITE


def _columns(blocks: Iterable[Block]) -> Array:
    return np.concatenate([np.arange(b.columns.start, b.columns.stop) for b in blocks])


def _by_name(blocks: tuple[Block, ...]) -> dict[tuple[str, str, str], IntArray]:
    return {(b.group, b.owner, b.kind): np.arange(b.columns.start, b.columns.stop) for b in blocks}


def _after_change(block: Block, change: SiteChange) -> Block:
    parameter: Parameter = block.parameter
    known = NEW_RANGE.get(parameter)
    sigma = NEW_SIGMA * block.sigma
    if known is not None:
        sigma = np.maximum(sigma, known / parameter.si)
    return block._replace(owner=change.name, sigma=sigma)
