"""Rate of false alarms: good logs of many kinds, each correctly declared.

Of every log a room or a gallery of 80 m, two to sixteen beacons, their survey (to 1 mm, or to
5 cm), the noise, the error of the field model, the sample rates, and a motion of up to 800 deg/s
are drawn, and simulated as the site declares them.  `smooth` or `navigate` runs as a job, so that
``report.json`` is judged.

1. Where the Cramér-Rao bound of single epochs shows that the pose is determined, at most 1 % of the
   logs are doubtful and none has failed; the median of the mean NEES is between 4 and 7.
2. Elsewhere a result is doubtful or failed, or its errors are what it claims.
3. None is trusted with a mean NEES above 20.

The workers of a ``--cluster`` need this directory on their PYTHONPATH.
"""

import json
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from harness import Scale, chosen_scale, conclude, scenario_parser
from mistake_case import with_magnetometer, with_sigma
from scipy.spatial.transform import Rotation

from magfusion.errors import EstimationError, InputError
from magfusion.files.log import write_log
from magfusion.files.site import save_site
from magfusion.jobs import navigate, smooth
from magfusion.jobs.navigate_settings import NavigateSettings
from magfusion.model.site import Coil, Site
from magfusion.results.coverage import coverage
from magfusion.simulation.demo_site import demo_site
from magfusion.simulation.log import SimulatedLog, SimulationConfig, simulate_log
from magfusion.simulation.monte_carlo import run_many
from magfusion.units import DEGREE, Array

MIN_BEACONS, MAX_BEACONS = 2, 16
# 5 Hz apart, without the mains.
FREQUENCIES_HZ = np.delete(15.0 + 5.0 * np.arange(MAX_BEACONS + 1), 7)
GALLERY = np.array([80.0, 6.0, 4.0])  # m
GALLERY_SHARE, GALLERY_BEACONS, GALLERY_MOMENT = 0.15, 6, 20.0  # of the logs; least; times a room's
SURVEY = 0.001, 0.05  # m
ROTATION_PER_M = 40.0 * DEGREE  # of a survey: 2 deg where positions are known to 5 cm
MOMENT_PER_M = 0.6  # 3 % there
NOISE = 1e-10, 1e-9  # T/sqrt(Hz)
MODEL_ERROR = 0.001, 0.02
SPEED, TURN_RATE = (0.1, 2.0), (0.5, 5.8)  # m/s; rad/s rms, the peaks 2.4 times as large: 800 deg/s
IMU_RATES_HZ, MAGNETOMETER_RATES_HZ = (100.0, 200.0, 400.0), (300.0, 400.0, 800.0)
WINDOW = 0.4  # s
DETERMINED_M = 0.3  # the bound of a single epoch, in nine of ten
SILENT_NEES = 20.0


@dataclass(frozen=True)
class Config:
    """How many logs."""

    logs: int = 200
    duration: float = 30.0
    seed: int = 0
    estimator: Literal["smooth", "ekf", "lag"] = "smooth"


@dataclass(frozen=True, eq=False)
class Drawn:
    """A site and what happens there."""

    site: Site
    config: SimulationConfig
    survey_m: float


@dataclass(frozen=True)
class Row:
    """Verdict on a log."""

    beacons: int
    survey_m: float
    motion: str
    speed: float
    turn_rate: float
    model_error: float
    room_m: float
    bound_m: float
    exit: int
    verdict: str
    codes: tuple[str, ...]
    text: str
    error_m: float | None
    error_deg: float | None
    nees: float | None

    @property
    def determined(self) -> bool:
        """Whether the pose is determined by the bound."""
        return self.bound_m < DETERMINED_M

    @property
    def silent(self) -> bool:
        """Whether a wrong result is trusted."""
        return self.verdict == "trustworthy" and (self.nees or 0.0) > SILENT_NEES


