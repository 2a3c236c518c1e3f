"""Rows of a recording without a sample: NaN, beyond any range, or the stamp of the row above."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from magfusion.files.plausible import beyond_range
from magfusion.model.trust import Finding, Verdict
from magfusion.units import Array, BoolArray, IntArray

MAX_MISSING, MAX_DUPLICATED = 0.5, 0.1  # of the rows; more is a mistake of the recording


def copied_rows(time_ns: IntArray, values: Array) -> BoolArray:
    """Return which of some rows, sorted by their stamps (ns), are the row above, written again."""
    result = np.zeros(len(time_ns), dtype=bool)
    rows = np.flatnonzero(np.diff(time_ns) == 0) + 1
    row, above = values[rows], values[rows - 1]
    result[rows] = ((row == above) | (np.isnan(row) & np.isnan(above))).all(axis=1)
    return result


def copies_text(name: str, copies: BoolArray) -> str:
    """Return how many rows of a stream or file are left out as they were written twice."""
    count = int(np.sum(copies))
    what = f"{count} samples are exact copies of others. They are left out."
    return (
        f"{name}: {'1 sample is an exact copy of another. It is left out.' if count == 1 else what}"
    )


def coarse_text(place: str, stream: str, twice: int, count: int) -> str:
    """Return the refusal of a table whose stamps are too often those of another row."""
    return (
        f"{place}: {twice} of {count} rows have the stamp of another: the times are coarser than"
        f" the sampling; import the table with a finer column as {stream}.time, or with --rate-hz"
        f" {stream}=HZ."
    )


def copies_findings(texts: Sequence[str]) -> tuple[Finding, ...]:
    """Return findings with the texts of `copies_text`."""
    return tuple(Finding("repeated_stamps", text, Verdict.TRUSTWORTHY) for text in texts)


class LostRows(NamedTuple):
    """Rows without a sample, shape (n,): of repeated stamps, the later ones.

    `copies`: rows that are the one above, written again. `twice`: others with its stamp.
    """

    copies: BoolArray
    twice: BoolArray
    absent: BoolArray
    beyond: BoolArray

    @classmethod
    def of(cls, time_ns: IntArray, values: Array) -> "LostRows":
        """Judge rows, sorted by their stamps (ns), of values as `beyond_range` takes them.

        Where most are beyond the range, the unit is wrong: none of them is left out.
        """
        copies = copied_rows(time_ns, values)
        twice = (np.diff(time_ns, prepend=time_ns[:1] - 1) == 0) & ~copies
        absent, beyond = np.isnan(values).any(axis=1), beyond_range(values)
        if np.sum(beyond) > MAX_MISSING * len(beyond):
            beyond[:] = False
        return cls(
            copies, np.asarray(twice), np.asarray(absent & ~copies), beyond & ~absent & ~copies
        )

    @property
    def kept(self) -> BoolArray:
        """Which rows hold a sample, shape (n,)."""
        return np.asarray(~(self.copies | self.twice | self.absent | self.beyond))

    @property
    def too_many(self) -> tuple[bool, bool]:
        """Whether repeated stamps and rows of NaN are too many for an accident."""
        if not len(self.twice):
            return False, False
        count = np.sum(~self.copies)
        return (
            bool(np.sum(self.twice) > MAX_DUPLICATED * count),
            bool(np.sum(self.absent) > MAX_MISSING * count),
        )

    def findings(self, stream: str) -> tuple[Finding, ...]:
        """Return how many rows are left out of a stream, and why."""
        return tuple(
            Finding(code, f"{stream}: {text} They are left out.", Verdict.TRUSTWORTHY)
            for code, rows, text in (
                (
                    "repeated_stamps",
                    self.copies,
                    f"{np.sum(self.copies)} samples are exact copies of others.",
                ),
                (
                    "repeated_stamps",
                    self.twice,
                    f"{np.sum(self.twice)} samples have the stamp of the one before.",
                ),
                ("missing_samples", self.absent, f"{np.sum(self.absent)} samples are NaN."),
                (
                    "missing_samples",
                    self.beyond,
                    f"{np.sum(self.beyond)} samples are larger than any instrument measures.",
                ),
            )
            if rows.any()
        )
