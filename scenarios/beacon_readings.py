"""Which reading of paper 002's words gives its figures: "signal to noise 100", the mean of angles.

The rule of the verdict was settled before any run: a reading is the paper's where all four figures
agree within half of their last digit and three standard errors.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from magfusion.units import DEGREE, Array

PAPER = {3: (0.011, 0.17), 4: (0.009, 0.13)}  # m, deg; of so many magnetometers


@dataclass(frozen=True)
class Reading:
    """What one reading of the paper's words makes of its figures: found over printed.

    In the order position with three and four magnetometers, angle with three and four.
    """

    noise: str
    angle: str  # "mean" or "rms" over runs and angles
    ratios: tuple[float, ...]
    is_the_papers: bool


def readings(errors: Mapping[tuple[str, int], tuple[Array, Array]]) -> list[Reading]:
    """Return every reading of noise and angle.

    Parameters
    ----------
    errors : mapping
        By noise and magnetometers: position (runs,) (m) and angles (runs, 3) (rad).
    """
    out = []
    for noise in dict.fromkeys(noise for noise, _ in errors):
        for angle, power in (("mean", 1), ("rms", 2)):
            place, turn = [], []
            for count, (printed_m, printed_deg) in PAPER.items():
                position, angles = errors[noise, count]
                place.append(_neighbour(position[:, None], 1, printed_m, 5e-4))
                turn.append(_neighbour(angles / DEGREE, power, printed_deg, 5e-3))
            ratios, agree = zip(*place, *turn, strict=True)
            out.append(Reading(noise, angle, ratios, all(agree)))
    return out


def _neighbour(error: Array, power: int, printed: float, half_digit: float) -> tuple[float, bool]:
    """Return a mean of errors (runs, k) over what is printed, and whether it can be that."""
    each = np.mean(np.abs(error) ** power, axis=1)
    result = float(np.mean(each)) ** (1.0 / power)
    spread = float(np.std(each, ddof=1) / np.sqrt(len(each)))
    spread *= result ** (1 - power) / power  # of the root
    return result / printed, bool(abs(result - printed) <= half_digit + 3.0 * spread)


def report_readings(result: list[Reading]) -> str:
    """Return the table of readings with the verdicts."""
    lines = [
        "",
        "printed method, found / printed: position of three, four; angle of three, four",
    ]
    for one in result:
        cells = "".join(f"{ratio:8.2f}" for ratio in one.ratios)
        verdict = "can be the paper's" if one.is_the_papers else "is not the paper's"
        lines.append(f"{one.noise:<10}{one.angle:<6}{cells}  {verdict}")
    return "\n".join(lines)
