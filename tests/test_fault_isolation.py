"""A mistake names itself on a short log; a clean log names none."""

from dataclasses import replace
from functools import lru_cache

import mistake_case
import numpy as np
import pytest
from mistake_case import Case, good_case, simulated, with_sigma
from mistake_list import MISTAKES

from magfusion.estimation.data_checks.data_quality import recorded
from magfusion.estimation.demodulation.demodulation import demodulated
from magfusion.estimation.integrity.explanation import Explanation, clearly_best
from magfusion.estimation.integrity.fault_isolation import (
    diagnosed,
    seen_in_streams,
    with_cause,
    with_explaining_cause,
)
from magfusion.estimation.integrity.field_snapshots import snapshots_of
from magfusion.estimation.integrity.hypothesis_tests import cause_of
from magfusion.estimation.integrity.motion_causes import timing_causes
from magfusion.estimation.integrity.motion_comparison import compared, surveyed
from magfusion.model.parameters import initial_calibration
from magfusion.model.trust import CODES, Finding, Trust, Verdict
from magfusion.simulation.config import MotionKind, SimulationConfig
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.motion import Rests
from magfusion.units import DEGREE

SECONDS = 16.0

# One of each kind, with the code that is to be named.
NAMED = {
    "phase_sign": "phase_sign",
    "coil_reversed": "coil_reversed",
    "beacon_reversed": "coil_reversed",
    "frequency_10mhz": "beacon_clock",
    "coils_swapped_all": "coils_swapped",
    "positions_swapped": "beacons_swapped",
    "moments_rms": "moment_units",
    "matrix_scale_5pct": "field_scale",
    "frequencies_permuted": "beacons_swapped",
    "moments_A_ten_times": "moments",
    "position_sign": "beacon_pose",
    "moments_A_20pct": "moments",
    "moved_50cm": "beacon_pose",
    "beacon_turned_90deg": "beacon_pose",
    "beacon_inverse": "angle_convention",
    "beacon_rpy_radians": "angle_units",
    "phase_rad_for_deg": "phase_units",
    "phase_10deg_one": "phase",
    "coil_phase_8deg": "phase",
    "survey_mirrored": "survey_axes",
    "survey_in_feet": "length_units",
    "mounting_x180": "mounting",
    "lever_in_cm": "lever_arm",
    "one_never_on": "silent_beacon",
    "gyro_sign": "gyro_sign",
    "gyro_deg_s": "gyro_units",
    "accel_sign": "gravity_sign",
    "accel_in_g": "accel_units",
    "accel_y_in_g": "accel_units",
    "gravity_removed": "gravity_missing",
    "imu_xy_swapped": "imu_axes",
    "imu_1s_late": "time_offset",
    "epoch_12ms": "epoch_shift",
    "magnetometer_clock_1000ppm": "sample_rate",
    "magnetometer_z_sign": "magnetometer_axes",
    "body_iron": "magnetometer_matrix",
    "false_20pct_15s": "beacon_fault",
    "drives_free_running": "beacon_clock",
}


QUICK = (
    "beacon_reversed",
    "moments_rms",
    "moved_50cm",
    "gyro_sign",
    "gravity_removed",
    "epoch_12ms",
)


@lru_cache(maxsize=1)
def _short() -> Case:
    config = SimulationConfig(
        box_world=DEMO_BOX_WORLD,
        duration=SECONDS,
        motion="turn",
        time_offset=0.004,
        rests=Rests(start=2.0, move=20.0),
    )
    return simulated(demo_site(coil_radius=None), config, seed=5)


@pytest.mark.slow
@pytest.mark.parametrize("name", QUICK)
def test_a_mistake_names_itself(name: str) -> None:
    _names_itself(name, NAMED[name])


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(set(NAMED) - set(QUICK)))
def test_every_mistake_names_itself(name: str) -> None:
    _names_itself(name, NAMED[name])


def _names_itself(name: str, code: str) -> None:
    case = MISTAKES[name].change(_short())
    result = cause_of(case.log, case.site)
    assert result is not None
    explanation, text = result
    assert explanation.code == code
    assert code in CODES
    assert "chi square" in text
    assert explanation.after < 0.4 * explanation.before


@pytest.mark.slow
@pytest.mark.parametrize(("factor", "side"), [(1, "12 ms late"), (-1, "12 ms early")])
def test_an_epoch_shift_says_its_side_and_the_remedy_of_a_bag(factor: int, side: str) -> None:
    case = _short()
    log = case.log
    assert log.waveform is not None
    wave = replace(log.waveform, time=log.waveform.time + 0.012 * factor)
    imu = replace(log.imu, time=log.imu.time + 0.012 * factor)
    result = cause_of(replace(log, waveform=wave, imu=imu), case.site)
    assert result is not None
    assert side in result[1]
    assert "magfusion import --epoch NS" in result[1]


