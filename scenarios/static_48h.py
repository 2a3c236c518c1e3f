"""Does the error grow with time?  Paper 004, figures 9 and 10: 48 hours at one place.

The paper fixes a platform at rest once a minute for 48 hours and sees an error that is "basically
stable": each fix is separate, so that only what is measured can drift.  The scenario lets all of
it drift: coils that warm up by 20 K (driven by a constant current, or by a constant voltage, whose
current copper's resistance takes with it), gains that wander by 0.3 % over four hours, a
magnetometer's scale that follows the day, noise that is stronger by day, hum of the mains near the
tones, and the clock of the drives.  Eight worlds (F1: fields as disturbed as the paper's errors
known), surveyed cold.  Tested, on the slope of the error after the first twelve hours:

1. Does heat make it grow?  No: a voltage's loss of seven per cent of the moment moves all fixes in
   the first hours, and there they stay.  By how much is another matter: a third of a metre for the
   paper's algorithm 3, six centimetres for maximum likelihood with a map, and less than one where
   each beacon's gain is estimated with the pose.
2. A clock that is 0.01 ppm off?  It turns what maximum likelihood takes for the attitude by
   6.4 degrees a day where it trusts the drive phase (6.0 to 6.7 elsewhere in the room), and moves
   the position by two centimetres a day; the paper's normals do not see it.
3. And with the phase of each beacon free?  It is gone.

The length of an error hides a drift across a larger constant one: each component is fitted, too.
The verdict of a row was settled before any run: it drifts where the mean slopes of its three
components (Hotelling's test) are as far from none as chance makes them in 0.27 % of whole tables.
"""

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from harness import blank_figure, chosen_scale, conclude, save_picture, scenario_parser
from paper_rooms import F1, SimulatedReceiver, SimulatedWorld, draw_world, mapped
from scipy.spatial.transform import Rotation

from magfusion.estimation.snapshot.refine import refine
from magfusion.files.survey import Survey
from magfusion.model.parameters import initial_calibration
from magfusion.model.samples import FieldSamples
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.papers.p004_fingerprints.algorithms import RotatingFields, fix_as_published
from magfusion.papers.p004_fingerprints.equations import eq_25_fingerprint
from magfusion.papers.p004_fingerprints.fingerprint import fingerprint_database
from magfusion.receiver.ellipse import plane_normal
from magfusion.results.drift import MIN_COMMON, THREE_SIGMA, common_slope
from magfusion.simulation.disturbance import DayNight
from magfusion.simulation.drift import (
    COPPER_PER_KELVIN,
    DailySwing,
    Drift,
    DriveClock,
    Wander,
    WarmUp,
    draw_drift,
)
from magfusion.simulation.monte_carlo import run_many
from magfusion.simulation.waveform import Mains
from magfusion.units import DEGREE, NANOTESLA, Array, ComplexArray

HOUR = 3600.0  # s
DAYTIME = 14.0 * HOUR  # loudest and warmest; the run starts at midnight
CURRENT = Drift(
    coils=WarmUp(rise=20.0, time_constant=90.0 * 60.0),
    fading_per_kelvin=1e-4,
    gain=Wander(rms=0.003, time_constant=4.0 * HOUR),
    clock=DriveClock(walk=1e-9),
    sensor=DailySwing(amplitude=4.0, warmest_time=DAYTIME),
    scale_per_kelvin=5e-5,
)
CASES = {
    "current drive": CURRENT,
    "voltage drive": replace(CURRENT, fading_per_kelvin=COPPER_PER_KELVIN),
    "0.01 ppm clock": replace(CURRENT, clock=DriveClock(rate=1e-8, walk=1e-9)),
}
METHODS: dict[str, tuple[str, ...] | None] = {  # and what is found beside the pose
    "A3": None,
    "ML+map": (),
    "ML+map, phase free": ("phase",),
    "ML+map, gain free": ("gain",),
}


@dataclass(frozen=True, eq=False)
class Config:
    """Length of the run, the platform's place, and what the room sounds like."""

    worlds: int = 8
    hours: float = 48.0
    interval: float = 60.0  # s between fixes
    settled_hours: float = 12.0  # before which slopes do not count
    place_world: Array = field(default_factory=lambda: np.array([2.85, 2.25, 0.5]))  # mid-room, m
    receiver: SimulatedReceiver = field(default_factory=SimulatedReceiver)
    # One-sided density: 2 nT rms at night to 4 nT by day at 200 Hz (paper: 3 nT).
    night_density: float = 0.2 * NANOTESLA  # T / sqrt(Hz)
    day_density: float = 0.4 * NANOTESLA
    mains: Mains = field(default_factory=lambda: Mains(50.0 * NANOTESLA))
    mains_wander_hz: float = 0.02  # rms of the mains' frequency, over five minutes
    seed: int = 1

    @property
    def time(self) -> Array:
        """Times of the fixes (s)."""
        return self.interval * np.arange(1.0, self.hours * HOUR / self.interval + 1.0)