def draw(config: Config, rng: np.random.Generator) -> Drawn:
    """Return a site, declared as it is, and a motion in it."""
    gallery = bool(rng.random() < GALLERY_SHARE)
    least = GALLERY_BEACONS if gallery else MIN_BEACONS
    count = int(rng.integers(least, MAX_BEACONS + 1))
    size = GALLERY if gallery else np.array([1.0, 0.8, 0.4]) * rng.uniform(4.0, 12.0)  # m
    base = demo_site(coil_radius=None, synchronised=bool(rng.random() < 0.7))
    survey, model_error, noise = (_log_uniform(rng, *of) for of in (SURVEY, MODEL_ERROR, NOISE))
    like = with_sigma(base.beacons[0], survey, ROTATION_PER_M * survey, MOMENT_PER_M * survey)
    if gallery:
        like = replace(like, coils=tuple(_stronger(coil) for coil in like.coils))
    beacons = tuple(
        replace(
            like,
            name=f"B{i + 1}",
            position_world=place,
            world_from_beacon=Rotation.random(random_state=rng).as_matrix(),
            frequency_hz=float(FREQUENCIES_HZ[i]),
        )
        for i, place in enumerate(_places(size, count, rng))
    )
    site = replace(base, beacons=beacons, model_error=model_error)
    site = with_magnetometer(site, noise_density=noise)
    if survey > 0.01:
        sigma = replace(
            site.platform.magnetometer.sigma,
            matrix=np.full((3, 3), 0.01),
            offset=np.full(3, 4e-8),
            rotation_sensor=np.full(3, 1.0 * DEGREE),
        )
        site = with_magnetometer(site, sigma=sigma)
    what = SimulationConfig(
        box_world=np.array([0.25 * size, 0.75 * size]),
        duration=config.duration,
        motion="walk" if rng.random() < 0.5 else "turn",
        speed=_log_uniform(rng, *SPEED),
        turn_rate=_log_uniform(rng, *TURN_RATE),
        imu_rate_hz=float(rng.choice(IMU_RATES_HZ)),
        magnetometer_rate_hz=float(rng.choice(MAGNETOMETER_RATES_HZ)),
        random_field=model_error,
    )
    return Drawn(site, what, survey)


def _log_uniform(rng: np.random.Generator, lower: float, upper: float) -> float:
    return float(np.exp(rng.uniform(np.log(lower), np.log(upper))))


def _stronger(coil: Coil) -> Coil:
    return replace(coil, moment_beacon=GALLERY_MOMENT * coil.moment_beacon)


def _places(size: Array, count: int, rng: np.random.Generator) -> Array:
    """Return places near the walls of a room, as far apart as chance allows."""
    result: list[Array] = []
    while len(result) < count:
        tried = rng.uniform(0.0, 1.0, (20, 3))
        wall = rng.integers(0, 3, 20)
        tried[np.arange(20), wall] = rng.integers(0, 2, 20)
        place = tried * size
        separate = [min((float(np.linalg.norm(p - q)) for q in result), default=1.0) for p in place]
        result.append(place[int(np.argmax(separate))])
    return np.array(result)


