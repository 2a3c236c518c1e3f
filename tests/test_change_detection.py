"""What becomes another while a log runs is said: what, how much and since when."""

import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from small_problem import small_log

from magfusion.estimation.batch.batch import SmootherSettings, smooth
from magfusion.estimation.integrity.change_detection import STAMPS, StepChange
from magfusion.estimation.integrity.judge import judge_result
from magfusion.model.parameters import (
    GAIN,
    Block,
    initial_calibration,
    linearize_channels,
    placed,
    predict_channels,
)
from magfusion.model.samples import FieldSamples, Log
from magfusion.model.site import Site
from magfusion.model.trust import CODES, Trust
from magfusion.results.errors import trajectory_errors
from magfusion.units import Array, ComplexArray

COVERED = 15.0  # mean NEES of a result that has been made honest
Change = Callable[[FieldSamples, ComplexArray, Array], ComplexArray]


@cache
def a_log(seed: int) -> tuple[Log, Site]:
    small = small_log(seed, epochs=60, sigma=2e-9, perturb=False)
    return small.log, replace(small.site, model_error=1e-3)


def judgement_of(change: Change) -> tuple[Trust, float]:
    log, site = a_log(1)
    fields = log.fields
    assert fields is not None
    middle = 0.5 * (fields.time[0] + fields.time[-1])
    after = (fields.time >= middle)[:, None, None]
    tones = np.concatenate([b.tone_frequencies_hz for b in site.beacons])
    other = np.where(after, change(fields, fields.phasor_sensor, tones), fields.phasor_sensor)
    log = replace(log, fields=replace(fields, phasor_sensor=other))
    result, trust = judge_result(smooth(log, site, SmootherSettings(loss="cauchy")), log)
    assert log.truth is not None
    errors = trajectory_errors(result.states, log.truth, max_gap=1.0)
    assert errors.nees is not None
    return trust, float(np.mean(errors.nees))


def _all_stronger(_: FieldSamples, phasor: ComplexArray, __: Array) -> ComplexArray:
    return 1.02 * phasor


def _one_stronger(fields: FieldSamples, phasor: ComplexArray, _: Array) -> ComplexArray:
    own = np.array([name == fields.channels[0][0] for name, _ in fields.channels])
    return np.where(own[:, None], 1.03 * phasor, phasor)


def _slipped(_: FieldSamples, phasor: ComplexArray, __: Array) -> ComplexArray:
    return phasor @ Rotation.from_rotvec([0.0, 2.0, 0.0], degrees=True).as_matrix()


def _late(_: FieldSamples, phasor: ComplexArray, tones_hz: Array) -> ComplexArray:
    return phasor * np.exp(-2j * np.pi * tones_hz * 1e-4)[:, None]


CHANGES: dict[str, tuple[Change, str, float]] = {
    "a range is switched": (_all_stronger, "the strength of all fields", 2.0),  # %
    "a beacon's supply steps": (_one_stronger, "the strength of beacon A", 3.0),  # %
    "it slips in its mount": (_slipped, "the mounting of the magnetometer", 2.0),  # deg
    "its stamps jump": (_late, "the stamps of the magnetometer", 0.1),  # ms
}


@pytest.mark.parametrize(("change", "what", "amount"), CHANGES.values(), ids=CHANGES)
def test_a_change_is_named_with_its_size_and_covered(
    change: Change, what: str, amount: str
) -> None:
    trust, nees = judgement_of(change)
    (reported,) = (finding for finding in trust.reasons if finding.code == "changed")
    assert what in reported.text
    number = re.search(r" by ([-+.e\d]+) (%|deg|ms)", reported.text)
    assert number is not None
    assert float(number[1]) == pytest.approx(amount, rel=0.1)
    assert nees < COVERED


def test_where_nothing_changes_nothing_is_said() -> None:
    trust, _ = judgement_of(lambda _, phasor, __: phasor)
    assert not trust.reasons
    assert "changed" in CODES


def test_what_changes_has_no_bearing_before_and_its_own_after() -> None:
    log, site = a_log(1)
    assert log.truth is not None
    known, at = initial_calibration(site, 3.0), log.truth
    time, step = at.time[:20], 1e-6
    pose = at.world_from_body[:20], at.position_world[:20]
    begin = float(time[10])
    names = [beacon.name for beacon in site.beacons]
    kinds = [(StepChange(GAIN, begin), names[1]), (StepChange(STAMPS, begin), STAMPS.owner)]
    blocks = placed(Block(kind, owner, slice(0), np.ones(1)) for kind, owner in kinds)
    _, _, result = linearize_channels(known, blocks, time, *pose)
    assert not np.any(result[:10])
    phasor = predict_channels(known, time, *pose)
    tones = np.concatenate([b.tone_frequencies_hz for b in site.beacons])
    own = np.array([name == names[1] for name, _ in site.channels])
    grown = np.where(own[:, None], phasor * np.exp(step), phasor)
    rotated = phasor * np.exp(-2j * np.pi * tones * step)[:, None]
    for k, other in enumerate((grown, rotated)):
        change = (other - phasor)[10:] / step
        expected = np.concatenate([change.real, change.imag], axis=-1)
        scale = np.max(np.abs(expected))
        np.testing.assert_allclose(result[10:, ..., k], expected, atol=1e-3 * scale)
    assert StepChange(GAIN, 1.0) != StepChange(GAIN, 2.0)
    assert StepChange(GAIN, 1.0) == StepChange(GAIN, 1.0)
