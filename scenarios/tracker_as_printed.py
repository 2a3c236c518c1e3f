"""Paper 000's correction of known errors, as it is printed and put right (Eq 9 to 11 and 20).

Both antennas of a tracker are turned by known errors of a degree about each axis, other ones at
each pose; nothing else is wrong, and there is no noise.

1. Not corrected, the attitude errs by 2.4 degrees.
2. Corrected as printed, it errs by 4.8: T is on the side of the transmitter, and Q and T are
   taken as the inverse of the coils' rotation; as the rotation itself they leave 2.7.
3. With T on the left and both the right way round, by a hundredth of a degree, which is what
   ``1 + [w]x`` lacks of a rotation.
"""

from dataclasses import dataclass

import numpy as np
from harness import between_deg, conclude, rms, scenario_parser
from scipy.spatial.transform import Rotation
from tracker_antennas import rotated

from magfusion.model.physics.dipole import dipole_field
from magfusion.papers.p000_tracker.equations import (
    Correction,
    bursa_wolf_matrix,
    eq_11_attitude,
    eq_11_attitude_as_printed,
)
from magfusion.papers.p000_tracker.pose import locate_by_svd
from magfusion.units import DEGREE, MU0_OVER_4PI, Array

NONE = np.zeros((3, 3))


@dataclass(frozen=True)
class Config:
    """Poses, each with antennas of its own, and the errors of these about each axis."""

    poses: int = 20_000
    error_deg: float = 1.0
    nearest: float = 0.3  # m
    farthest: float = 0.6  # m
    seed: int = 0


@dataclass(frozen=True)
class Result:
    """Attitude errors (deg, rms over the poses)."""

    not_corrected: float
    as_printed: float
    put_right: float


def run(config: Config) -> Result:
    """Couple turned antennas at random poses, and correct what is known of them."""
    rng = np.random.default_rng(config.seed)
    attitude = Rotation.random(config.poses, rng=rng).as_matrix()
    position = rng.standard_normal((config.poses, 3))
    distance = rng.uniform(config.nearest, config.farthest, config.poses)
    position *= (distance / np.linalg.norm(position, axis=1))[:, None]
    ideal = attitude @ np.swapaxes(dipole_field(position[:, None], np.eye(3)), 1, 2)
    error = config.error_deg * DEGREE * rng.standard_normal((2, config.poses, 3))
    sent, seen = rotated(error)
    measured = np.swapaxes(seen, 1, 2) @ ideal @ sent
    sent_matrix, seen_matrix = bursa_wolf_matrix(error)
    known = Correction(np.linalg.inv(sent_matrix), NONE, np.linalg.inv(seen_matrix), NONE, NONE)
    printed = eq_11_attitude_as_printed(measured, position, MU0_OVER_4PI, np.eye(3), known)
    right = eq_11_attitude(measured, position, seen_matrix, sent_matrix, NONE)
    result = (locate_by_svd(measured).sensor_from_beacon, _rotation(printed), right)
    return Result(*(rms(between_deg(one, attitude)) for one in result))


def _rotation(matrix: Array) -> Array:
    """Return the orthogonal matrix next to each: what Eq 11 gives as printed is none."""
    remaining, _, right = np.linalg.svd(matrix)
    return np.asarray(remaining @ right)


def report(result: Result) -> str:
    """Return the table of the run."""
    rows = {
        "not corrected": result.not_corrected,
        "as printed (Eq 9-11, Q and T of Eq 20)": result.as_printed,
        "put right": result.put_right,
    }
    lines = ["attitude error (deg, rms), both antennas turned by known errors"]
    return "\n".join([*lines, *(f" {name:40}{value:8.3f}" for name, value in rows.items())])


def main() -> None:
    """Print the table and one JSON line."""
    given = scenario_parser(__doc__, Config.seed, "200 poses", output=None).parse_args()
    result = run(Config(poses=200 if given.quick else Config.poses, seed=given.seed))
    conclude(report(result), result)


if __name__ == "__main__":
    main()
