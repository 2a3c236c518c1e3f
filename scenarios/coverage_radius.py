"""How far one beacon reaches: paper 004, figure 6, and what its 20 metres are.

The paper simulates the variance of the direction that Eq 7 finds, sees it "grow quickly" beyond
20 m and calls that the radius of coverage (14 m in its experiments).  It names 3 nT of white noise
and neither the moment nor how many samples make a direction.  The scenario simulates the mean
square of the angle between found and true direction, at a known attitude, and answers:

1. Where does it grow quickly?  Everywhere, with the sixth power of the range (the law, first
   order in the noise) until it nears a random direction's: there is no knee, only a threshold.
2. What threshold makes 20 m?  One degree rms takes 115 A m^2 and a minute and a half of samples;
   65 A m^2 and the 200 samples of one second reach less than 8 m.
3. And the tensor method, which uses both phasors and not their normal alone?  At 45 degrees from
   the beacon's axis it needs a third of the samples, at 80 degrees an eighty-fifth.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from harness import blank_figure, conclude, save_picture, scenario_parser
from tensor_fix import locate_by_tensor

from magfusion.model.site import Beacon, BeaconSigma, Coil
from magfusion.papers.p004_fingerprints.equations import eq_07_direction
from magfusion.receiver.ellipse import plane_normal
from magfusion.simulation.field import phasors_world
from magfusion.units import DEGREE, MU0_OVER_4PI, NANOTESLA, Array, ComplexArray

PAPER_RADIUS = 20.0  # m, figure 6
PAPER_RADIUS_MEASURED = 14.0  # m, section 3.1
METHODS = ("Eq 7", "tensor")
RANGES = (10.0, 12.0, 14.0, 16.0, 18.0, 20.0, 22.0, 25.0, 30.0, 40.0)  # m
CASES = ((65.0, 200), (115.0, 12_000), (115.0, 30_000))  # moment (A m^2), samples


@dataclass(frozen=True)
class Config:
    """Noise, frequency and numbers of runs."""

    sample_sigma_nt: float = 3.0  # nT, each axis
    quantisation_nt: float = 0.1  # nT, of the raw samples
    rate_hz: float = 200.0
    frequency_hz: float = 25.0
    polar_deg: float = 45.0
    runs: int = 20_000
    raw_runs: int = 4000
    seed: int = 1

    def sigma(self, samples: int) -> float:
        """Return what averaging leaves on each component of a phasor (T)."""
        return float(self.sample_sigma_nt * NANOTESLA * np.sqrt(2.0 / samples))


@dataclass(frozen=True)
class Curve:
    """Mean squares of the direction's error (deg^2) over the range, at one moment and averaging."""

    moment: float  # A m^2
    samples: int
    eq7: tuple[float, ...]
    tensor: tuple[float, ...]
    law_eq7: tuple[float, ...]  # to first order in the noise
    radius_eq7: float  # m; where the law says one degree rms
    radius_tensor: float
    samples_at_20m: float  # for one degree rms by Eq 7
    samples_at_14m: float


@dataclass(frozen=True)
class AtTwenty:
    """One direction from the axis, 20 m away, 115 A m^2, 12000 samples (deg^2)."""

    polar_deg: float
    eq7: float
    tensor: float
    coefficient_eq7: float  # of (sigma r^3 / K m)^2, to first order
    coefficient_tensor: float


@dataclass(frozen=True)
class Raw:
    """The same place from simulated samples and from phasors with the exact law of the noise."""

    samples: tuple[float, float]  # Eq 7, tensor (deg^2)
    phasors: tuple[float, float]
    relative_error: tuple[float, float]  # of their ratio to one, one sigma


@dataclass(frozen=True)
class RadiusOutcome:
    """Everything that is printed."""

    curves: tuple[Curve, ...]
    at_twenty: tuple[AtTwenty, ...]
    raw: Raw


