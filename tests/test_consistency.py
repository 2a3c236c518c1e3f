"""Whether the smoother's sigmas are honest: normalised errors over many simulated runs.

Every run draws its own calibration from the prior, its own IMU clock, motion, IMU and noise.
Where the survey is uncertain, the errors of one run are nearly one error (correlation 0.5 to 0.8
between instants 4 s apart), so that only runs count as independent; with an exact survey the
instants are independent too, which is tested.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from nees import average_nees_bounds
from scipy.stats import binom

from magfusion.estimation.batch.batch import SmootherSettings, smooth
from magfusion.model.parameters import difference, initial_calibration
from magfusion.model.site import BeaconSigma, MagnetometerSigma, Site
from magfusion.receiver.windows import LockinSettings
from magfusion.results.errors import trajectory_errors
from magfusion.results.refinement import parameter_estimates
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import (
    SimulatedLog,
    SimulationConfig,
    simulate_fields,
    simulate_log,
)

pytestmark = pytest.mark.slow

RUNS = 30
INSTANTS = 5
DURATION = 20.0  # s
CONFIDENCE = 0.99
ALL_GROUPS = ("beacons", "moments", "magnetometer", "extrinsics", "time-offset")
# Noise that tunes itself would take a wrong declaration back.
AS_DECLARED = SmootherSettings(loss=None, tune=False)
DISTINCT = LockinSettings(window=0.4, step=0.4)  # windows that share no sample


@dataclass(frozen=True, eq=False)
class RunOutcome:
    """Normalised errors of one run: of five poses, and of the calibration."""

    nees: np.ndarray
    z: np.ndarray
    determined: np.ndarray


def surveyed(scale: float, *, synchronised: bool = True) -> Site:
    """Return the demo site with dipoles for coils and the sigmas of its survey scaled."""
    site = demo_site(coil_radius=None, synchronised=synchronised)

    def scaled(sigma: BeaconSigma) -> BeaconSigma:
        return BeaconSigma(
            scale * sigma.position_world, scale * sigma.rotation_beacon, scale * sigma.log_moment
        )

    sensor = site.platform.magnetometer
    own = sensor.sigma
    sigma = MagnetometerSigma(
        scale * own.matrix, own.offset, scale * own.rotation_sensor, scale * own.position_body
    )
    platform = replace(site.platform, magnetometer=replace(sensor, sigma=sigma))
    beacons = tuple(replace(b, sigma=scaled(b.sigma)) for b in site.beacons)
    return replace(site, model_error=1e-5, beacons=beacons, platform=platform)


def recorded(site: Site, rng: np.random.Generator, imu_noise: float = 1.0) -> SimulatedLog:
    imu = site.platform.imu
    offset = float(rng.normal(0.0, imu.time_offset_sigma))
    rate = float(rng.normal(0.0, imu.clock_rate_sigma))
    config = SimulationConfig(
        DEMO_BOX_WORLD,
        duration=DURATION,
        motion="turn",
        time_offset=offset,
        clock_rate=rate,
        noise_scale=imu_noise,
    )
    return simulate_log(site, config, rng)


def outcomes(simulation: SimulatedLog, site: Site, settings: SmootherSettings) -> RunOutcome:
    result = smooth(simulation.log, site, settings)
    assert result.converged
    assert simulation.log.truth is not None
    nees = trajectory_errors(result.states, simulation.log.truth).nees
    assert nees is not None
    true = initial_calibration(simulation.true_site, 0.0)
    true = replace(true, phase=simulation.drives.phase, drift=simulation.drives.drift)
    reference = result.calibration.reference_time
    phase = true.drive_phase(np.array(reference))
    true = replace(true, phase=phase, reference_time=reference)
    error = difference(true, result.calibration, result.blocks)
    for block in result.blocks:
        if block.kind == "phase":
            error[block.columns] = np.angle(np.exp(1j * error[block.columns]))
    reported = parameter_estimates(
        result.declared, result.calibration, result.blocks, result.calibration_cov
    )
    return RunOutcome(
        nees[np.linspace(3, len(nees) - 4, INSTANTS).astype(int)],
        error / np.sqrt(np.diagonal(result.calibration_cov)),
        np.array([result.determined for result in reported]),
    )


def from_waveform(seed: int, site: Site, settings: SmootherSettings) -> RunOutcome:
    return outcomes(recorded(site, np.random.default_rng(seed)), site, settings)


def from_phasors(seed: int, *, field_noise: float = 1.0, imu_noise: float = 1.0) -> RunOutcome:
    """Smooth a log of phasors whose noise is what was declared, times a factor."""
    rng = np.random.default_rng(seed)
    site = surveyed(0.0)
    built = recorded(site, rng, imu_noise)
    epochs = built.motion.trajectory(np.arange(0.5, DURATION - 0.4, 0.5))
    sigma = 1e-9  # T
    fields = simulate_fields(built.true_site, epochs, field_noise * sigma, rng)
    fields = replace(fields, phasor_cov=fields.phasor_cov / field_noise**2)
    bare = replace(built.log, waveform=None, fields=fields)
    return outcomes(replace(built, log=bare), site, AS_DECLARED)


def over_runs(one: Callable[[int], RunOutcome]) -> list[RunOutcome]:
    return [one(seed) for seed in range(RUNS)]


def pose_nees(outcomes: list[RunOutcome]) -> np.ndarray:
    return np.array([o.nees for o in outcomes])


def between_instants(nees: np.ndarray) -> float:
    """Return the mean correlation of the normalised errors of two instants of one run."""
    return float(np.mean(np.corrcoef(nees.T)[np.triu_indices(INSTANTS, 1)]))


def honest(nees: np.ndarray, independent: int) -> bool:
    """Tell whether the average is what that many independent poses of honest sigmas give."""
    low, high = average_nees_bounds(6, independent, CONFIDENCE)
    return bool(low < np.mean(nees) < high)


def calibration_is_honest(outcomes: list[RunOutcome]) -> bool:
    """Tell whether the parameters that the data determined err as their sigmas say."""
    z = np.concatenate([o.z[o.determined] for o in outcomes])
    # One clock's offset and rate are drawn once a run: their scatter is known no better than that.
    low, high = np.sqrt(average_nees_bounds(1, RUNS, CONFIDENCE))
    if len(z) > 2 * RUNS:
        low, high = 0.85, 1.15
    beyond = int(np.sum(np.abs(z) > 3.0))
    rms = float(np.sqrt(np.mean(z**2)))
    return bool(low < rms < high and beyond <= binom.ppf(0.999, len(z), 0.0027))


@pytest.mark.parametrize(
    ("scale", "synchronised", "groups"),
    [(1.0, True, None), (1.0, True, ALL_GROUPS), (10.0, False, None)],
    ids=["good survey held", "good survey estimated", "bad survey and free clocks estimated"],
)
def test_sigmas_are_honest_where_the_survey_is_uncertain(
    scale: float, synchronised: bool, groups: tuple[str, ...] | None
) -> None:
    site = surveyed(scale, synchronised=synchronised)
    settings = replace(AS_DECLARED, estimate=groups)
    outcomes = over_runs(lambda seed: from_waveform(seed, site, settings))
    nees = pose_nees(outcomes)
    assert between_instants(nees) > 0.3  # which is why only runs count
    assert honest(nees, RUNS), np.mean(nees)
    assert calibration_is_honest(outcomes)
    # The survey's share hides the noise's: sigmas half as large would show all the same.
    assert not honest(4.0 * nees, RUNS)
    assert not honest(nees / 4.0, RUNS)


def test_sigmas_are_honest_where_only_noise_is_left() -> None:
    settings = replace(AS_DECLARED, lockin=DISTINCT)
    site = surveyed(0.0)
    outcomes = over_runs(lambda seed: from_waveform(seed, site, settings))
    nees = pose_nees(outcomes)
    assert abs(between_instants(nees)) < 0.15
    assert honest(nees, RUNS * INSTANTS), np.mean(nees)
    assert calibration_is_honest(outcomes)


def test_overlapping_windows_cost_a_little_honesty_on_the_safe_side() -> None:
    site = surveyed(0.0)
    outcomes = over_runs(lambda seed: from_waveform(seed, site, AS_DECLARED))
    # Each window weighs half; fast errors, which average over fewer, are then overstated.
    average = float(np.mean(pose_nees(outcomes)))
    low, high = average_nees_bounds(6, RUNS * INSTANTS, CONFIDENCE)
    assert 0.8 * low < average < high
    assert calibration_is_honest(outcomes)


def test_sigmas_are_honest_where_the_noise_is_as_declared() -> None:
    outcomes = over_runs(from_phasors)
    nees = pose_nees(outcomes)
    assert abs(between_instants(nees)) < 0.15
    assert honest(nees, RUNS * INSTANTS), np.mean(nees)
    assert calibration_is_honest(outcomes)


def test_noise_half_as_much_again_as_declared_is_found_out() -> None:
    loud_field = over_runs(lambda seed: from_phasors(seed, field_noise=1.5))
    loud_imu = over_runs(lambda seed: from_phasors(seed, imu_noise=1.5))
    for outcomes in (loud_field, loud_imu):
        nees = pose_nees(outcomes)
        assert not honest(nees, RUNS), np.mean(nees)  # even with the wider bounds
        assert not honest(nees, RUNS * INSTANTS)
    assert not calibration_is_honest(loud_field)


def test_white_noise_that_the_receiver_measures_need_not_be_declared() -> None:
    site = surveyed(0.0)
    magnetometer = site.platform.magnetometer
    quiet = replace(magnetometer, noise_density=magnetometer.noise_density / 3.0)
    declared = replace(site, platform=replace(site.platform, magnetometer=quiet))

    def one(seed: int) -> RunOutcome:
        built = recorded(site, np.random.default_rng(seed))
        return outcomes(built, declared, replace(AS_DECLARED, lockin=DISTINCT))

    nees = pose_nees(over_runs(one))
    assert honest(nees, RUNS * INSTANTS), np.mean(nees)