def bound(drawn: Drawn, simulation: SimulatedLog) -> float:
    """Return what nine of ten single epochs determine the position to, at least (m)."""
    truth = simulation.log.truth
    assert truth is not None
    path = truth.position_world[:: max(1, len(truth.time) // 50)]
    sigma = coverage(drawn.site, path, WINDOW).position_sigma
    return float(np.quantile(np.where(np.isfinite(sigma), sigma, np.inf), 0.9, method="higher"))


def judge(config: Config, rng: np.random.Generator) -> Row:
    """Simulate a log, smooth it and return the verdict."""
    drawn = draw(config, rng)
    built = simulate_log(drawn.site, drawn.config, rng)
    code, findings = 0, ""
    with tempfile.TemporaryDirectory(prefix="clean_") as name:
        log, output = Path(name) / "log", Path(name) / "out"
        write_log(built.log, log)
        save_site(drawn.site, log / "site.yaml")
        try:
            if config.estimator == "smooth":
                smooth.run(smooth.SmoothSettings(log=log), output)
            else:
                kind: Literal["ekf", "smoother"]
                kind = "ekf" if config.estimator == "ekf" else "smoother"
                settings = NavigateSettings(log=log, estimator=kind)
                navigate.run_navigate(settings, output)
        except InputError as error:
            code, findings = 2, str(error)
        except EstimationError as error:
            code, findings = 1, str(error)
        place = output / "report.json"
        report = json.loads(place.read_text()) if place.is_file() else {}
    reasons = report.get("reasons", [])
    return Row(
        beacons=len(drawn.site.beacons),
        survey_m=drawn.survey_m,
        motion=drawn.config.motion,
        speed=drawn.config.speed,
        turn_rate=drawn.config.turn_rate,
        model_error=drawn.site.model_error,
        room_m=float(np.ptp(drawn.config.box_world[:, 0]) * 2.0),
        bound_m=bound(drawn, built),
        exit=code,
        verdict=report.get("verdict", "failed" if code else "trustworthy"),
        codes=tuple(reason["code"] for reason in reasons),
        text=reasons[0]["text"] if reasons else findings,
        error_m=report.get("ate_m"),
        error_deg=report.get("attitude_rmse_deg"),
        nees=report.get("nees_mean"),
    )


def run(config: Config, scale: Scale | None = None) -> list[Row]:
    """Return the verdicts on all logs."""
    return run_many(judge, [config] * config.logs, seed=config.seed, **(scale or {}))


@dataclass(frozen=True)
class Figures:
    """What it comes to."""

    logs: int
    determined: int
    doubtful: int  # of the determined
    failed: int
    silent: int  # of all
    trusted_elsewhere: int
    nees_median: float
    nees_5_percent: float
    nees_95_percent: float


def figures(rows: Sequence[Row]) -> Figures:
    """Return what it comes to."""
    good = [row for row in rows if row.determined]
    nees = [row.nees for row in good if row.nees is not None]
    of_nees = np.percentile(nees, [5.0, 50.0, 95.0]) if nees else np.full(3, np.nan)
    return Figures(
        logs=len(rows),
        determined=len(good),
        doubtful=sum(row.verdict == "doubtful" for row in good),
        failed=sum(row.verdict == "failed" for row in good),
        silent=sum(row.silent for row in rows),
        trusted_elsewhere=sum(r.verdict == "trustworthy" for r in rows if not r.determined),
        nees_median=float(of_nees[1]),
        nees_5_percent=float(of_nees[0]),
        nees_95_percent=float(of_nees[2]),
    )


def table(rows: Sequence[Row]) -> str:
    """Return the printed text: the logs that were doubted, and the sums."""
    lines = [
        f"{'log':>4}{'beacons':>8} {'survey cm':>10} {'motion':5}{'m/s':>5}{'rad/s':>6}"
        f"{'model %':>8}{'room m':>7}{'bound cm':>9}"
        f"  {'verdict':12}{'error cm':>9}{'deg':>7}{'NEES':>7}  first reason"
    ]
    for i, row in enumerate(rows):
        if row.verdict == "trustworthy" and not row.silent:
            continue
        lines.append(
            f"{i:4}{row.beacons:8}{100 * row.survey_m:10.2g} {row.motion:5}{row.speed:5.2f}"
            f"{row.turn_rate:6.2g}{100 * row.model_error:8.2g}{row.room_m:7.1f}"
            f"{100 * row.bound_m:9.2g}  {row.verdict:12}"
            f"{_number(row.error_m, 100.0):>9}{_number(row.error_deg):>7}{_number(row.nees):>7}"
            f"  {row.text[:120]}"
        )
    result = figures(rows)
    return "\n".join(
        (
            *lines,
            f"{result.logs} logs, {result.determined} of them with a pose that the bound"
            " determines:",
            f"  doubtful {result.doubtful}, failed {result.failed}; median of the mean NEES"
            f" {result.nees_median:.2g} (6 is due), 5th and 95th percentile"
            f" {result.nees_5_percent:.2g} and {result.nees_95_percent:.2g}",
            f"  trusted with a mean NEES above {SILENT_NEES:g}, of all: {result.silent}",
            f"  trusted although the bound of single epochs is open: {result.trusted_elsewhere}",
        )
    )


def _number(value: float | None, scale: float = 1.0) -> str:
    return "-" if value is None else f"{scale * value:.3g}"


def main() -> None:
    """Print the table and one JSON line."""
    parser = scenario_parser(__doc__, Config.seed, "ten logs", output=None, parallel=True)
    parser.add_argument("--logs", type=int, default=Config.logs)
    parser.add_argument("--estimator", choices=("smooth", "ekf", "lag"), default="smooth")
    given = parser.parse_args()
    logs = 10 if given.quick else given.logs
    config = Config(logs=logs, seed=given.seed, estimator=given.estimator)
    rows = run(config, chosen_scale(given))
    conclude(table(rows), {"figures": figures(rows), "rows": [asdict(row) for row in rows]})


if __name__ == "__main__":
    main()
