"""The screen of a planned installation in a few lines: accuracy, beacons, and what limits."""

from collections.abc import Sequence

from magfusion.results.figures import Figures, Value, number
from magfusion.results.shown import number_text

Rows = list[list[str]]
_DRIVE = (("current_a", "A"), ("voltage_v", "V"), ("power_w", "W"), ("temperature_degc", "degC"))


def is_design(figures: Figures) -> bool:
    """Return whether a result is a design of an installation."""
    return "beacons_placed" in figures


def accuracy(figures: Figures) -> Rows:
    """Return position sigmas and protection levels, and those of what it is compared with."""
    rows = [["", "sigma, worst", "median", "level, worst", "median"]]
    for label, prefix in (("design", ""), ("before", "before_")):
        sigma, level = f"{prefix}position_sigma_m", f"{prefix}protection_level"
        row = [length(figures.get(f"{sigma}_{of}")) for of in ("worst", "median")]
        for of in ("worst", "median"):
            angle = figures.get(f"{level}_deg_{of}")
            text = length(figures.get(f"{level}_m_{of}"))
            row.append(text if angle is None else f"{text}, {number_text(angle, 2)} deg")
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
        limits = [length(figures["need_m"])]
        limits += [f"{number_text(figures['need_deg'])} deg"] if "need_deg" in figures else []
        share = 100.0 * number(figures["share_reached"])
        points = f"{share:.3g} % of {figures['points']} points"
        rows.append(["need", f"{what} {', '.join(limits)}: reached at {points}"])
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


def length(metres: Value) -> str:
    """Return a length as printed; none where the pose is not determined."""
    if metres is None:
        return "none"
    size = number(metres)
    return f"{1e3 * size:.3g} mm" if size < 1.0 else f"{size:.3g} m"


def _span(values: Sequence[float], unit: str) -> str:
    low, high = (number_text(end(values)) for end in (min, max))
    return f"{low} {unit}" if low == high else f"{low} to {high} {unit}"