@pytest.mark.parametrize("seed", [1])
@pytest.mark.parametrize("motion", ["walk", "static"])
def test_a_clean_log_names_none(motion: str, seed: int) -> None:
    config = SimulationConfig(
        box_world=DEMO_BOX_WORLD,
        duration=12.0,
        motion="walk" if motion == "walk" else "static",
        time_offset=0.0,
    )
    case = simulated(demo_site(coil_radius=None), config, seed)
    assert cause_of(case.log, case.site) is None


@pytest.mark.parametrize(("seed", "motion"), [(8, "turn"), (10, "walk")])
def test_survey_errors_as_declared_name_none(seed: int, motion: MotionKind) -> None:
    # One error of a survey is the same at all epochs: each is no evidence of its own.
    site = demo_site(coil_radius=None)
    beacons = tuple(with_sigma(b, 0.01, 0.5 * DEGREE, 0.01) for b in site.beacons)
    config = SimulationConfig(
        box_world=DEMO_BOX_WORLD, duration=12.0, motion=motion, time_offset=0.0
    )
    case = simulated(replace(site, beacons=beacons), config, seed)
    assert cause_of(case.log, case.site) is None


def test_unknown_drive_phases_are_no_contradiction() -> None:
    site = demo_site(coil_radius=None, synchronised=False)
    beacons = tuple(with_sigma(b, 0.01, 0.5 * DEGREE, 0.01) for b in site.beacons)
    config = SimulationConfig(
        box_world=DEMO_BOX_WORLD, duration=8.0, motion="turn", time_offset=0.0
    )
    case = simulated(replace(site, beacons=beacons), config, seed=3)
    samples = demodulated(case.log, case.site).fields
    assert snapshots_of(samples, case.imu, case.site).excess < 1.2
    assert cause_of(case.log, case.site) is None


@pytest.mark.slow
def test_a_beacon_far_beyond_its_sigma_is_named() -> None:
    site = demo_site(coil_radius=None)
    beacons = tuple(with_sigma(b, 0.01, 0.5 * DEGREE, 0.01) for b in site.beacons)
    site = replace(site, beacons=beacons)
    config = SimulationConfig(
        box_world=DEMO_BOX_WORLD, duration=12.0, motion="turn", time_offset=0.0
    )
    case = simulated(site, config, seed=2)
    moved = replace(
        beacons[2], position_world=beacons[2].position_world + np.array([0.12, -0.1, 0.05])
    )
    result = cause_of(case.log, replace(site, beacons=(*beacons[:2], moved, beacons[3])))
    assert result is not None
    assert (result[0].code, result[0].beacon) == ("beacon_pose", moved.name)


def test_wide_windows_average_the_motion_of_either_sensor() -> None:
    # Two tones 3.8 Hz apart: windows of 0.53 s, 0.26 s from one to the next.
    site = demo_site(coil_radius=None)
    beacons = tuple(
        replace(b, frequency_hz=f)
        for b, f in zip(site.beacons, (24.7, 28.5, 37.3, 58.2), strict=True)
    )
    site = replace(site, beacons=beacons)
    config = SimulationConfig(
        box_world=DEMO_BOX_WORLD, duration=SECONDS, motion="turn", time_offset=0.0
    )
    case = simulated(site, config, seed=4)
    samples = demodulated(case.log, site).fields
    assert np.median(samples.window) > 0.5
    every = surveyed(samples, initial_calibration(site, float(np.mean(samples.time))))
    motion = compared(every, case.imu, site)
    assert motion is not None
    chi_square, _ = motion.explained(np.eye(3), np.eye(3))
    assert chi_square < 1.3 * motion.freedom


@pytest.mark.slow
def test_nothing_is_tried_of_what_is_trustworthy_or_explains_itself() -> None:
    case = MISTAKES["gyro_sign"].change(_short())
    assert diagnosed(case.log, case.site, Trust()) is None
    frozen = Finding("frozen_imu", "The IMU stands still.")
    assert diagnosed(case.log, case.site, Trust((frozen,))) is None
    doubt = Trust((Finding("not_converged", "It did not converge."),))
    result = diagnosed(case.log, case.site, doubt)
    assert result is not None
    assert result.finding.verdict is Verdict.DOUBTFUL
    assert (doubt | Trust((result.finding,))).ordered[0].code == "gyro_sign"
    assert result.site is not None
    assert cause_of(case.log, result.site) is None  # the site undoes it