@dataclass(frozen=True, eq=False)
class Errors:
    """What one method errs in one world: position (m) and rotation vector (deg), world axes (n, 3).

    ``position`` and ``attitude`` are their lengths, (n,).
    """

    position_world: Array
    turn_world: Array

    @property
    def position(self) -> Array:
        """Distance (m)."""
        return np.asarray(np.linalg.norm(self.position_world, axis=1))

    @property
    def attitude(self) -> Array:
        """Angle (deg)."""
        return np.asarray(np.linalg.norm(self.turn_world, axis=1))


@dataclass(frozen=True)
class Components:
    """Slopes of x, y and z in 24 h, their standard errors, and the chance of as much by chance."""

    per_day: tuple[float, ...]
    standard_error: tuple[float, ...]
    probability: float

    def drifts(self, tests: int) -> bool:
        """Return whether it is beyond chance among so many tests."""
        return self.probability < THREE_SIGMA / tests


@dataclass(frozen=True)
class Row:
    """One method in one case: means after settling, slopes with their standard errors.

    By components where there are worlds enough to know the scatter of three.
    """

    case: str
    method: str
    position_mean: float  # m
    attitude_mean: float  # deg
    position_slope: float  # m / 24 h
    position_slope_se: float
    attitude_slope: float  # deg / 24 h
    attitude_slope_se: float
    position_components: Components | None  # m / 24 h
    attitude_components: Components | None  # deg / 24 h


def hum(config: Config, frequencies_hz: Array, rng: np.random.Generator) -> ComplexArray:
    """Return what demodulation takes from the mains (T), shape (n, beacons, 3).

    The window is whole periods of the mains and of all tones: all of the hum that is left is what
    its wandering frequency leaks.
    """
    receiver, mains, n = config.receiver, config.mains, len(config.time)
    within = np.arange(receiver.samples) / receiver.rate_hz
    wander = Wander(config.mains_wander_hz, 300.0).draw(config.time, 1, rng)
    frequency_hz = mains.frequency_hz + wander
    wave = np.zeros((n, receiver.samples))
    for order, share in enumerate((1.0, *mains.harmonics), start=1):
        start = rng.uniform(-np.pi, np.pi, (n, 1))
        turns = 2.0 * np.pi * order * frequency_hz * within
        wave += mains.amplitude * share * np.cos(turns + start)
    carrier = np.exp(-2j * np.pi * within[:, None] * frequencies_hz)
    tones = 2.0 / receiver.samples * (wave @ carrier)
    direction = mains.direction_world / np.linalg.norm(mains.direction_world)
    return np.asarray(tones[..., None] * direction)


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What disturbs the epochs of one world, equally in all cases."""

    relative_gain: Array  # (n, beacons, 1)
    added: ComplexArray  # (n, beacons, 3), T
    sigma: Array  # (n,), T; of each component

    def measure(
        self, world: SimulatedWorld, drift: Drift, config: Config, seed: int
    ) -> FieldSamples:
        """Return what a level sensor at rest measures while so much drifts."""
        beacons, time = len(world.true_beacons), config.time
        drawn = draw_drift(drift, time, beacons, np.random.default_rng(seed))
        phase = drawn.phase(np.array(world.layout.frequencies_hz))
        drive = np.exp(drawn.log_gain + 1j * phase)[..., None] * self.relative_gain
        seen = drive * world.phasors_world(config.place_world[None]) + self.added
        window = world.receiver.samples / world.receiver.rate_hz
        cov = self.sigma[:, None, None, None] ** 2 * np.eye(3)
        return FieldSamples(
            time=time,
            window=np.full(len(time), window),
            channels=world.site.channels,
            phasor_sensor=drawn.sensor_scale[:, None, None] * seen,
            phasor_cov=np.broadcast_to(cov, (len(time), beacons, 3, 3)).copy(),
        )


def draw_surroundings(
    world: SimulatedWorld, config: Config, rng: np.random.Generator
) -> Surroundings:
    """Draw noise, hum and the fresh part of the world's gains."""
    shape = (len(config.time), len(world.true_beacons), 3)
    receiver = config.receiver
    density = DayNight(config.night_density, config.day_density, DAYTIME).density(config.time)
    variance = (density * np.sqrt(receiver.rate_hz / 2.0)) ** 2 + receiver.quantisation**2 / 12.0
    sigma = np.sqrt(2.0 * variance / receiver.samples)
    white = rng.standard_normal((2, *shape)) * sigma[:, None, None]
    fresh = world.scenario.white_rms * rng.standard_normal((*shape[:2], 1))
    leaked = hum(config, np.array(world.layout.frequencies_hz), rng)
    return Surroundings(1.0 + fresh, white[0] + 1j * white[1] + leaked, sigma)


