"""Option values that are more than a number or a name."""

from dataclasses import fields
from pathlib import Path

import numpy as np

from magfusion.errors import InputError
from magfusion.fixes.problem import FREE
from magfusion.parameters import GROUPS
from magfusion.receiver.windows import LockinSettings
from magfusion.records.rosbag import Topics
from magfusion.simulation.demo_site import DEMO_BOX_WORLD
from magfusion.units import Array


def lockin_option(
    usual: float, window: float | None, step: float | None, mains_hz: float
) -> LockinSettings:
    """Return how to demodulate, given the usual window (s) of the site's tones."""
    length = usual if window is None else window
    if not usual / 2.0 <= length <= 60.0:
        raise InputError(
            f"--window must lie between {usual / 2.0:.3g} s, below which the tones cannot be told"
            f" apart, and 60 s; got {length:g}"
        )
    distance = length / 2.0 if step is None else step
    if not length / 20.0 <= distance <= 60.0:
        raise InputError(
            f"--step must lie between a twentieth of the window, {length / 20.0:.3g} s, and 60 s;"
            f" got {distance:g}"
        )
    return LockinSettings(length, distance, mains_hz)


def topics_option(text: str | None) -> Topics | None:
    """Read ``role=name,...``."""
    if text is None:
        return None
    roles = [part.strip().partition("=") for part in text.split(",")]
    known = [field.name for field in fields(Topics)]
    if any(role not in known or not name for role, _, name in roles):
        raise InputError(
            f"--topics {text!r}: write role=name, separated by commas, with a role of"
            f" {', '.join(known)}"
        )
    return Topics(**{role: name for role, _, name in roles})


def groups_option(estimate: str | None) -> tuple[str, ...] | None:
    """Read ``group,...`` or ``none``."""
    if estimate is None:
        return None
    chosen = tuple(part.strip() for part in estimate.split(",") if part.strip())
    if chosen == ("none",):
        return ()
    unknown = [group for group in chosen if group not in GROUPS]
    if unknown or not chosen:
        raise InputError(
            f"--estimate {estimate!r}: {', '.join(unknown) or 'nothing'} is not a calibration "
            f"group; choose from {', '.join(GROUPS)}, or none"
        )
    return chosen


def free_option(text: str | None) -> tuple[str, ...]:
    """Read ``phase,gain`` or either."""
    chosen = () if text is None else tuple(part.strip() for part in text.split(","))
    unknown = [part for part in chosen if part not in FREE]
    if unknown:
        raise InputError(
            f"--free {text!r}: {unknown[0] or 'nothing'} is not among what a fix may find beside"
            f" the pose; choose from {', '.join(FREE)}"
        )
    return chosen


def check_fix(
    method: str, survey: Path | None, block: float | None, free: str | None = None
) -> None:
    """Refuse options of ``fix`` that the method does not take, or lacks."""
    if method != "likelihood" and free is not None:
        raise InputError("--free belongs to --method likelihood; leave one of the two out")
    if method == "likelihood" and survey is not None:
        raise InputError("--survey belongs to the methods of paper 004; choose one with --method")
    if method != "paper-lines" and block is not None:
        raise InputError("--block belongs to --method paper-lines")


def check_simulation(duration: float, shortest: float, longest: float, seed: int) -> None:
    """Refuse a length (s) or a seed that cannot be simulated."""
    if not shortest <= duration <= longest:
        raise InputError(
            f"--duration must lie between {shortest:g} and {longest:g} s; got {duration:g}"
        )
    if seed < 0:
        raise InputError(f"--seed must not be negative; got {seed}")


def box_option(text: str | None) -> Array:
    """Read ``xmin,xmax,ymin,ymax,zmin,zmax`` (m) as lower and upper corner, shape (2, 3)."""
    if text is None:
        return DEMO_BOX_WORLD
    try:
        box = np.array([float(part) for part in text.split(",")]).reshape(3, 2).T
    except ValueError:
        raise InputError(
            f"--box {text!r}: six numbers in metres are needed, x, y, z limits"
        ) from None
    if not np.all(np.isfinite(box)) or np.any(box[0] >= box[1]):
        raise InputError(f"--box {text!r}: each lower limit must be below its upper limit")
    return box
