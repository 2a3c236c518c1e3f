"""Is the protection level kept?  Single epochs with one false beacon, a million of them.

In every epoch four beacons are received at a pose of its own, in a room that is surveyed as well as
it declares.  In half of the epochs one beacon's field is false by up to 20 % of either sign.

1. How often is position or attitude beyond its level without an alarm?  The upper 95 % limit, times
   the prior of a fault, is below the risk of 1e-4 an epoch.
2. How often is there an alarm without a fault?  In less than one epoch of a thousand.
3. Is the level of use?  Its median is below four times the claimed 3-sigma radius, and there is one
   in 99 % of the epochs.

An epoch is solved in closed form from the Jacobian at its true pose, which a test compares with the
full fix; ``--full`` makes the full fix, with its exclusions, for fewer epochs.
The workers of a ``--cluster`` need this directory on their PYTHONPATH.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import numpy as np
from harness import Scale, chosen_scale, conclude, scenario_parser
from scipy.spatial.transform import Rotation
from scipy.stats import beta

from magfusion.estimation.posterior.protection_levels import protection_levels
from magfusion.estimation.posterior.separation import linear_separation
from magfusion.estimation.snapshot.fix_separation import separate_fixes
from magfusion.estimation.snapshot.likelihood import fix_epochs
from magfusion.estimation.snapshot.problem import GAIN_SIGMA, epochs_of
from magfusion.estimation.snapshot.refine import rows_at
from magfusion.estimation.solve.batched import open_inverse
from magfusion.model.parameters import initial_calibration
from magfusion.model.samples import FieldSamples
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.model.trust import Risk
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import simulate_fields
from magfusion.simulation.monte_carlo import run_many
from magfusion.units import DEGREE, Array, BoolArray

SIGMA = 3e-10  # T, of a phasor's component
BLOCK = 1000  # epochs of a task
CONFIDENCE = 0.95


@dataclass(frozen=True)
class Config:
    """How many epochs, and how false a beacon may be.

    Parameters
    ----------
    full : bool
        Fix every epoch, rather than solve it in closed form.
    """

    epochs: int = 1_000_000
    largest: float = 0.2
    model_error: float = 5e-4
    beacons: int = 4
    full: bool = False
    seed: int = 0


@dataclass(frozen=True, eq=False)
class Epochs:
    """Epochs with what is true of them.

    Parameters
    ----------
    share : ndarray, shape (n,)
        By which a beacon's field is false; zero where none is.
    """

    samples: FieldSamples
    truth: Trajectory
    share: Array


@dataclass(frozen=True, eq=False)
class CaseOutcome:
    """What came of some epochs, each of shape (n,).

    Parameters
    ----------
    faulted, alarm, beyond : bool ndarray
        Beyond: position or attitude beyond its level, where there is one.
    ratio : ndarray
        Level of position over three times the claimed sigma of its norm; NaN where there is none.
    error_m : ndarray
    """

    faulted: BoolArray
    alarm: BoolArray
    beyond: BoolArray
    ratio: Array
    error_m: Array


class Figures(NamedTuple):
    """Size of the run."""

    epochs: int
    faulted: int
    unseen: int
    unseen_limit: float  # upper limit of the probability, given a fault
    hazard_limit: float  # the same times the prior of a fault of any beacon
    false_alarm_rate: float
    false_alarm_limit: float
    detected: float  # share of faulted epochs with an alarm
    median_ratio: float
    finite: float


def room(config: Config) -> Site:
    """Return dipoles that are surveyed exactly."""
    site = demo_site(coil_radius=None)
    return replace(site, beacons=site.beacons[: config.beacons], model_error=config.model_error)


def draw(config: Config, count: int, rng: np.random.Generator) -> Epochs:
    """Return epochs at poses of their own, half of them with one false beacon."""
    site = room(config)
    truth = Trajectory(
        time=0.2 * np.arange(count),
        world_from_body=Rotation.random(count, random_state=rng).as_matrix(),
        position_world=rng.uniform(*DEMO_BOX_WORLD, (count, 3)),
    )
    samples = simulate_fields(site, truth, SIGMA, rng)
    phasor = samples.phasor_sensor
    size = np.sqrt(np.sum(np.abs(phasor) ** 2, axis=-1, keepdims=True) / 6.0)
    noise = rng.standard_normal((2, *phasor.shape))
    phasor = phasor + config.model_error * size * (noise[0] + 1j * noise[1])
    share = rng.uniform(-config.largest, config.largest, count)
    share[: count // 2] = 0.0
    false = rng.integers(0, len(site.beacons), count)
    names = [beacon.name for beacon in site.beacons]
    owner = np.array([names.index(name) for name, _ in samples.channels])
    factor = 1.0 + np.where(owner == false[:, None], share[:, None], 0.0)
    cov = np.broadcast_to(SIGMA**2 * np.eye(3), samples.phasor_cov.shape).copy()
    known = replace(samples, phasor_sensor=factor[..., None] * phasor, phasor_cov=cov)
    return Epochs(known, truth, share)


def solve(config: Config, epochs: Epochs) -> CaseOutcome:
    """Solve epochs in closed form, at their true poses."""
    site, risk, truth = room(config), Risk(), epochs.truth
    parts = []
    chunks = epochs_of(
        epochs.samples,
        initial_calibration(site, 0.0),
        gravity=None,
        prior=None,
        survey_error=False,
        free_parameters=(),
        gain_sigma=GAIN_SIGMA,
    )
    names = [beacon.name for beacon in site.beacons]
    owner = np.array([names.index(n) for n, _ in epochs.samples.channels for _ in range(6)])
    first = 0
    for chunk in chunks:
        rows = slice(first, first + len(chunk.samples))
        first = rows.stop
        state = chunk.problem.start(truth.world_from_body[rows], truth.position_world[rows])
        jacobian, error, covariance = rows_at(chunk.problem, state)
        result = linear_separation(jacobian, error, covariance, owner, len(names))
        back = np.swapaxes(jacobian, 1, 2)
        inverse, _ = open_inverse(back @ jacobian)
        step = (inverse @ (back @ error[..., None]))[..., 0]
        position_m, degrees = protection_levels(result, risk)
        wrong_m = np.linalg.norm(step[:, 3:6], axis=1)
        rotated = np.linalg.norm(step[:, :3], axis=1) / DEGREE
        parts.append(
            CaseOutcome(
                faulted=epochs.share[rows] != 0.0,
                alarm=np.any(result.excess(risk) > 1.0, axis=1),
                beyond=(wrong_m > position_m) | (rotated > degrees),
                ratio=position_m / (3.0 * result.sigma.whole[:, 1]),
                error_m=wrong_m,
            )
        )
    return joined(parts)


def fix(config: Config, epochs: Epochs) -> CaseOutcome:
    """Fix epochs as ``magfusion fix`` does, without a false beacon where one is found."""
    site, truth = room(config), epochs.truth
    calibration = initial_calibration(site, 0.0)
    fixes = fix_epochs(epochs.samples, calibration, survey_error=False)
    sigma = np.sqrt(np.trace(fixes.pose_cov[:, 0, 3:, 3:], axis1=1, axis2=2))
    result = separate_fixes(epochs.samples, calibration, fixes, survey_error=False)
    best, level = result.fixes.best(), result.states.protection_level_m
    wrong_m = np.linalg.norm(best.position_world - truth.position_world, axis=1)
    turn = np.swapaxes(truth.world_from_body, 1, 2) @ best.world_from_body
    rotated = Rotation.from_matrix(turn).magnitude() / DEGREE
    return CaseOutcome(
        faulted=epochs.share != 0.0,
        alarm=np.any(result.excess > 1.0, axis=1),
        beyond=(wrong_m > level) | (rotated > result.states.protection_level_deg),
        ratio=np.where(np.any(result.excess > 1.0, axis=1), np.nan, level / (3.0 * sigma)),
        error_m=wrong_m,
    )


def joined(parts: Sequence[CaseOutcome]) -> CaseOutcome:
    """Return outcomes as one."""
    return CaseOutcome(
        *(np.concatenate([getattr(p, field.name) for p in parts]) for field in fields(CaseOutcome))
    )


def try_block(config: Config, rng: np.random.Generator) -> CaseOutcome:
    """Return what came of a block of epochs."""
    epochs = draw(config, min(config.epochs, BLOCK), rng)
    return fix(config, epochs) if config.full else solve(config, epochs)


def run(config: Config, scale: Scale | None = None) -> CaseOutcome:
    """Return what came of all epochs."""
    blocks = max(1, config.epochs // BLOCK)
    return joined(run_many(try_block, [config] * blocks, seed=config.seed, **(scale or {})))


def figures(outcomes: CaseOutcome, config: Config, risk: Risk | None = None) -> Figures:
    """Return the figures of all epochs."""
    risk = Risk() if risk is None else risk
    faulted, clean = outcomes.faulted, ~outcomes.faulted
    unseen = int(np.sum(outcomes.beyond & ~outcomes.alarm & faulted))
    alarms = int(np.sum(outcomes.alarm & clean))
    limit = upper_limit(unseen, int(np.sum(faulted)))
    known = np.isfinite(outcomes.ratio)
    return Figures(
        epochs=len(faulted),
        faulted=int(np.sum(faulted)),
        unseen=unseen,
        unseen_limit=limit,
        hazard_limit=limit * config.beacons * risk.fault,
        false_alarm_rate=alarms / int(np.sum(clean)),
        false_alarm_limit=upper_limit(alarms, int(np.sum(clean))),
        detected=float(np.mean(outcomes.alarm[faulted])),
        median_ratio=float(np.median(outcomes.ratio[known & clean])),
        finite=float(np.mean(known[clean])),
    )


def upper_limit(count: int, of: int) -> float:
    """Return the upper confidence limit of a probability (C. Clopper and E. Pearson, 1934)."""
    return float(beta.ppf(CONFIDENCE, count + 1, of - count)) if count < of else 1.0


def report(result: Figures) -> str:
    """Return what a reader sees."""
    return "\n".join(
        (
            f"{result.epochs} epochs, {result.faulted} of them with a false beacon;"
            f" {result.detected:.1%} of these are findings",
            f"  beyond the level, unseen       {result.unseen}: at most {result.unseen_limit:.2g}"
            f" of the faulty, {result.hazard_limit:.2g} an epoch",
            f"  alarms without a fault         {result.false_alarm_rate:.2g} of the epochs, at most"
            f" {result.false_alarm_limit:.2g}",
            f"  level over the 3-sigma radius  {result.median_ratio:.2f} (median), finite in"
            f" {result.finite:.2%}",
        )
    )


def main() -> None:
    """Print the figures and one JSON line."""
    parser = scenario_parser(
        __doc__, Config.seed, "twenty thousand epochs", output=None, parallel=True
    )
    parser.add_argument("--full", action="store_true", help="fix every epoch, of a tenth as many")
    given = parser.parse_args()
    count = 20_000 if given.quick else Config.epochs
    config = Config(epochs=count // 10 if given.full else count, full=given.full, seed=given.seed)
    result = figures(run(config, chosen_scale(given)), config)
    conclude(report(result), result._asdict())


if __name__ == "__main__":
    main()
