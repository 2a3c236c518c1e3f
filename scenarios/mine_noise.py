"""What mines do to a weak tone: mains that wander, vehicles that pass, motors and switches.

A receiver at rest receives four tones among 50 Hz and its harmonics, 10 dB below the white noise of
a sample.  Each kind of interference is thousands of times as strong as a tone.  For comparison with
``--at-rest`` the table has the mean of the windows of the ordinary lock-in, by their weights.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from far_and_weak import far_site
from harness import conclude, scenario_parser

from magfusion.estimation.rests.stationary_integration import integrate_rests
from magfusion.model.ground import in_ground
from magfusion.model.samples import ImuSamples, Log, Waveform
from magfusion.model.site import Site
from magfusion.model.without_imu import logged
from magfusion.receiver.receivers import received
from magfusion.units import Array, ComplexArray

RATE_HZ = 250.0
TONES_HZ = (43.0, 46.0, 54.0, 57.0)
SIGMA, SIZE = 1e-10, 4e-11  # T, of a sample; of a component of a tone
HUM, SWITCH, MOTOR, STEEL = 2e-8, 1e-7, 2e-9, 1e-6  # T

Interference = Callable[[Array, np.random.Generator], Array]


@dataclass(frozen=True)
class Config:
    """What is simulated."""

    duration: float = 600.0  # s
    runs: int = 8
    seed: int = 0


def none(time: Array, _: np.random.Generator) -> Array:
    """Return nothing: white noise is all there is."""
    return np.zeros((len(time), 3))


def mains(time: Array, rng: np.random.Generator) -> Array:
    """Return mains of exactly 50 Hz, with their second harmonic."""
    return _hum(50.0 * time, rng)


def wandering_mains(time: Array, rng: np.random.Generator) -> Array:
    """Return mains whose frequency wanders by 0.05 Hz rms within half a minute."""
    return _hum(50.0 * time + _wandered(time, 0.05, 30.0, rng), rng)


def vehicles(time: Array, rng: np.random.Generator) -> Array:
    """Return the field of steel that passes every two minutes, a micro-tesla for ten seconds."""
    field = np.zeros((len(time), 3))
    for middle in np.arange(60.0, time[-1], 120.0):
        nearest = ((time - middle) / 4.0)[:, None]
        field += STEEL * rng.standard_normal(3) / (1.0 + nearest**2) ** 1.5
    return field


def motors(time: Array, rng: np.random.Generator) -> Array:
    """Return a tone that sweeps from 20 to 80 Hz and back in 40 s, every two minutes."""
    phase = np.mod(time, 120.0)
    hertz = np.where(phase < 40.0, 20.0 + 60.0 * np.sin(np.pi * phase / 40.0), 0.0)
    turns = np.cumsum(hertz) / RATE_HZ
    return np.where(hertz > 0.0, MOTOR * np.cos(2.0 * np.pi * turns), 0.0)[:, None] * _along(rng)


def switches(time: Array, rng: np.random.Generator) -> Array:
    """Return switching bangs, one in twelve seconds, which ring for 50 ms."""
    field = np.zeros((len(time), 3))
    for begin in np.flatnonzero(rng.random(len(time)) < 1.0 / (12.0 * RATE_HZ)):
        elapsed = time[begin : begin + 50] - time[begin]
        ring = np.exp(-elapsed / 0.05) * np.cos(2.0 * np.pi * 60.0 * elapsed)
        field[begin : begin + 50] += SWITCH * ring[:, None] * rng.standard_normal(3)
    return field


KINDS: tuple[Interference, ...] = (none, mains, wandering_mains, vehicles, motors, switches)


def _along(rng: np.random.Generator) -> Array:
    drawn = rng.standard_normal(3)
    return np.asarray(drawn / np.linalg.norm(drawn))


def _wandered(time: Array, rms_hz: float, span: float, rng: np.random.Generator) -> Array:
    """Return turns of a frequency that wanders smoothly (n,)."""
    knots = np.arange(time[0] - span, time[-1] + 2.0 * span, span)
    hertz = np.interp(time, knots, rms_hz * rng.standard_normal(len(knots)))
    return np.asarray(np.cumsum(hertz) / RATE_HZ)


def _hum(turns: Array, rng: np.random.Generator) -> Array:
    field = np.zeros((len(turns), 3))
    for order, share in ((1, 1.0), (2, 0.3)):
        angle = 2.0 * np.pi * (order * turns + rng.random())
        field += share * HUM * np.cos(angle)[:, None] * _along(rng)
    return field


def mine_site() -> Site:
    """Return four beacons at the tones."""
    site = in_ground(far_site(), 0.0)
    beacons = [replace(b, frequency_hz=f) for b, f in zip(site.beacons, TONES_HZ, strict=True)]
    return replace(site, beacons=tuple(beacons))


def mine_log(kind: Interference, config: Config, seed: int) -> tuple[Log, Site, ComplexArray]:
    """Return a log without inertial samples, its site, and the phasors that are in it (4, 3)."""
    rng = np.random.default_rng(seed)
    time = np.arange(int(config.duration * RATE_HZ)) / RATE_HZ
    drawn = rng.standard_normal((2, len(TONES_HZ), 3)) * SIZE
    phasor = drawn[0] + 1j * drawn[1]
    field = SIGMA * rng.standard_normal((len(time), 3)) + kind(time, rng)
    for frequency_hz, own in zip(TONES_HZ, phasor, strict=True):
        field += np.real(own * np.exp(2j * np.pi * frequency_hz * time)[:, None])
    whole = Log("mine", 0, "simulation", ImuSamples.empty(), Waveform(time, field))
    log, site = logged(whole, mine_site())
    return log, site, np.asarray(phasor)


@dataclass(frozen=True)
class Row:
    """Errors with one kind of interference, against what white noise alone allows."""

    kind: str
    windows_times_bound: float
    windows_nees: float
    rest_times_bound: float
    rest_nees: float


def run_kind(kind: Interference, config: Config) -> Row:
    """Measure the errors of both ways."""
    square, nees = np.zeros((2, config.runs)), np.zeros((2, config.runs))
    for k in range(config.runs):
        log, site, phasor = mine_log(kind, config, config.seed + k)
        assert log.waveform is not None
        result, _ = received(log.waveform, log.imu, site)
        # Every other window: those between share their samples.
        weight = np.linalg.inv(result.phasor_cov[::2])
        cov = np.linalg.inv(np.sum(weight, axis=0))
        total = np.einsum("nckl,ncl->ck", weight, result.phasor_sensor[::2])
        mean = np.einsum("ckl,cl->ck", cov, total)
        rested = integrate_rests(log, site).fields
        ways = ((mean, cov), (rested.phasor_sensor[0], rested.phasor_cov[0]))
        for way, (value, own) in enumerate(ways):
            error = value - phasor
            solved = np.linalg.solve(own, error[..., None])[..., 0]
            square[way, k] = np.mean(np.abs(error) ** 2) / 2.0
            nees[way, k] = np.mean(np.real(np.sum(np.conj(error) * solved, axis=1)))
    bound = SIGMA * np.sqrt(2.0 / (config.duration * RATE_HZ))
    size, square_mean = np.sqrt(np.mean(square, axis=1)) / bound, np.mean(nees, axis=1)
    name = kind.__name__.replace("_", " ")
    return Row(name, float(size[0]), float(square_mean[0]), float(size[1]), float(square_mean[1]))


def report(rows: list[Row]) -> str:
    """Return the table of the errors."""
    lines = [
        f"{'':18}{'mean of windows':>28}{'--at-rest':>26}",
        f"{'interference':18}{'times the bound':>18}{'NEES':>10}{'times the bound':>18}{'NEES':>8}",
    ]
    for row in rows:
        windows = f"{row.windows_times_bound:18.2f}{row.windows_nees:10.3g}"
        lines.append(f"{row.kind:18}{windows}{row.rest_times_bound:18.2f}{row.rest_nees:8.2f}")
    return "\n".join([*lines, "NEES: six are due."])


def main() -> None:
    """Measure every kind of interference."""
    parser = scenario_parser(__doc__, Config.seed, output=None)
    parser.add_argument("--runs", type=int, default=Config.runs, help="of each kind")
    given = parser.parse_args()
    config = Config(runs=given.runs, seed=given.seed)
    rows = [run_kind(kind, config) for kind in KINDS]
    conclude(report(rows), {"rows": rows})


if __name__ == "__main__":
    main()
