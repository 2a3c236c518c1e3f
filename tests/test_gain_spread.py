"""How far gains scatter, told by the epochs themselves, in rooms of which that is known."""

from dataclasses import replace

import numpy as np
import pytest
from paper_rooms import ROOM, S0, draw_world

from magfusion.estimation.snapshot.fix import Fixes
from magfusion.estimation.snapshot.gain_consistency import gains_of
from magfusion.estimation.snapshot.gain_spread import gain_spread
from magfusion.estimation.snapshot.likelihood import fix_epochs
from magfusion.estimation.snapshot.problem import GAIN_SIGMA
from magfusion.model.parameters import initial_calibration
from magfusion.model.samples import FieldSamples
from magfusion.model.site import Site
from magfusion.model.trust import Verdict

TARGETS = 60
LEVEL = np.eye(3)


def room() -> tuple[Site, FieldSamples, np.ndarray]:
    """Return a room with noise alone: site, fields and where they are."""
    rng = np.random.default_rng(5)
    world = draw_world(S0, rng, ROOM, model_error=0.02)
    targets = ROOM.draw_targets(rng, TARGETS)
    return world.site, world.measure(targets, LEVEL, rng), targets


def scaled(samples: FieldSamples, log_gain: np.ndarray) -> FieldSamples:
    """Return fields times a factor of each beacon, shape (n, beacons)."""
    tones = len(samples.channels) // log_gain.shape[1]
    gain = np.exp(np.repeat(log_gain, tones, axis=1))
    return replace(
        samples,
        phasor_sensor=gain[..., None] * samples.phasor_sensor,
        phasor_cov=gain[..., None, None] ** 2 * samples.phasor_cov,
    )


def fixed(site: Site, samples: FieldSamples) -> tuple[float, Fixes, Fixes]:
    """Return the spread, and the fixes with gains held and with gains that free."""
    calibration = initial_calibration(site, 0.0)
    fixed = fix_epochs(samples, calibration, survey_error=False)
    spread = gain_spread(samples, calibration, fixed, survey_error=False)
    if not spread:
        return spread, fixed, fixed
    free_parameters = fix_epochs(
        samples, calibration, survey_error=False, free_parameters=("gain",), gain_sigma=spread
    )
    return spread, fixed, free_parameters


def error(fixes: Fixes, targets: np.ndarray) -> float:
    return float(np.mean(np.linalg.norm(fixes.position_world[:, 0] - targets, axis=1)))


def test_where_gains_do_not_err_none_are_found() -> None:
    site, samples, _ = room()
    assert fixed(site, samples)[0] == 0.0


@pytest.mark.parametrize("true", [0.08, 0.25])
def test_a_spread_of_gains_is_found_and_the_fixes_are_better_for_it(true: float) -> None:
    site, samples, targets = room()
    gains = np.random.default_rng(6).normal(0.0, true, (TARGETS, len(site.beacons)))
    spread, constant, free_parameters = fixed(site, scaled(samples, gains))
    # Three gains at sixty targets scatter by 5 %; some of each is taken for a position.
    assert spread == pytest.approx(true, rel=0.3)
    assert error(free_parameters, targets) < 0.3 * error(constant, targets)
    result = free_parameters.log_gain[:, 0, :: len(samples.channels) // len(site.beacons)]
    assert np.std(result - gains) < 0.5 * true


def test_too_few_epochs_tell_of_no_spread() -> None:
    site, samples, _ = room()
    few = samples.rows(slice(0, 5))
    assert fixed(site, few)[0] == GAIN_SIGMA


def test_a_moment_that_is_wrong_everywhere_is_named() -> None:
    site, samples, _ = room()
    beacons = tuple(
        replace(b, sigma=replace(b.sigma, log_moment=np.full_like(b.sigma.log_moment, 0.01)))
        for b in site.beacons
    )
    site = replace(site, beacons=beacons)
    gains = np.random.default_rng(7).normal(0.0, 0.05, (TARGETS, len(site.beacons)))
    gains[:, 1] += 0.3
    spread, _, free_parameters = fixed(site, scaled(samples, gains))
    findings = list(gains_of(free_parameters, site, spread))
    assert findings[0].code == "gain_spread"
    assert [f.code for f in findings if f.verdict is Verdict.DOUBTFUL] == ["moments"]
    assert f"beacon {site.beacons[1].name} is 1.3" in findings[1].text


def test_where_no_epoch_tells_a_pose_none_tells_of_a_spread() -> None:
    site, samples, _ = room()
    alone = replace(site, beacons=site.beacons[:1])
    tones = len(alone.beacons[0].tones)
    detected = FieldSamples(
        samples.time,
        samples.window,
        samples.channels[:tones],
        samples.phasor_sensor[:, :tones],
        samples.phasor_cov[:, :tones],
    )
    fixed = fix_epochs(detected, initial_calibration(alone, 0.0), survey_error=False)
    none = replace(fixed, determined=np.zeros_like(fixed.determined))
    assert gain_spread(detected, initial_calibration(alone, 0.0), none) == GAIN_SIGMA
