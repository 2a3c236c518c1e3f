"""How far is far: the error of the dipole for coils of true size, and the term that repairs it.

Paper 000 takes coils for dipoles "usually beyond 1.5 times" their size.  The scenario couples
circular and square coils exactly (Neumann's double integral of mutual inductance), solves for the
pose with dipoles, and again with one term for the coils' size, ``1 - kappa d^2/dn^2``:

1. At 1.5 sizes the dipole's attitude is wrong by tens of degrees.  The error falls with the square
   of the distance: half a degree at ten sizes, a tenth at twenty to thirty.
2. With the term it is a hundredth of a degree (circles) or three (squares) at five sizes, and at
   most two thousandths at ten.
3. A calibration at poses five sizes away finds the two constants by itself, within a per cent
   (`magfusion.calibration.antenna`).
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from harness import between_deg, blank_figure, conclude, rms, save_picture, scenario_parser
from scipy.spatial.transform import Rotation
from tracker_poses import refine_poses

from magfusion.calibration.antenna import AntennaSurvey, fit_at_known_poses, prior_sigma
from magfusion.model.antenna import KAPPAS, Antenna
from magfusion.model.physics.finite_size import disc_kappa, square_kappa
from magfusion.papers.p000_tracker.pose import locate_by_svd
from magfusion.units import MU0_OVER_4PI, Array

SIZE = 0.06  # m; of the transmitting coil, diameter or side


@dataclass(frozen=True)
class Config:
    """Distances in sizes of the transmitting coil, and the receiving coil's share of that size."""

    ratios: tuple[float, ...] = (1.5, 3.0, 5.0, 10.0, 15.0, 20.0, 30.0)
    receivers: tuple[float, ...] = (1.0, 0.4)
    poses: int = 40
    seed: int = 0


@dataclass(frozen=True)
class Row:
    """Attitude errors at one distance (deg), with the dipole and with the coils' size."""

    shape: str
    receiver: float
    ratio: float
    dipole_deg: float
    dipole_max_deg: float
    sized_deg: float | None  # None where the first term of the size does not even converge
    range_error: float  # relative, of the dipole


def circle(size: float, number: int = 48) -> tuple[Array, Array]:
    """Return points and line elements (n, 3) of a circle of a diameter about z (m)."""
    angle = 2.0 * np.pi * np.arange(number) / number
    zero = np.zeros(number)
    points = 0.5 * size * np.stack([np.cos(angle), np.sin(angle), zero], axis=1)
    along = np.pi * size / number * np.stack([-np.sin(angle), np.cos(angle), zero], axis=1)
    return points, along


def square(size: float, number: int = 12) -> tuple[Array, Array]:
    """Return points and line elements (n, 3) of a square of a side about z (m)."""
    nodes, weights = np.polynomial.legendre.leggauss(number)
    edge = 0.5 * size * np.stack([np.ones(number), nodes, np.zeros(number)], axis=1)
    step = 0.5 * size * weights[:, None] * np.array([0.0, 1.0, 0.0])
    turns = Rotation.from_rotvec(np.outer(np.arange(4), [0.0, 0.0, np.pi / 2.0])).as_matrix()
    points, along = (np.concatenate([v @ turn.T for turn in turns]) for v in (edge, step))
    return points, along


SHAPES: dict[str, Callable[[float], tuple[Array, Array]]] = {"circle": circle, "square": square}
AREA = {"circle": np.pi / 4.0, "square": 1.0}  # of size one
KAPPA: dict[str, Callable[[float], float]] = {
    "circle": lambda size: disc_kappa(0.5 * size),
    "square": square_kappa,
}


def about_axes(curve: tuple[Array, Array]) -> tuple[Array, Array]:
    """Return the curve about x, y and z, shape (3, n, 3)."""
    cycles = [np.eye(3)[[2, 0, 1]], np.eye(3)[[1, 2, 0]], np.eye(3)]  # z to x, to y, to z
    points, along = (np.stack([v @ turn.T for turn in cycles]) for v in curve)
    return points, along


def exact_couplings(
    shape: str, receiver: float, beacon_from_sensor: Array, position_beacon: Array
) -> Array:
    """Return the mean field in each receiving coil for unit moments, by Neumann (T per A m^2)."""
    sent, sent_along = about_axes(SHAPES[shape](SIZE))
    seen, seen_along = about_axes(SHAPES[shape](receiver * SIZE))
    out = np.empty((len(position_beacon), 3, 3))
    for n, (turn, place) in enumerate(zip(beacon_from_sensor, position_beacon, strict=True)):
        there, there_along = place + seen @ turn.T, seen_along @ turn.T
        for i in range(3):
            for j in range(3):
                separate = np.linalg.norm(there[i][:, None] - sent[j][None], axis=-1)
                out[n, i, j] = np.sum(there_along[i] @ sent_along[j].T / separate)
    areas = AREA[shape] * SIZE**2 * AREA[shape] * (receiver * SIZE) ** 2
    return np.asarray(MU0_OVER_4PI * out / areas)


