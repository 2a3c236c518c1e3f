"""The screen of a planned installation in a few lines: accuracy, beacons, and what limits."""

from collections.abc import Sequence

from magfusion.results.figures import Figures, Value, number
from magfusion.results.shown import number_text

Rows = list[list[str]]
_DRIVE = (("current_a", "A"), ("voltage_v", "V"), ("power_w", "W"), ("temperature_degc", "degC"))


def is_design(figures: Figures) -> bool:
    """Return whether a result is a design of an installation."""
    return "beacons_placed" in figures


def is_coverage(figures: Figures) -> bool:
    """Return whether a result is the coverage of an installation."""
    return "share_below_10_cm" in figures


def accuracy(figures: Figures) -> Rows:
    """Return position sigmas and protection levels, and those of what it is compared with."""
    rows = [["", "sigma, worst", "median", "level, worst", "median"]]
    for label, prefix in (("design", ""), ("before", "before_")):
        sigma, level = f"{prefix}position_sigma_m", f"{prefix}protection_level"
        row = [length(figures.get(f"{sigma}_{of}")) for of in ("worst", "median")]
        row += [_level(figures, level, of) for of in ("worst", "median")]
        rows.append([label, *row])
    if "random_layouts" in figures:
        best = [
            length(figures.get(f"random_best_position_sigma_m_{of}")) for of in ("worst", "median")
        ]
        level = length(figures.get("random_worst_level_m_best"))
        rows.append([f"best of {figures['random_layouts']} random", *best, level, ""])
    return rows


def plan_lines(figures: Figures) -> Rows:
    """Return what is needed, the beacons, and what limits the position."""
    rows = []
    if "need_m" in figures:
        what = "protection level" if figures["objective"] == "worst" else "position sigma"
        rows.append(_need(what, figures))
    kept = f"; {figures['beacons_kept']} kept" if figures["beacons_kept"] else ""
    moments, tones = (
        _span([number(f.value) for f in figures.all if f.name.startswith(key)], unit)
        for key, unit in (("{beacon}.moment", "A m^2"), ("{beacon}.frequency", "Hz"))
    )
    rows.append(["beacons", f"{figures['beacons_placed']} of {moments} at {tones}{kept}"])
    drive = [
        f"{number_text(max(values))} {unit}"
        for key, unit in _DRIVE
        if (values := [number(f.value) for f in figures.all if f.name == f"{{beacon}}.{key}"])
    ]
    if drive:
        rows.append(["coils", f"at most {', '.join(drive)}"])
    limit = figures.get("limit")
    return [*rows, ["limit", number_text(limit)]] if limit else rows


def bounds(figures: Figures) -> Rows:
    """Return sigmas and protection levels over a volume."""
    rows = [["", "median", "90th percentile", "worst"]]
    for name, unit, shown in (("position", "m", length), ("attitude", "deg", _angle)):
        values = (shown(figures.get(f"{name}_sigma_{unit}_{of}")) for of in ("median", "p90"))
        rows.append([f"{name} sigma", *values, ""])
    level = [_level(figures, "protection_level", of) for of in ("median", "worst")]
    return [*rows, ["protection level", level[0], "", level[1]]]


def coverage_lines(figures: Figures) -> Rows:
    """Return where the position is determined, and what one more beacon gains."""
    determined, cm, dm = (
        f"{100.0 * number(figures.get(key)):.3g} %"
        for key in ("share_determined", "share_below_1_cm", "share_below_10_cm")
    )
    within = f"position determined at {determined}, sigma below 10 cm at {dm}, 1 cm at {cm}"
    spacing = length(figures["spacing_m"])
    rows = [["points", f"{figures['points']}, {spacing} apart: {within}"]]
    if "need_m" in figures:
        rows.append(_need("protection level", figures))
    protected = 100.0 * number(figures.get("share_with_level"))
    least = f"at least {figures['beacons_heard_least']} beacons"
    rows.append(["in range", f"{least}; with a protection level: {protected:.3g} % of the points"])
    if "extra_beacon_x_m" in figures:
        place = ", ".join(number_text(figures[f"extra_beacon_{axis}_m"]) for axis in "xyz")
        before, after = (length(figures[f"median_{of}_extra_m"]) for of in ("without", "with"))
        gain = f"the median position sigma is {after} instead of {before}"
        rows.append(["one more", f"with a beacon at ({place}) m {gain}"])
    return rows


def _need(what: str, figures: Figures) -> list[str]:
    limits = [length(figures["need_m"])]
    limits += [f"{number_text(figures['need_deg'])} deg"] if "need_deg" in figures else []
    share = 100.0 * number(figures["share_reached"])
    points = f"{share:.3g} % of {figures['points']} points"
    return ["need", f"{what} {', '.join(limits)}: reached at {points}"]


def _level(figures: Figures, key: str, of: str) -> str:
    text, angle = length(figures.get(f"{key}_m_{of}")), figures.get(f"{key}_deg_{of}")
    return text if angle is None else f"{text}, {_angle(angle)}"


def _angle(degrees: Value) -> str:
    return "none" if degrees is None else f"{number_text(degrees, 2)} deg"


def length(metres: Value) -> str:
    """Return a length as printed; none where the pose is not determined."""
    if metres is None:
        return "none"
    size = number(metres)
    return f"{1e3 * size:.3g} mm" if size < 1.0 else f"{size:.3g} m"


def _span(values: Sequence[float], unit: str) -> str:
    low, high = (number_text(end(values)) for end in (min, max))
    return f"{low} {unit}" if low == high else f"{low} to {high} {unit}"
