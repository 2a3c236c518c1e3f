"""The screen of a result in about eight lines: what a navigator decides by, and what to do next.

``--verbose`` shows all other figures, as the page of a result does.
"""

from pathlib import Path

from magfusion.model.trust import CORRECTED, Verdict
from magfusion.results.brief_plan import (
    accuracy,
    bounds,
    coverage_lines,
    is_coverage,
    is_design,
    length,
    plan_lines,
)
from magfusion.results.drift import QUANTITIES
from magfusion.results.figures import Figures, ParameterEstimate, Section, number
from magfusion.results.shown import as_sure, axis_rows, findings, number_text, sentences
from magfusion.results.verdict import look_of

Rows = list[list[str]]
# Remarks that require no action.
_ROUTINE = {"noise_tuned"}
MAX_LISTED = 2  # fixed parameters
_MATTERS = 0.5  # of the sigma of a pose; smaller effects of fixed parameters are only counted
# Criteria of stability, where the key is no term of a navigator.
_CRITERIA = {"carried": "error between fields", "lost": "tracking without loss"}
_NEXT = {
    Verdict.TRUSTWORTHY: "magfusion view {output}, or open {output}/report.html",
    Verdict.DOUBTFUL: "remove the cause above and repeat; until then the sigmas cover it",
    Verdict.FAILED: "remove the cause above and repeat; for diagnosis open {output}/failed",
}
_AFTER_CORRECTION = "check the correction, then use it: --site {output}/site.yaml"
_NEXT_OF = {
    ("check", Verdict.TRUSTWORTHY): "magfusion smooth LOG",
    ("check", Verdict.DOUBTFUL): "remove the cause above, then magfusion smooth LOG",
    ("check", Verdict.FAILED): "remove the cause above, then check again",
    ("drift", Verdict.TRUSTWORTHY): "magfusion view {output}, or open {output}/stability.png",
    ("drift", Verdict.DOUBTFUL): "run longer (--hours) or more worlds (--worlds 8)",
    ("drift", Verdict.FAILED): "open {output}/drift.png; the first failed line is the cause",
    ("calibrate log", Verdict.TRUSTWORTHY): "magfusion smooth LOG --site {output}/site.yaml",
    ("simulate", Verdict.TRUSTWORTHY): "magfusion smooth {output}",
    (
        "coverage",
        Verdict.TRUSTWORTHY,
    ): "open {output}/coverage.png; to choose places of beacons, magfusion design SITE",
    (
        "coverage",
        Verdict.FAILED,
    ): "magfusion design SITE with the same --need; open {output}/coverage.png",
    (
        "design",
        Verdict.TRUSTWORTHY,
    ): "magfusion sheet {output}/site.yaml, or open {output}/design.png",
    (
        "design",
        Verdict.FAILED,
    ): "improve what limits, or raise --need; open {output}/error_budget.png",
}


def is_brief(figures: Figures) -> bool:
    """Return whether a result has a screen of a few lines."""
    has_axes = bool(figures.of(Section.AXES))
    is_plan = is_design(figures) or is_coverage(figures) or _is_site(figures)
    return has_axes or is_plan or figures.get("job") in ("check", "drift")


def remark_texts(figures: Figures, *, routine: bool) -> list[str]:
    """Return the remarks, with or without those that require no action."""
    rows = findings(figures, "remarks")
    return [str(one["text"]) for one in rows if routine or one["code"] not in _ROUTINE]


def table(figures: Figures) -> Rows:
    """Return the table of a result, its head first; empty without one."""
    if is_design(figures):
        return accuracy(figures)
    if is_coverage(figures):
        return bounds(figures)
    if _is_site(figures):
        return _changes(figures)
    return _slopes(figures) if figures.get("job") == "drift" else axis_rows(figures)


def lines(figures: Figures) -> Rows:
    """Return the other lines of a result, each as its label and text."""
    if is_design(figures):
        return plan_lines(figures)
    if is_coverage(figures):
        return coverage_lines(figures)
    if figures.get("job") == "drift":
        return _criteria(figures)
    if _is_site(figures):
        return [*_pose_rows(figures), *_directions(figures)]
    return _pose_rows(figures) if figures.of(Section.AXES) else _check_rows(figures)