def random_poses(config: Config, ratio: float) -> tuple[Array, Array]:
    """Return attitudes and positions in all directions at one distance."""
    rng = np.random.default_rng(config.seed)
    direction = rng.standard_normal((config.poses, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return Rotation.random(config.poses, rng=rng).as_matrix(), ratio * SIZE * direction


def ideal(shape: str, receiver: float) -> Antenna:
    """Return antennas of unit moments whose coils have the size."""
    eye, zero, kappa = np.eye(3), np.zeros((3, 3)), KAPPA[shape]
    sent = np.full(3, kappa(SIZE))
    return Antenna(eye, zero, eye, zero, sent, np.array(kappa(receiver * SIZE)))


def run_row(config: Config, shape: str, receiver: float, ratio: float) -> Row:
    """Solve at one distance with dipoles and with the coils' size."""
    attitude, position = random_poses(config, ratio)
    seen = exact_couplings(shape, receiver, attitude, position)
    start = locate_by_svd(seen).nearest(position)
    result = np.swapaxes(start.sensor_from_beacon, -1, -2)
    error = between_deg(result, attitude)
    sized = None
    if ratio >= 3.0:
        antenna = ideal(shape, receiver)
        refined, _ = refine_poses(antenna, seen, result, start.position_beacon[:, 0])
        sized = rms(between_deg(refined, attitude))
    return Row(
        shape=shape,
        receiver=receiver,
        ratio=ratio,
        dipole_deg=rms(error),
        dipole_max_deg=float(np.max(error)),
        sized_deg=sized,
        range_error=rms(start.distance / (ratio * SIZE) - 1.0),
    )


def run(config: Config) -> tuple[Row, ...]:
    """Solve for all shapes, sizes and distances."""
    return tuple(
        run_row(config, shape, receiver, ratio)
        for shape in SHAPES
        for receiver in config.receivers
        for ratio in config.ratios
    )


def slope(rows: tuple[Row, ...], shape: str = "circle", receiver: float = 1.0) -> float:
    """Return the power of the distance with which the dipole's error falls, from 5 to 30 sizes."""
    chosen = [r for r in rows if (r.shape, r.receiver) == (shape, receiver) and r.ratio >= 5.0]
    logs = np.log([(r.ratio, r.dipole_deg) for r in chosen])
    return float(np.polyfit(logs[:, 0], logs[:, 1], 1)[0])


def learn_sizes(config: Config, ratio: float = 5.0, receiver: float = 0.4) -> tuple[float, float]:
    """Return the constants that a calibration finds, relative to those of circles."""
    attitude, position = random_poses(config, ratio)
    seen = exact_couplings("circle", receiver, attitude, position)
    sigma = np.full(len(seen), 1e-4 * MU0_OVER_4PI / (ratio * SIZE) ** 3)
    truth = ideal("circle", receiver)
    eye, zero = np.eye(3), np.zeros((3, 3))
    start = Antenna(eye, zero, eye, zero, np.zeros(3), np.zeros(()))
    survey = AntennaSurvey(attitude, position, seen, sigma)
    result = fit_at_known_poses(survey, start, prior_sigma(start, gain=0.005, kappa=1e-3)).antenna
    share = result.vector()[KAPPAS] / truth.vector()[KAPPAS]
    return float(np.mean(share[:3])), float(share[3])


def report(rows: tuple[Row, ...]) -> str:
    """Return the table that a reader sees."""
    lines = [
        "attitude error (deg), dipole: RMS (max) -> with the coils' size",
        f"{'R/L':>5}" + "".join(f"{f'{s}, Lr = {k:g} Lt':>30}" for s, k in _columns(rows)),
    ]
    for ratio in dict.fromkeys(row.ratio for row in rows):
        cells = ""
        for column in _columns(rows):
            row = next(r for r in rows if (r.shape, r.receiver) == column and r.ratio == ratio)
            sized = "-" if row.sized_deg is None else f"{row.sized_deg:.4f}"
            cells += f"{row.dipole_deg:12.3f} ({row.dipole_max_deg:6.2f}) ->{sized:>7}"
        lines.append(f"{ratio:5g}{cells}")
    return "\n".join(lines)


def _columns(rows: tuple[Row, ...]) -> list[tuple[str, float]]:
    return list(dict.fromkeys((row.shape, row.receiver) for row in rows))


def draw(path: Path, rows: tuple[Row, ...]) -> None:
    """Write a PNG of the errors over the distance."""
    figure = blank_figure(7.0, 4.5)
    axes = figure.subplots()
    for number, (shape, receiver) in enumerate(_columns(rows)):
        own = [r for r in rows if (r.shape, r.receiver) == (shape, receiver)]
        ratio = [r.ratio for r in own]
        name = f"{shape}, Lr = {receiver:g} Lt"
        axes.loglog(ratio, [r.dipole_deg for r in own], "o-", c=f"C{number}", label=name)
        sized = [np.nan if r.sized_deg is None else r.sized_deg for r in own]
        axes.loglog(ratio, sized, "x--", c=f"C{number}")
    axes.axvline(1.5, color="0.5", linestyle=":")
    axes.set(xlabel="distance / coil size", ylabel="attitude error, RMS (deg)")
    axes.set_title("Dipole (full lines), with the coils' size (dashed); dotted: the paper's rule")
    axes.legend()
    save_picture(figure, path)


def main() -> None:
    """Print the table and one JSON line; draw it where a directory is given."""
    given = scenario_parser(__doc__, Config.seed).parse_args()
    config = Config(seed=given.seed)
    rows, learnt = run(config), learn_sizes(config)
    if given.output is not None:
        draw(given.output / "tracker_near_field.png", rows)
    text = (
        f"{report(rows)}\nslope from 5 to 30 sizes: {slope(rows):.2f}\n"
        f"kappa that a calibration at 5 sizes finds, relative: {learnt[0]:.3f}, {learnt[1]:.3f}"
    )
    conclude(text, {"rows": rows, "slope": slope(rows), "kappa": learnt})


if __name__ == "__main__":
    main()