def test_of_two_causes_that_explain_alike_none_is_named() -> None:
    one = Explanation("phase", "", "", 5000.0, 100.0, 400.0)
    assert clearly_best([one]) is one
    assert clearly_best([one, Explanation("moments", "", "", 5000.0, 110.0, 400.0)]) is None
    # The same cause in other words is no rival; nor is what explains less.
    assert clearly_best([one, Explanation("phase", "", "", 5000.0, 101.0, 400.0)]) is one
    assert clearly_best([one, Explanation("moments", "", "", 5000.0, 400.0, 400.0)]) is one
    assert clearly_best([Explanation("phase", "", "", 500.0, 400.0, 400.0)]) is None
    assert clearly_best([]) is None
    assert clearly_best([Explanation("phase", "", "", np.nan, np.nan, 400.0)]) is None
    # Much less than before, and yet far from explained.
    assert clearly_best([Explanation("moment_units", "", "", 3.5e4, 1010.0, 144.0)]) is None


def test_what_says_why_comes_before_what_only_says_where() -> None:
    without = Explanation("beacon_fault", "", "", 5000.0, 80.0, 400.0, 3, "B", catch_all=True)
    clock = Explanation("beacon_clock", "", "", 5000.0, 98.0, 400.0, 2, "B")
    assert clearly_best([without, clock]) is clock
    assert clearly_best([without, replace(clock, beacon="")]) is not without
    # Which of two beacons it is, neither tells.
    assert clearly_best([without, replace(clock, beacon="A")]) is None
    # What leaves more than the limit does not explain what the beacon's absence does.
    assert clearly_best([without, replace(clock, after=500.0)]) is without


@pytest.mark.slow
def test_a_line_that_is_seen_comes_before_a_beacon_that_is_only_false() -> None:
    case = MISTAKES["line_on_tone"].change(_short())
    line = Finding("undeclared_line", "A line beside the tone of beacon B.")
    trust = Trust((line,))
    trust = with_cause(trust, diagnosed(case.log, case.site, trust))
    assert [finding.code for finding in trust.reasons] == ["undeclared_line", "beacon_fault"]


def test_errors_of_a_rough_survey_are_no_contradiction_of_the_inertial_sensor() -> None:
    site = good_case("rough", 3).site
    config = SimulationConfig(
        box_world=DEMO_BOX_WORLD, duration=SECONDS, motion="turn", time_offset=0.004
    )
    case = simulated(site, config, seed=3)
    samples = demodulated(case.log, site).fields
    every = surveyed(samples, initial_calibration(site, float(np.mean(samples.time))))
    known = compared(every, case.log.imu, site)
    taken_for_sure = compared(
        replace(every, by_survey=np.zeros((*every.by_survey.shape[:2], 0))), case.log.imu, site
    )
    assert known is not None
    assert taken_for_sure is not None
    assert known.explained(np.eye(3), np.eye(3))[0] < known.freedom
    assert taken_for_sure.explained(np.eye(3), np.eye(3))[0] > 2.0 * known.freedom
    # Its stamps are late by what is declared to be possible.
    reported = timing_causes(every, case.log.imu, site, 1e6, known.freedom)
    assert "time_offset" not in {one.code for one in reported}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["lever_20cm", "survey_overconfident"])
def test_a_mistake_names_itself_in_a_rough_survey(name: str) -> None:
    config = SimulationConfig(
        box_world=DEMO_BOX_WORLD, duration=SECONDS, motion="turn", time_offset=0.004
    )
    case = MISTAKES[name].change(simulated(good_case("rough", 3).site, config, seed=3))
    result = cause_of(case.log, case.site)
    assert result is not None
    assert result[0].code in MISTAKES[name].codes


@pytest.mark.slow
def test_most_mistakes_in_motion_are_named_rightly_and_few_wrongly(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(mistake_case, "DURATION", 30.0)
    good_case.cache_clear()
    right, wrong, requested = 0, [], 0
    for name, mistake in list(MISTAKES.items())[::2]:  # each takes seconds
        if not mistake.codes or name not in NAMED:
            continue
        case = mistake.change(good_case("rough", 3))
        if seen_in_streams(Trust(recorded(case.log, case.site))):
            continue
        result = cause_of(case.log, case.site)
        requested += 1
        if result is None:
            continue
        if result[0].code in mistake.codes:
            right += 1
        else:
            wrong.append((name, result[0].code))
    good_case.cache_clear()
    assert right >= 0.6 * requested
    # Next of kin: coil and phase, units and scale, lever arm and place.
    assert len(wrong) <= 0.2 * requested, wrong


@pytest.mark.parametrize("code", ["gyro_units", "gravity_missing", "mounting", "stuck_axis"])
def test_what_gravity_and_field_fail_comes_before_a_change_that_follows(code: str) -> None:
    """A log whose axes or units are wrong throughout fits a step somewhere, too."""
    change = Finding("changed", "A parameter changed.", Verdict.FAILED, 900.0)
    wrong = Finding(code, "It is wrong throughout.", Verdict.FAILED, 20.0)
    for trust in (Trust((change, wrong)), Trust((wrong, change))):
        assert with_explaining_cause(trust, None).ordered[0].code == code
    assert with_explaining_cause(Trust((change,)), None).ordered[0].code == "changed"