def next_step(figures: Figures, output: Path | None) -> str:
    """Return what to do next; empty where nothing is written, or nothing is judged."""
    if not ("verdict" in figures or is_design(figures) or is_coverage(figures)):
        return ""
    look = look_of(str(figures.get("verdict", Verdict.TRUSTWORTHY)))
    text = _NEXT_OF.get((str(figures.get("job")), look), _NEXT[look])
    corrected = any(CORRECTED in str(one["text"]) for one in findings(figures, "reasons"))
    if corrected and look is Verdict.DOUBTFUL:
        text = _AFTER_CORRECTION
    return text.format(output=output) if output is not None or "{output}" not in text else ""


def _pose_rows(figures: Figures) -> Rows:
    level_m, level_deg = (figures.get(f"protection_level_median_{unit}") for unit in ("m", "deg"))
    rows = []
    if "protection_level_median_m" in figures:
        level = "none" if level_m is None else length(number(level_m))
        level += "" if level_deg is None else f", {number_text(level_deg, 2)} deg"
        cause = figures.get("protection_level_cause")
        explained = any(one["code"] == "no_redundancy" for one in findings(figures, "remarks"))
        cause = None if explained and level_m is None else cause
        rows.append(["protection level", f"{level} ({cause})" if cause else level])
    spent = f"{figures['epochs']} epochs" if "epochs" in figures else ""
    if "duration_s" in figures:
        spent += f" in {number_text(figures['duration_s'])} s"
    if "nees_mean" in figures:
        within = 100.0 * number(figures["inside_3_sigma"])
        nees = next(figure for figure in figures.all if figure.name == "nees_mean")
        expected = nees.label.removeprefix("mean NEES ")
        spent += f"; NEES {number_text(nees.value, 2)} {expected}, {within:.3g} % within 3 sigma"
    rows.append(["consistency" if "nees_mean" in figures else "data", spent])
    rows += [["survey", f.remark] for f in figures.all if f.name == "hypotheses_{beacon}"]
    unverified = _unverified(figures)
    return [*rows, ["not observable", unverified]] if unverified else rows


def _unverified(figures: Figures) -> str:
    """Return the fixed parameters of most effect on a pose, and the number of the others."""
    rows = findings(figures, "unverified")
    if not figures.of(Section.AXES):
        return ", ".join(str(one["parameter"]) for one in rows)
    part = {"m": ("x", "y", "z"), "deg": ("rot_x", "rot_y", "yaw")}
    total = {
        unit: sum(number(figures.get(f"sigma_{axis}_{unit}")) ** 2 for axis in axes) ** 0.5
        for unit, axes in part.items()
    }
    effect = {
        str(one["parameter"]): max(
            float(one[key]) / total[unit] if total[unit] else 0.0
            for key, unit in (("position_m", "m"), ("rotation_deg", "deg"))
        )
        for one in rows
    }
    rows.sort(key=lambda one: -effect[str(one["parameter"])])
    matters = [one for one in rows[:MAX_LISTED] if effect[str(one["parameter"])] > _MATTERS]
    words = [
        f"{one['parameter']} (± {one['sigma']} moves poses by {length(float(one['position_m']))},"
        f" {number_text(one['rotation_deg'], 2)} deg)"
        for one in matters
    ]
    others = len(rows) - len(matters)
    return ", ".join([*words, f"{others} of smaller effect (--verbose)"] if others else words)


def _is_site(figures: Figures) -> bool:
    """Return whether a result is a site that one log refined."""
    return bool(figures.of(Section.DIRECTIONS)) and not figures.of(Section.LOGS)


def _changes(figures: Figures) -> Rows:
    """Return the largest change of each beacon and sensor, by its declared sigma."""
    owners: dict[str, list[ParameterEstimate]] = {}
    for one in figures.all:
        if isinstance(one, ParameterEstimate):
            owners.setdefault(one.beacon or one.key.split(".")[0], []).append(one)
    rows = [["", "largest change", "declared", "determined"]]
    for owner, own in owners.items():
        # Parameters without a declared sigma have no change to compare.
        one = max(own, key=lambda e: abs(e.change) / e.prior_sigma if e.prior_sigma else 0.0)
        sigma = number_text(one.sigma, 2)
        change = f"{one.key.removeprefix(f'{owner}.')} {as_sure(one.change, one.sigma)} ± {sigma}"
        declared = f"± {number_text(one.prior_sigma, 2)}" if one.prior_sigma else "not known"
        rows.append([owner, change, declared, f"{sum(e.determined for e in own)} of {len(own)}"])
    return rows


