"""Results in rooms of each kind: means, verdicts against algorithm 3, tables and pictures."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from algorithms_tried import MAPPED, METHODS, ML, OURS, PUBLISHED, AlgorithmOutcome
from harness import blank_figure, rms, save_picture
from paper_rooms import SCENARIOS
from scipy.stats import t as student

from magfusion.units import Array

PAPER_POSITION = dict(zip(PUBLISHED, (0.336, 0.114, 0.069), strict=True))  # m
PAPER_ATTITUDE_DEG = dict(zip(PUBLISHED, (5.62, 3.91, 2.37), strict=True))
CHANCE = 0.0027 / (len(OURS) * len(SCENARIOS))  # of each verdict


def means(outcomes: Sequence[AlgorithmOutcome], quantity: str, method: str) -> Array:
    """Return the mean error of a method in each room, shape (worlds,)."""
    return np.array([np.mean(getattr(o, quantity)[method]) for o in outcomes])


def summary(outcomes: Sequence[AlgorithmOutcome]) -> dict[str, dict[str, float]]:
    """Return mean errors of each method in one scenario, with standard errors over the rooms."""
    result = {}
    for method in outcomes[0].position:
        row = {}
        for key, quantity in (
            ("position_m", "position"),
            ("euler_deg", "euler"),
            ("geodesic_deg", "geodesic"),
        ):
            value = means(outcomes, quantity, method)
            row[key] = float(np.mean(value))
            row[key + "_se"] = standard_error(value)
        every = np.concatenate([o.position[method] for o in outcomes])
        row["position_rms_m"] = rms(every)
        result[method] = row
    return result


def standard_error(value: Array) -> float:
    """Return that of the mean of two values or more."""
    return float(np.std(value, ddof=1) / np.sqrt(len(value)))


def bounds(outcomes: Sequence[AlgorithmOutcome]) -> tuple[float, float]:
    """Return the root mean square bound of position (m) and attitude (deg) over all targets."""
    return (
        rms(np.concatenate([o.position_bound for o in outcomes])),
        rms(np.concatenate([o.attitude_bound for o in outcomes])),
    )


def worst_ratio(outcomes: Sequence[AlgorithmOutcome], method: str) -> tuple[float, float]:
    """Return a method's mean error relative to the best published one: overall, worst room."""
    ours = means(outcomes, "position", method)
    published = np.array([means(outcomes, "position", name) for name in PUBLISHED])
    overall = float(np.mean(ours) / np.mean(published, axis=1).min())
    return overall, float(np.max(ours / published.min(axis=0)))


def compared_with_algorithm_3(
    outcomes: Sequence[AlgorithmOutcome], method: str
) -> tuple[float, str]:
    """Return a method's mean error over algorithm 3's, and the verdict over the rooms.

    Better or WORSE where the mean of the differences in the same room is farther from none than
    chance has it in 0.27 % of such tables, by Student's t.
    """
    ours, others = (means(outcomes, "position", name) for name in (method, PUBLISHED[2]))
    off = ours - others
    beyond = student.isf(0.5 * CHANCE, len(off) - 1) * standard_error(off)
    verdict = "undecided" if abs(np.mean(off)) <= beyond else "better"
    if verdict == "better" and np.mean(off) > 0.0:
        verdict = "WORSE"
    return float(np.mean(ours) / np.mean(others)), verdict


def report(result: Mapping[str, Sequence[AlgorithmOutcome]], tilts: Mapping[float, float]) -> str:
    """Return the tables that a reader sees."""
    sums = {name: summary(outcomes) for name, outcomes in result.items()}
    lines = _table("position, mean (m)", sums, "position_m", PAPER_POSITION, 4)
    lines += _table("attitude, mean |Euler| (deg)", sums, "euler_deg", PAPER_ATTITUDE_DEG, 3)
    lines += _table("attitude, whole angle (deg)", sums, "geodesic_deg", {}, 3)
    lines.append("")
    if "S0" in result:
        position, attitude = bounds(result["S0"])
        rms = sums["S0"][ML]["position_rms_m"]
        lines.append(
            f"S0: Cramér-Rao bound {position:.5f} m, {attitude:.4f} deg rms;"
            f" plain ML {rms:.5f} m rms, {rms / position:.3f} of it"
        )
    lines.append("position error over algorithm 3's in the same rooms, and the verdict")
    lines.append(f"  {'':8}" + "".join(f"{name:>22}" for name in OURS))
    for name, outcomes in result.items():
        cells = ""
        for method in OURS:
            ratio, verdict = compared_with_algorithm_3(outcomes, method)
            cells += f"{f'{ratio:.2f} {verdict}':>22}"
        lines.append(f"  {name:8}{cells}")
    lines.append(
        f"{MAPPED} over the best of A1, A2, A3 in the same room, mean and worst room: "
        + ", ".join(
            f"{name} {mean:.2f} {worst:.2f}"
            for name, (mean, worst) in ((n, worst_ratio(o, MAPPED)) for n, o in result.items())
        )
    )
    lines.append(
        "plain ML in S0, mean attitude error by tilt (deg): "
        + ", ".join(f"{tilt:g}: {error:.4f}" for tilt, error in tilts.items())
    )
    return "\n".join(lines)


