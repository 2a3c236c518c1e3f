"""Rows of a truth or of another program's trajectory: which have a pose, in every format."""

from typing import NamedTuple

import numpy as np

from magfusion.model.trust import Finding, Verdict
from magfusion.units import Array, BoolArray

QUATERNION_TOLERANCE = 1e-3  # of its length from one; more is reported
MAX_LENGTH_ERROR = 0.01  # of a quaternion's length from one: rounding, or one that was interpolated
MAX_UNNORMALIZED_SHARE = 0.1  # of the rows, whose quaternions may be worse
MIN_QUATERNION = 1e-6  # of its length; trackers write zeros where they see nothing


class PoseRows(NamedTuple):
    """Which of n rows have a pose, and why the others have none."""

    kept: BoolArray  # (n,)
    quaternion: Array | None  # (n, 4), of the rows that are kept of unit length
    length: Array  # (n,), of the quaternions as read; 1 without any
    absent: BoolArray  # (n,), NaN in a number of the pose
    zeros: BoolArray  # (n,), a quaternion of zeros
    off: BoolArray  # (n,), a quaternion too far from unit length to be scaled

    @classmethod
    def of(cls, values: Array, quaternion: Array | None) -> "PoseRows":
        """Judge rows by the numbers of their poses (n, k) and quaternions (n, 4) in any order."""
        absent: BoolArray = np.asarray(np.isnan(values).any(axis=1))
        length = np.ones(len(values))
        if quaternion is not None:
            absent |= np.isnan(quaternion).any(axis=1)
            length = np.linalg.norm(quaternion, axis=1)
        zeros = ~absent & (length < MIN_QUATERNION)
        off = ~absent & ~zeros & ~(np.abs(length - 1.0) <= MAX_LENGTH_ERROR)
        kept = ~(absent | zeros | off)
        if quaternion is not None:
            quaternion = quaternion / np.where(kept, length, 1.0)[:, None]
        return cls(kept, quaternion, length, absent, zeros, off)

    @property
    def left_out(self) -> dict[str, int]:
        """Numbers of the rows without a pose, by the reason."""
        rows = {
            "without a pose": self.absent,
            "with a quaternion of zeros": self.zeros,
            "with a quaternion not of unit length": self.off,
        }
        return {reason: int(np.sum(own)) for reason, own in rows.items() if own.any()}

    @property
    def scaled(self) -> float:
        """Largest deviation from unit length of a quaternion that is kept."""
        return float(np.max(np.abs(self.length[self.kept] - 1.0), initial=0.0))

    @property
    def refused(self) -> BoolArray:
        """Which rows have quaternions that are none, where there are too many for an accident."""
        too_many = np.sum(self.off) > MAX_UNNORMALIZED_SHARE * np.sum(self.kept | self.off)
        return np.asarray(self.off & too_many)

    def findings(self, stream: str) -> tuple[Finding, ...]:
        """Return how many rows are left out of a stream, and what was scaled."""
        texts = []
        if self.left_out:
            reasons = ", ".join(f"{count} {reason}" for reason, count in self.left_out.items())
            number = f"{np.sum(~self.kept)} of {len(self.kept)} rows"
            texts.append(f"{stream}: left out {number}: {reasons}.")
        if self.scaled > QUATERNION_TOLERANCE:
            texts.append(scaled_text(stream, self.scaled))
        return tuple(Finding("missing_samples", text, Verdict.TRUSTWORTHY) for text in texts)


def scaled_text(stream: str, scaled: float) -> str:
    """Return the sentence on quaternions that were scaled, by the largest deviation."""
    return f"{stream}: quaternions up to {100.0 * scaled:.2g} % off were scaled to unit length."