def _directions(figures: Figures) -> Rows:
    """Return how much is determined, and of what is not the first of each kind."""
    rows = []
    for figure in figures.of(Section.DIRECTIONS):
        if not isinstance(figure.value, list):
            rows.append(["directions", *sentences(figure)])
        elif figure.value:
            others = len(figure.value) - 1
            more = f" ({others} more: --verbose)" if others else ""
            rows.append([figure.label or "open", f"{figure.value[0]}{more}"])
    return rows


def _check_rows(figures: Figures) -> Rows:
    rows = []
    for stream in ("imu", "magnetometer"):
        if f"{stream}_rate_hz" in figures:
            rate, span, jitter = (
                number_text(figures.get(f"{stream}_{key}"))
                for key in ("rate_hz", "duration_s", "jitter_ms")
            )
            lost_percent = 100.0 * number(figures.get(f"{stream}_lost_share"))
            rows.append(
                [stream, f"{rate} Hz for {span} s, jitter {jitter} ms, {lost_percent:.2g} % lost"]
            )
    if "gravity_m_s2" in figures:
        text = f"mean specific force {number_text(figures['gravity_m_s2'])} m/s^2"
        if "steady_field_ut" in figures:
            text += (
                f", static field {number_text(figures['steady_field_ut'])} uT at"
                f" {number_text(figures['field_from_vertical_deg'])} deg from the vertical"
            )
        rows.append(["gravity and field", text])
    snr = {f.beacon: f.value for f in figures.all if f.name == "snr_{beacon}"}
    share = {f.beacon: number(f.value) for f in figures.all if f.name == "heard_{beacon}"}
    words = [f"{n} {number_text(v)} in {100.0 * share[n]:.3g} %" for n, v in snr.items()]
    if words:
        rows.append(["signal to noise", f"{', '.join(words)} of the epochs"])
    if figures.get("fix_epochs"):
        residual = number_text(figures["fix_residual_rms"])
        rows.append(["first fixes", f"{figures['fix_epochs']}, residual {residual} (1 expected)"])
    if "corrected" in figures:
        rows.append(["corrected", str(figures["corrected"])])
    return rows


def _estimators(figures: Figures) -> list[str]:
    return [name for name in ("ekf", "smoother") if f"{name}_lost_verdict" in figures]


def _slopes(figures: Figures) -> Rows:
    """Return the growth of each error per day, with its sigma and bound."""
    rows = [["", "rms", "slope a day", "its sigma", "bound", ""]]
    for name in _estimators(figures):
        for one in QUANTITIES:
            key = f"{name}_{one.name}"
            values = (
                figures.get(f"{key}_rms_{one.unit}"),
                figures.get(f"{key}_slope_{one.unit}_per_day"),
                figures.get(f"{key}_slope_standard_error"),
                one.limit,
            )
            label = f"{name} {one.name.replace('_', ' ')} ({one.symbol})"
            verdict = str(figures.get(f"{key}_drift_verdict", ""))
            rows.append([label, *(number_text(value) for value in values), verdict])
    return rows


def _criteria(figures: Figures) -> Rows:
    """Return the other criteria of each estimator, by their verdict."""
    rows = []
    slopes = {f"{one.name}_drift" for one in QUANTITIES}
    for name in _estimators(figures):
        verdicts: dict[str, list[str]] = {}
        for key, value in figures.items():
            criterion = key.removeprefix(f"{name}_").removesuffix("_verdict")
            if key == f"{name}_{criterion}_verdict" and criterion not in slopes:
                shown = _CRITERIA.get(criterion, criterion.replace("_", " "))
                verdicts.setdefault(str(value), []).append(shown)
        listed = "; ".join(f"{verdict}: {', '.join(own)}" for verdict, own in verdicts.items())
        rows.append([f"{name}, other criteria", listed])
        given = [one for one in figures.all if one.name == f"{name}_reported"]
        rows += [[f"{name} reports", text] for one in given for text in sentences(one)]
    return rows