def _table(
    title: str,
    sums: Mapping[str, Mapping[str, Mapping[str, float]]],
    key: str,
    paper: Mapping[str, float],
    digits: int,
) -> list[str]:
    """One row a method, one column a scenario: mean, and its standard error over rooms."""
    heading = f"{'paper' if paper else '':>7}" + "".join(f"{name:>18}" for name in sums)
    lines = ["", f"{title:<30}{heading}"]
    for method in METHODS:
        printed = f"{paper[method]:7g}" if method in paper else " " * 7
        cells = ""
        for rows in sums.values():
            cell = f"{rows[method][key]:.{digits}f} ({rows[method][key + '_se']:.{digits}f})"
            cells += f"{cell:>18}"
        lines.append(f"  {method:<28}{printed}{cells}")
    return lines


def draw(directory: Path, result: Mapping[str, Sequence[AlgorithmOutcome]]) -> None:
    """Write the paper's figures 7 and 8 as a PNG, and bars of all rooms."""
    shown = "F1" if "F1" in result else next(iter(result))
    colours = {name: f"C{i}" for i, name in enumerate(METHODS)}
    figure = blank_figure(11.0, 5.2)
    panels = figure.subplots(1, 2, sharey=True)
    for axes, quantity, paper, title, label in (
        (panels[0], "position", PAPER_POSITION, "figure 7", "position error (m)"),
        (panels[1], "euler", PAPER_ATTITUDE_DEG, "figure 8", "attitude error, Eq 31 (deg)"),
    ):
        for name, colour in colours.items():
            every = np.concatenate([getattr(o, quantity)[name] for o in result[shown]])
            share = np.arange(1, len(every) + 1) / len(every)
            axes.step(np.sort(every), share, where="post", c=colour, label=name)
            axes.plot(np.mean(every), np.mean(every <= np.mean(every)), "o", c=colour)
        for name, value in paper.items():
            axes.axvline(value, c=colours[name], ls=":", label=f"paper 004, mean, {name}")
        axes.set(xscale="log", xlabel=label, title=title, ylim=(0.0, 1.0))
        axes.grid(visible=True, alpha=0.3)
    panels[0].set_ylabel("share of targets")
    figure.suptitle(f"Rooms {shown}; dots: means; dotted: means that paper 004 prints")
    handles, names = panels[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=4, fontsize=8)
    save_picture(figure, directory / "figures_7_8.png")
    _draw_bars(directory / "rooms.png", result, colours)


def _draw_bars(
    path: Path, result: Mapping[str, Sequence[AlgorithmOutcome]], colours: Mapping[str, str]
) -> None:
    figure = blank_figure(12.0, 7.0)
    axes = figure.subplots(2, 1, sharex=True)
    width = 0.8 / len(colours)
    labels = ("mean position error (m)", "mean attitude error, |Euler| (deg)")
    for axis, quantity, label in zip(axes, ("position", "euler"), labels, strict=True):
        for i, (name, colour) in enumerate(colours.items()):
            per_world = [means(outcomes, quantity, name) for outcomes in result.values()]
            place = np.arange(len(result)) + (i - 0.5 * (len(colours) - 1)) * width
            error = [standard_error(v) for v in per_world]
            height = [float(np.mean(v)) for v in per_world]
            axis.bar(place, height, width, color=colour, yerr=error, label=name)
        axis.set(yscale="log", ylabel=label)
        axis.grid(visible=True, axis="y", alpha=0.3)
    axes[1].set_xticks(np.arange(len(result)), list(result))
    handles, names = axes[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside upper center", ncols=len(colours), fontsize=8)
    save_picture(figure, path)