def locate(
    world: SimulatedWorld, survey: Survey, site: Site, samples: FieldSamples
) -> dict[str, Trajectory]:
    """Return the fixes of each method."""
    fields = RotatingFields(
        axis_world=np.tile([0.0, 0.0, 1.0], (len(world.true_beacons), 1)),
        amplitude=eq_25_fingerprint(samples.phasor_sensor[:, :, None]),
        normal_body=plane_normal(samples.phasor_sensor),
    )
    database = fingerprint_database(survey, world.site)
    published = fix_as_published(database, fields, "paper-fingerprint")
    a3 = Trajectory(samples.time, published.world_from_body, published.position_world)
    calibration = initial_calibration(site, 0.0)
    # A free phase leaves the mirrored pose possible: the survey tells on which side they are.
    return {
        method: a3
        if free_parameters is None
        else refine(
            samples, calibration, a3, survey_error=False, free_parameters=free_parameters
        ).best()
        for method, free_parameters in METHODS.items()
    }


def run_world(config: Config, rng: np.random.Generator) -> dict[tuple[str, str], Errors]:
    """Survey a world cold, then fix its platform at rest in every case."""
    world_rng, survey_rng, noise_rng, drift_rng = rng.spawn(4)
    world = draw_world(F1, world_rng, receiver=config.receiver)
    survey = world.survey(survey_rng)
    site = mapped(world.site, survey)
    surroundings = draw_surroundings(world, config, noise_rng)
    seed = int(drift_rng.integers(2**63))
    result = {}
    for case, drift in CASES.items():
        samples = surroundings.measure(world, drift, config, seed)
        for method, fixes in locate(world, survey, site, samples).items():
            turn = Rotation.from_matrix(fixes.world_from_body).as_rotvec() / DEGREE
            result[case, method] = Errors(fixes.position_world - config.place_world, turn)
    return result


def slopes(config: Config, error: Array) -> Array:
    """Return the slope of each world's errors (worlds, n) after settling, per 24 hours.

    In one day and a half the daily swing of the noise leaves a slope of up to 0.2 of the swing of
    the error: two thousandths of a degree, which the gains' wander hides unless gains are free.
    """
    converged = config.time > config.settled_hours * HOUR
    days = config.time[converged] / (24.0 * HOUR)
    return np.asarray(np.polyfit(days, error[:, converged].T, 1)[0])


def components(config: Config, errors: list[Array]) -> Components | None:
    """Return the slopes of the components of each world's errors (n, 3) after settling."""
    if len(errors) < MIN_COMMON:
        return None
    converged = config.time > config.settled_hours * HOUR
    result = common_slope([config.time[converged]] * len(errors), [e[converged] for e in errors])
    return Components(
        tuple(result.per_day.tolist()), tuple(result.standard_error.tolist()), result.probability
    )


def summarise(config: Config, worlds: list[dict[tuple[str, str], Errors]]) -> tuple[Row, ...]:
    """Return a row for each case and method."""
    converged = config.time > config.settled_hours * HOUR
    rows = []
    for case, method in worlds[0]:
        errors = [world[case, method] for world in worlds]
        position = np.stack([one.position for one in errors])
        attitude = np.stack([one.attitude for one in errors])
        by_position, by_attitude = (slopes(config, error) for error in (position, attitude))
        share = 1.0 / np.sqrt(len(worlds))
        rows.append(
            Row(
                case=case,
                method=method,
                position_mean=float(np.mean(position[:, converged])),
                attitude_mean=float(np.mean(attitude[:, converged])),
                position_slope=float(np.mean(by_position)),
                position_slope_se=float(share * np.std(by_position, ddof=1)),
                attitude_slope=float(np.mean(by_attitude)),
                attitude_slope_se=float(share * np.std(by_attitude, ddof=1)),
                position_components=components(config, [one.position_world for one in errors]),
                attitude_components=components(config, [one.turn_world for one in errors]),
            )
        )
    return tuple(rows)