def beacon(moment: float, frequency_hz: float) -> Beacon:
    """Return a beacon at the origin that turns about z."""
    coils = (Coil(np.array([moment, 0.0, 0.0])), Coil(np.array([0.0, moment, 0.0]), -np.pi / 2.0))
    known = BeaconSigma(np.zeros(3), np.zeros(3), np.zeros(2))
    return Beacon("M1", np.zeros(3), np.eye(3), frequency_hz, coils, True, known)


def direction(polar_deg: float) -> Array:
    """Return the unit vector so far from the beacon's axis, at an azimuth without symmetry."""
    polar, azimuth = polar_deg * DEGREE, 0.4
    flat = np.sin(polar)
    return np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), np.cos(polar)])


def noisy(phasor: ComplexArray, sigma: float, runs: int, rng: np.random.Generator) -> ComplexArray:
    """Return phasors with white noise on every component, shape (runs, 3)."""
    noise = rng.normal(0.0, sigma, (2, runs, 3))
    return np.asarray(phasor + noise[0] + 1j * noise[1])


def from_samples(
    phasor: ComplexArray, samples: int, config: Config, rng: np.random.Generator
) -> ComplexArray:
    """Return phasors by least squares from simulated samples, shape (runs, 3)."""
    turns = 2.0 * np.pi * config.frequency_hz / config.rate_hz * np.arange(samples)
    design = np.column_stack([np.cos(turns), -np.sin(turns), np.ones(samples)])
    solve = np.linalg.pinv(design)
    clean = np.real(phasor * np.exp(1j * turns)[:, None])
    result = np.empty((config.raw_runs, 3), dtype=np.complex128)
    step = config.quantisation_nt * NANOTESLA
    for run in result:
        wave = clean + rng.normal(0.0, config.sample_sigma_nt * NANOTESLA, clean.shape)
        cosine, sine, _ = solve @ (step * np.round(wave / step))
        run[:] = cosine + 1j * sine
    return result


def square_angles(source: Beacon, phasor: ComplexArray, true: Array) -> tuple[Array, Array]:
    """Return the squared error of the direction by Eq 7 and by the tensor (deg^2), each (runs,)."""
    by_tensor = locate_by_tensor(source, phasor[:, None]).direction_beacon
    return (
        between_deg(eq_07_direction(plane_normal(phasor)), true) ** 2,
        between_deg(by_tensor, true) ** 2,
    )


def between_deg(result: Array, true: Array) -> Array:
    """Return the angle between unit vectors (deg)."""
    across = np.linalg.norm(np.cross(result, true), axis=-1)
    return np.asarray(np.arctan2(across, result @ true) / DEGREE)


def coefficients(polar_deg: float) -> tuple[float, float]:
    """Return c of ``c (sigma r^3 / K m)^2`` (rad^2) by Eq 7 and by the tensor, to first order.

    Central differences of the methods themselves at a field of unit size.
    """
    source, true = beacon(1.0 / MU0_OVER_4PI, 25.0), direction(polar_deg)
    step = 1e-6
    steps = step * np.concatenate([np.eye(3), 1j * np.eye(3)])
    phasor = phasors_world(source, true[None])[0, 0] + np.concatenate([steps, -steps])
    result = (
        eq_07_direction(plane_normal(phasor)),
        locate_by_tensor(source, phasor[:, None]).direction_beacon,
    )
    slopes = [(f[:6] - f[6:]) / (2.0 * step) for f in result]
    first, second = (float(np.sum(slope**2)) for slope in slopes)
    return first, second


def relative_noise(config: Config, moment: float, samples: int, range_m: float) -> float:
    """Return ``sigma r^3 / (K m)``."""
    return config.sigma(samples) * range_m**3 / (MU0_OVER_4PI * moment)


