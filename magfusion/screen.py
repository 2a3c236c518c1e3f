"""What a user sees of a job's figures: the errors first, then what was found, then warnings."""

import math
import re
from pathlib import Path

from rich.console import Console
from rich.table import Table

from magfusion.report import AMBIGUOUS_CHI_SQUARE, Figures

_ERRORS = {
    "position (m)": (
        "ate_m",
        "aligned_ate_m",
        "held_ate_m",
        "lagged_ate_m",
        "position_sigma_median_m",
    ),
    "attitude (deg)": (
        "attitude_rmse_deg",
        "aligned_attitude_rmse_deg",
        "held_attitude_rmse_deg",
        "lagged_attitude_rmse_deg",
        "attitude_sigma_median_deg",
    ),
    "step, position (m)": (
        "rpe_translation_m",
        "",
        "held_rpe_translation_m",
        "lagged_rpe_translation_m",
        "",
    ),
    "step, attitude (deg)": (
        "rpe_rotation_deg",
        "",
        "held_rpe_rotation_deg",
        "lagged_rpe_rotation_deg",
        "",
    ),
}
_COLUMNS = ("rms", "aligned", "survey held", "lagged", "claimed sigma per axis")
# Told in tables or sentences, or of interest only in report.json.
_ELSEWHERE = re.compile(
    r"ambiguity.*|"
    r"job|log|notes|ate_m|attitude_rmse_deg|aligned_.*|rpe_.*|held_.*|lagged_.*|.*_sigma_median_.*|cost|failed|"
    r"nees_median|(position|attitude)_inside_3_sigma|start_.*|rival_.*|ambiguous|not_compared|"
    r"(windows|epochs)_dropped_.*|gauge|weakest_directions|missing_motion|hypotheses_.*|placed.*|"
    r"directions.*|nearest_m_.*|motion_.*|cross_.*|determined_but_for_gauge|determined|undetermined|time_offset_s|passes|iterations|.*\..*"
)
_USUAL = {"coupling": "tight", "converged": True, "windows_dropped": 0, "epochs_dropped": 0}
_USUAL |= {"intervals_bridged": 0}
_USUAL |= {"ambiguous_epochs": 0, "undetermined_epochs": 0}
_LISTED = re.compile(
    r"(?P<name>residual_rms|sigma|points_hearing|distortion)_(?P<part>.+?)(?P<unit>_t)?"
)
_PART = re.compile(r"_([xyz]|\d)(?=(_m|_deg|_ppm)?$)|(?<=_[xyz])[xyz]$")
_TOLD_OF_DIRECTIONS = {"gauge": "open", "weakest_directions": "open"}
_TOLD_OF_DIRECTIONS |= {"missing_motion": "missing motion"}
_SCORES = {
    "aligned_ate_m": "position, aligned (m)",
    "aligned_attitude_rmse_deg": "attitude, aligned (deg)",
    "residual_rms": "residual (sigma)",
}
POOR_FIT = 3.0  # whitened residual, one where noise and model are as declared


def show(figures: Figures, output: Path | None, console: Console | None = None) -> None:
    """Print the figures of a job for a reader; ``report.json`` has them all.

    Parameters
    ----------
    figures : dict
    output : Path, optional
        Where the results are.
    console : Console, optional
        The standard output where there is none.
    """
    console = Console(highlight=False) if console is None else console
    name = " of ".join(str(figures[key]) for key in ("job", "log") if key in figures)
    console.print(name, style="bold", soft_wrap=True, markup=False)
    for table in (_errors(figures), _others(figures), _calibration(figures)):
        if table.row_count:
            console.print(table)
    if (transfer := _transfer(figures)).row_count:
        console.print(transfer)
    for sentence in _directions(figures):
        console.print(sentence, soft_wrap=True, markup=False)
    for sentence in remarks(figures):
        console.print(f"note: {sentence}", style="yellow", soft_wrap=True, markup=False)
    settled = _sentences(figures, "ambiguity_settled") + [
        _place(figures, name) for name in _sentences(figures, "placed")
    ]
    for sentence in settled:
        console.print(sentence, soft_wrap=True, markup=False)
    if output is not None:
        console.print(f"results in {output}", soft_wrap=True, markup=False)


def remarks(figures: Figures) -> list[str]:
    """Return in words what a reader of the figures must not overlook."""
    epochs, told = figures.get("epochs"), figures.get("notes")
    out = list(told) if isinstance(told, list) else []
    if "failed" in figures:
        out.append(f"The smoother failed ({figures['failed']}).")
    if figures.get("converged") is False:
        out.append("The smoother did not converge; do not trust the result beyond its fixes.")
    for key, value in figures.items():
        if key.startswith("residual_rms_") and _float(value) > POOR_FIT:
            out.append(
                f"{key} is {_number(value)} where about 1 is expected; check the survey of what"
                " the beacon is, where it stands and how it is driven."
            )
    if figures.get("ambiguous"):
        out.append(
            "Another trajectory explains the log nearly as well (its chi square is only"
            f" {_number(figures['rival_chi_square'])} larger); add a beacon, or record more motion."
        )
    if figures.get("ambiguous_epochs"):
        out.append(
            f"{figures['ambiguous_epochs']} of {epochs} epochs are ambiguous: fixes.parquet holds"
            " every pose that explains them; add a beacon, or smooth, so that the motion decides."
        )
    out += _sentences(figures, "ambiguity")
    out += [s for name in _sentences(figures, "placed") for s in _rival_places(figures, name)]
    if figures.get("undetermined_epochs"):
        out.append(
            f"{figures['undetermined_epochs']} of {epochs} epochs leave a direction of the pose"
            " open (undetermined in fixes.parquet); add a beacon or a coil."
        )
    if figures.get("not_compared"):
        out.append(f"There is no comparison with the truth: {figures['not_compared']}")
    return out