def report(config: Config, rows: tuple[Row, ...]) -> str:
    """Return the table that a reader sees."""
    lines = [
        f"{config.hours:g} h, a fix each {config.interval:g} s, {config.worlds} worlds (F1);"
        f" after {config.settled_hours:g} h",
        f"{'':37}{'mean, m':>15}{'deg':>8}{'slope, m / 24 h':>36}{'deg / 24 h':>30}",
    ]
    before = ""
    for row in rows:
        name = row.case if row.case != before else ""
        before = row.case
        position = f"{row.position_slope:+.5f} +-{row.position_slope_se:.5f}"
        attitude = f"{row.attitude_slope:+.4f} +-{row.attitude_slope_se:.4f}"
        lines.append(
            f" {name:16}{row.method:20}{row.position_mean:8.4f}{'':7}{row.attitude_mean:8.3f}"
            f"{position:>28}{attitude:>30}"
        )
    lines.append('Paper, figures 9 and 10: "basically stable, not growing with time"; no figures')
    lines += by_components(rows)
    return "\n".join(lines)


def by_components(rows: tuple[Row, ...]) -> list[str]:
    """Return the table of the components' slopes with the verdicts."""
    lines = [
        "",
        f"{'by component, 24 h':37}{'x, y, z, mm':>36}{'about x, y, z, deg':>39}  verdict",
    ]
    for row in rows:
        place, turn = row.position_components, row.attitude_components
        if place is None or turn is None:
            return [*lines, f" takes {MIN_COMMON} worlds: no verdict"]
        columns = (place, 1e3, "6.2f", "4.2f"), (turn, 1.0, "6.3f", "5.3f")
        cells = "".join(
            f"{scale * slope:+{digits}} +-{scale * error:<{width}} "
            for part, scale, digits, width in columns
            for slope, error in zip(part.per_day, part.standard_error, strict=True)
        )
        parts = {"position": place, "attitude": turn}
        drifting = [name for name, part in parts.items() if part.drifts(2 * len(rows))]
        verdict = f"{' and '.join(drifting)} DRIFTS" if drifting else "no drift"
        lines.append(f" {row.case:16}{row.method:20}{cells}  {verdict}")
    return lines


def hourly(config: Config, error: Array) -> tuple[Array, Array]:
    """Return hours and the mean error of each, of errors (n,)."""
    per = round(HOUR / config.interval)
    whole = len(error) // per
    return np.arange(whole) + 0.5, np.asarray(np.mean(error[: whole * per].reshape(-1, per), 1))


def draw(path: Path, config: Config, worlds: list[dict[tuple[str, str], Errors]]) -> None:
    """Write a PNG: position and attitude error over time in each case."""
    figure = blank_figure(4.8 * len(CASES), 7.5)
    panels = figure.subplots(2, len(CASES), sharex=True, sharey="row")
    colours = ("tab:red", "tab:blue", "tab:green", "tab:orange")
    for column, case in enumerate(CASES):
        for method, colour in zip(METHODS, colours, strict=True):
            for axes, part in zip(panels[:, column], ("position", "attitude"), strict=True):
                each = [getattr(world[case, method], part) for world in worlds]
                axes.plot(config.time / HOUR, each[0], color=colour, linewidth=0.3, alpha=0.4)
                hours, mean = hourly(config, np.mean(each, axis=0))
                axes.plot(hours, mean, color=colour, linewidth=1.6, label=method)
        panels[0, column].set(title=case, yscale="log")
        panels[1, column].set(xlabel="time (h)", yscale="log")
    panels[0, 0].set_ylabel("position error (m)")
    panels[1, 0].set_ylabel("attitude error (deg)")
    panels[0, 0].legend(fontsize=8)
    figure.suptitle("A platform at rest; thin: each fix in one world, thick: hourly mean of all")
    save_picture(figure, path)


def main() -> None:
    """Print the table and one JSON line; draw it where a directory is given."""
    quick = "a fix each half hour, 2 worlds"
    given = scenario_parser(__doc__, Config.seed, quick, parallel=True).parse_args()
    config = Config(seed=given.seed)
    if given.quick:
        config = replace(config, worlds=2, interval=1800.0)
    worlds = run_many(run_world, [config] * config.worlds, seed=config.seed, **chosen_scale(given))
    rows = summarise(config, worlds)
    if given.output is not None:
        draw(given.output / "static_48h.png", config, worlds)
    conclude(report(config, rows), {"rows": rows})


if __name__ == "__main__":
    main()