def curve(config: Config, moment: float, samples: int, rng: np.random.Generator) -> Curve:
    """Simulate one curve of figure 6."""
    source, true = beacon(moment, config.frequency_hz), direction(config.polar_deg)
    means = []
    for range_m in RANGES:
        clean = phasors_world(source, range_m * true[None])[0, 0]
        seen = noisy(clean, config.sigma(samples), config.runs, rng)
        means.append([float(np.mean(s)) for s in square_angles(source, seen, true)])
    c = [value / DEGREE**2 for value in coefficients(config.polar_deg)]
    noise = np.array([relative_noise(config, moment, samples, r) for r in RANGES])
    at_one_metre = relative_noise(config, moment, samples, 1.0)
    eq7, tensor = zip(*means, strict=True)
    needed = [
        c[0] * relative_noise(config, moment, 1, r) ** 2
        for r in (PAPER_RADIUS, PAPER_RADIUS_MEASURED)
    ]
    return Curve(
        moment=moment,
        samples=samples,
        eq7=eq7,
        tensor=tensor,
        law_eq7=tuple((c[0] * noise**2).tolist()),
        radius_eq7=float((np.sqrt(c[0]) * at_one_metre) ** (-1.0 / 3.0)),
        radius_tensor=float((np.sqrt(c[1]) * at_one_metre) ** (-1.0 / 3.0)),
        samples_at_20m=needed[0],
        samples_at_14m=needed[1],
    )


def at_twenty(config: Config, polar_deg: float, rng: np.random.Generator) -> AtTwenty:
    """Simulate one direction, 20 m away."""
    source, true = beacon(115.0, config.frequency_hz), direction(polar_deg)
    clean = phasors_world(source, PAPER_RADIUS * true[None])[0, 0]
    seen = noisy(clean, config.sigma(12_000), config.runs, rng)
    eq7, tensor = (float(np.mean(s)) for s in square_angles(source, seen, true))
    return AtTwenty(polar_deg, eq7, tensor, *coefficients(polar_deg))


def raw(config: Config, rng: np.random.Generator) -> Raw:
    """Simulate acceptance figure R1 twice: sample by sample, and by the law of the noise."""
    source, true = beacon(115.0, config.frequency_hz), direction(config.polar_deg)
    clean = phasors_world(source, PAPER_RADIUS * true[None])[0, 0]
    result = (
        square_angles(source, from_samples(clean, 12_000, config, rng), true),
        square_angles(source, noisy(clean, config.sigma(12_000), config.runs, rng), true),
    )
    means = np.array([[np.mean(s) for s in pair] for pair in result])
    errors = np.array([[np.std(s) / np.sqrt(len(s)) for s in pair] for pair in result])
    spread = np.linalg.norm(errors / means, axis=0)
    return Raw(
        samples=(float(means[0, 0]), float(means[0, 1])),
        phasors=(float(means[1, 0]), float(means[1, 1])),
        relative_error=(float(spread[0]), float(spread[1])),
    )


def run(config: Config) -> RadiusOutcome:
    """Simulate all curves."""
    curve_rng, polar_rng, raw_rng = np.random.default_rng(config.seed).spawn(3)
    return RadiusOutcome(
        curves=tuple(curve(config, m, n, curve_rng) for m, n in CASES),
        at_twenty=tuple(at_twenty(config, p, polar_rng) for p in (5.0, 35.3, 45.0, 75.0, 80.0)),
        raw=raw(config, raw_rng),
    )