def _place(figures: Figures, name: str) -> str:
    found = ", ".join(f"{_float(figures[f'placed_{name}_{axis}_m']):.3f}" for axis in "xyz")
    tried = len(_sentences(figures, f"hypotheses_{name}"))
    return f"beacon {name} was placed at ({found}) m; {tried} place(s) explained its field"


def _rival_places(figures: Figures, name: str) -> list[str]:
    told = _sentences(figures, f"hypotheses_{name}")
    rival = figures.get(f"hypotheses_{name}_rival_chi_square")
    if rival is None or _float(rival) > AMBIGUOUS_CHI_SQUARE:
        return []
    return [
        f"The log leaves more than one place for beacon {name} ({'; '.join(told)}); record more"
        " motion, in all three directions."
    ]


def _sentences(figures: Figures, key: str) -> list[str]:
    told = figures.get(key)
    return told if isinstance(told, list) else []


def _errors(figures: Figures) -> Table:
    used = [
        k for k in range(len(_COLUMNS)) if any(names[k] in figures for names in _ERRORS.values())
    ]
    table = Table("", *(_COLUMNS[k] for k in used), box=None)
    for label, names in _ERRORS.items():
        if any(name in figures for name in names):
            table.add_row(label, *(_number(figures.get(names[k])) for k in used))
    return table


def _others(figures: Figures) -> Table:
    table = Table(box=None, show_header=False)
    lists: dict[str, list[str]] = {}
    for key, value in figures.items():
        if _ELSEWHERE.fullmatch(key) or (key in _USUAL and value == _USUAL[key]):
            continue
        found = _LISTED.fullmatch(key)
        if found and key != "residual_rms_median":
            name = f"{found['name']}{found['unit'] or ''}"
            lists.setdefault(name, []).append(f"{found['part']} {_number(value)}")
        else:
            table.add_row(key, _number(value) + _reasons(figures, key))
    for name, values in lists.items():
        table.add_row(name, ", ".join(values))
    return table


def _reasons(figures: Figures, key: str) -> str:
    found = [k for k in figures if key.endswith("_dropped") and k.startswith(f"{key}_")]
    told = [f"{figures[k]} {k.removeprefix(f'{key}_').replace('_', ' ')}" for k in found]
    return f" ({', '.join(told)})" if told else ""


def _calibration(figures: Figures) -> Table:
    """Return one row for each vector of estimated parameters."""
    table = Table("calibration", "change", "sigma (largest)", "prior", "determined", box=None)
    groups: dict[str, list[str]] = {}
    for key in figures:
        if f"{key}_prior_sigma" in figures:
            groups.setdefault(_PART.sub("", key), []).append(key)
    told = figures.get("determined")
    determined = set(told) if isinstance(told, list) else set()
    for stem, keys in groups.items():
        known = [key in determined for key in keys]
        verdict = "yes" if all(known) else "partly" if any(known) else "no"
        sigma = [_float(figures[f"{key}_sigma"]) for key in keys]
        change = [_as_sure(_float(figures[k]), s) for k, s in zip(keys, sigma, strict=True)]
        prior = dict.fromkeys(_number(figures[f"{key}_prior_sigma"], 2) for key in keys)
        row = (" ".join(change), _number(max(sigma), 2), " ".join(prior))
        table.add_row(stem, *row, verdict)
    return table


def _directions(figures: Figures) -> list[str]:
    """Return what the log told of the calibration's directions, and what it could not."""
    if "directions" not in figures or figures["job"] != "calibrate log":
        return []
    told, count = figures["directions_determined"], figures["directions"]
    out = [f"{told} of {count} directions of the calibration are determined"]
    for key, label in _TOLD_OF_DIRECTIONS.items():
        out += [f"{label}: {sentence}" for sentence in _sentences(figures, key)]
    return out


def _transfer(figures: Figures) -> Table:
    """Return how a calibration by one part of the log serves on another part."""
    table = Table("other part of the log", "survey held", "calibrated", box=None)
    for key, label in _SCORES.items():
        if f"cross_declared_{key}" in figures:
            both = (figures[f"cross_{which}_{key}"] for which in ("declared", "calibrated"))
            table.add_row(label, *map(_number, both))
    return table


def _number(value: object, digits: int = 3) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.{digits}g}" if isinstance(value, float) else str(value)


def _as_sure(value: float, sigma: float) -> str:
    """Write a number to the second digit of its sigma."""
    if not sigma > 0.0:
        return _number(value)
    decimals = max(0, 1 - math.floor(math.log10(sigma)))
    return f"{value:+.{decimals}f}"


def _float(value: object) -> float:
    return float(value) if isinstance(value, int | float) else math.nan