def report(outcomes: RadiusOutcome) -> str:
    """Return the tables that a reader sees."""
    lines = ["Mean square of the direction's error (deg^2), 45 deg from the beacon's axis, 3 nT"]
    lines.append(f"{'range (m)':>32}" + "".join(f"{r:9g}" for r in RANGES) + f"{'1 deg at':>11}")
    for result in outcomes.curves:
        name = f"{result.moment:g} A m^2, {result.samples}"
        for label, row, end in (
            ("Eq 7", result.eq7, f"{result.radius_eq7:9.1f} m"),
            ("law", result.law_eq7, ""),
            ("tensor", result.tensor, f"{result.radius_tensor:9.1f} m"),
        ):
            cells = "".join(f"{value:9.3g}" for value in row)
            lines.append(f" {name:>20}{label:>11}{cells}{end}")
            name = ""
    lines.append(
        "Samples for one degree rms by Eq 7 at 20 m (the paper's radius) and 14 m (it used)"
    )
    for moment, result in {c.moment: c for c in outcomes.curves}.items():
        wanted = f"{result.samples_at_20m:8.0f} and {result.samples_at_14m:6.0f}"
        lines.append(f" {moment:g} A m^2: {wanted}")
    lines.append("20 m, 115 A m^2, 12000 samples (deg^2; and coefficient of the law)")
    lines.append(f"{'from the axis (deg)':>22}{'Eq 7':>18}{'tensor':>18}{'ratio':>8}")
    for row in outcomes.at_twenty:
        pairs = f"{row.eq7:9.3g} ({row.coefficient_eq7:6.3g})"
        pairs += f"{row.tensor:9.3g} ({row.coefficient_tensor:6.3g})"
        ratio = row.coefficient_eq7 / row.coefficient_tensor
        lines.append(f"{row.polar_deg:22g}{pairs}{ratio:8.1f}")
    both = outcomes.raw
    lines.append(
        f"Simulated samples {both.samples[0]:.3f} and {both.samples[1]:.3f}, phasors"
        f" {both.phasors[0]:.3f} and {both.phasors[1]:.3f}: within"
        f" {100 * both.relative_error[0]:.1f} and {100 * both.relative_error[1]:.1f} %"
        " (one sigma)"
    )
    return "\n".join(lines)


def draw(path: Path, outcomes: RadiusOutcome) -> None:
    """Write a PNG of the curves with the paper's radii."""
    figure = blank_figure(8.0, 5.5)
    axes = figure.subplots()
    for colour, result in zip(("tab:red", "tab:blue", "tab:green"), outcomes.curves, strict=True):
        name = f"{result.moment:g} A m², {result.samples} samples"
        axes.plot(RANGES, result.eq7, "o-", color=colour, label=f"{name}: Eq 7")
        axes.plot(RANGES, result.tensor, "s--", color=colour, label=f"{name}: tensor")
        axes.plot(RANGES, result.law_eq7, ":", color=colour, linewidth=1.0)
    axes.axhline(1.0, color="0.4", linewidth=0.8)
    axes.text(40.0, 1.15, "one degree rms", color="0.3", fontsize=8, ha="right")
    for place, name in (
        (PAPER_RADIUS, "paper, simulated"),
        (PAPER_RADIUS_MEASURED, "paper, measured"),
    ):
        axes.axvline(place, color="0.4", linewidth=0.8)
        axes.text(place + 0.2, 1.5e4, name, rotation=90, color="0.3", fontsize=8, va="top")
    axes.set(
        yscale="log",
        ylim=(2e-3, 2e4),
        xlabel="range (m)",
        ylabel="mean square of the direction's error (deg²)",
        title="Reach of one beacon, 45° from its axis; dotted: Eq 7 to first order",
    )
    axes.legend(fontsize=8, loc="lower right")
    save_picture(figure, path)


def main() -> None:
    """Print the tables and one JSON line; draw them where a directory is given."""
    given = scenario_parser(__doc__, Config.seed, "a tenth of the runs").parse_args()
    share = 10 if given.quick else 1
    runs, raw_runs = Config.runs // share, Config.raw_runs // share
    outcomes = run(Config(seed=given.seed, runs=runs, raw_runs=raw_runs))
    if given.output is not None:
        draw(given.output / "coverage_radius.png", outcomes)
    conclude(report(outcomes), {"ranges": RANGES, **vars(outcomes)})


if __name__ == "__main__":
    main()
