"""Orientation without beacons, against a truth that knows nothing of the estimator."""

import copy
import io
import json
from dataclasses import replace
from pathlib import Path

import earth_alone as scenario
import earth_twins as twins
import earth_worlds as worlds
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from magfusion.errors import InputError
from magfusion.estimation.orientation.filter import OrientationFilter
from magfusion.estimation.orientation.layout import NEAR, SIZE, SPEED, TURN
from magfusion.estimation.orientation.remarks import remarks
from magfusion.estimation.orientation.smoother import oriented, pieces
from magfusion.files.log import write_log
from magfusion.files.site import save_site
from magfusion.files.stream import read_records
from magfusion.files.stream_contents import imu_content, magnetometer_content, write_record
from magfusion.jobs.inputs import Job
from magfusion.jobs.orientation import run_orientation, run_orientation_stream
from magfusion.jobs.without_beacons import without_beacons
from magfusion.model.progress import quiet
from magfusion.model.samples import ImuSamples, Waveform


@pytest.fixture(scope="module")
def attached():
    return worlds.simulated("magnet attached", 3, duration=30.0, rate=50.0)


@pytest.fixture(scope="module")
def smoothed(attached):
    return oriented(*attached)


@pytest.mark.slow
def test_the_errors_are_as_large_as_is_claimed(attached, smoothed):
    log, _ = attached
    heading, _, tilt = scenario.errors(smoothed.time, smoothed.world_from_body, log.truth)
    claimed = np.rad2deg(
        np.sqrt([np.mean([s.cov[k, k] for s in smoothed.states]) for k in range(3)])
    )
    assert heading < 3.0 * claimed[2]
    assert tilt < 3.0 * np.hypot(*claimed[:2])
    assert tilt < 0.5


def test_an_attached_magnet_is_found_and_said(attached, smoothed):
    log, site = attached
    before, after = (smoothed.states[k].offset for k in (50, -1))
    true = np.diff([log.waveform.measured_sensor[k] - seen(log, k) for k in (200, 1400)], axis=0)
    np.testing.assert_allclose(after - before, 1e6 * true[0], atol=2.5)
    assert 11.5 < smoothed.changed[0] < 14.0
    findings = remarks(
        smoothed.states, smoothed.disturbance, smoothed.changed, np.array([0, 16.4, -41.4])
    )
    assert {"geometry", "body_iron"} <= {finding.code for finding in findings}
    assert site.beacons == ()


def seen(log, k):
    return log.truth.world_from_body[k].T @ worlds.EARTH_WORLD


def test_what_moves_a_state_is_measured_by_what_leads_there(smoothed):
    rng = np.random.default_rng(1)
    state, matrix = smoothed.states[100], np.eye(3) + 0.01 * rng.normal(size=(3, 3))
    step = 0.01 * rng.normal(size=SIZE)
    moved = state.moved(step, matrix)
    np.testing.assert_allclose(state.step_to(moved, matrix), step, rtol=0, atol=1e-12)


def test_the_prediction_of_a_stretch_has_its_derivative(attached):
    log, site = attached
    estimator, cut = OrientationFilter(site), pieces(log, site)
    for stretch in cut[:150]:
        estimator.take(stretch)
    state, matrix = estimator.state, estimator.measured_from_body
    learnt = copy.deepcopy(estimator)  # the speed, with which the field becomes another
    update = estimator.take(cut[150])
    for k in (
        0,
        1,
        2,
        4,
        6,
        7,
        9,
        11,
        12,
        15,
        20,
        21,
        23,
        25,
        30,
        36,
        39,
        40,
        44,
        48,
        49,
        53,
        57,
        60,
    ):
        ends = []
        for sign in (1.0, -1.0):
            step = np.zeros(SIZE)
            step[k] = sign * 1e-5
            other = copy.deepcopy(learnt)
            other.state = state.moved(step, matrix)
            ends.append(update.predicted.step_to(other.take(cut[150]).predicted, matrix))
        off = (ends[0] - ends[1]) / 2e-5 - update.transition[:, k]
        # What the turn does to the force on the way is worked out at the middle of the stretch.
        by_unit = 10.0 if 40 <= k < 49 else 1.0  # rates by the force, m/s^2
        assert np.max(np.abs(off[SPEED])) < 6e-3 * by_unit
        off[SPEED] = 0.0
        assert np.max(np.abs(off)) < 1e-4 + 1e-3 * np.max(np.abs(update.transition[:, k]))


def test_a_site_without_a_field_is_refused(attached):
    _, site = attached
    with pytest.raises(InputError, match="needs the Earth's field"):
        OrientationFilter(replace(site, earth_field_world=None))


def test_what_needs_a_position_is_refused(attached, tmp_path, refuse):
    log, site = attached
    write_log(log, tmp_path / "log")
    save_site(site, tmp_path / "log" / "site.yaml")
    ahead = "--rate", "imu", "--horizon", "0.1"
    sentence = refuse("navigate", tmp_path / "log", *ahead, "-o", tmp_path / "run")
    assert "--horizon is not available for a site without beacons" in sentence


@pytest.mark.slow
def test_a_gap_is_bridged_by_gravity_and_field(attached):
    log, site = attached
    kept = (log.imu.time < 14.0) | (log.imu.time > 18.0)
    imu = ImuSamples(*(getattr(log.imu, n)[kept] for n in ("time", "gyro_body", "accel_body")))
    result = oriented(replace(log, imu=imu), site)
    late = result.time > 22.0
    assert scenario.errors(result.time[late], result.world_from_body[late], log.truth)[2] < 1.5


@pytest.mark.parametrize("name", ["smooth", "navigate"])
def test_the_jobs_write_an_orientation_and_say_that_there_is_no_position(attached, tmp_path, name):
    log, site = attached
    short = replace(
        log,
        imu=ImuSamples(*(getattr(log.imu, n)[:500] for n in ("time", "gyro_body", "accel_body"))),
        waveform=Waveform(log.waveform.time[:500], log.waveform.measured_sensor[:500]),
    )
    write_log(short, tmp_path / "log")
    save_site(site, tmp_path / "log" / "site.yaml")
    job = Job(tmp_path / "log", None, tmp_path / "out")
    assert without_beacons(job)
    figures = dict(run_orientation(name, job, "field", back=name == "smooth", report=quiet))
    written = json.loads((tmp_path / "out" / "report.json").read_text())
    assert written["verdict"] == "trustworthy"
    assert "undetermined" in " ".join(r["text"] for r in written["remarks"])
    assert figures["states"] == 500
    assert figures["tilt_rmse_deg"] < 1.0
    assert {p.name for p in Path(tmp_path / "out").iterdir()} >= {"trajectory.parquet", "run.rrd"}


@pytest.mark.slow
def test_the_pipe_tells_an_orientation_for_each_sample_and_no_position(attached):
    log, site = attached
    source, sink = io.BytesIO(), io.BytesIO()
    for k in range(0, 800, 5):
        own = slice(k, k + 5)
        imu, wave = log.imu, log.waveform
        write_record(
            imu_content(ImuSamples(imu.time[own], imu.gyro_body[own], imu.accel_body[own])),
            source,
            "json",
        )
        write_record(
            magnetometer_content(Waveform(wave.time[own], wave.measured_sensor[own])),
            source,
            "json",
        )
    source.seek(0)
    assert (
        run_orientation_stream(site, read_records(source, "json"), False, sink, io.StringIO()) == 0
    )
    reported = [json.loads(line) for line in sink.getvalue().splitlines()]
    assert len(reported) > 780
    assert {t["position"] for t in reported} == {None}
    time = np.array([t["time"] for t in reported])
    assert np.all(np.diff(time) > 0.0)
    turn = Rotation.from_quat([t["quaternion"] for t in reported], scalar_first=True).as_matrix()
    heading, _, tilt = scenario.errors(time, turn, log.truth)
    assert tilt < 1.0
    assert heading < 8.0


def test_what_swings_with_an_arm_is_not_taken_for_a_bias():
    """Without the arm in the state, tilt errs by .6 degrees here."""
    log, site = worlds.simulated("slow carrying", 0, duration=30.0, rate=50.0, share=0.05)
    result = oriented(log, site, back=False)
    heading, _, tilt = scenario.errors(result.time, result.world_from_body, log.truth)
    assert tilt < 0.5
    assert heading < 1.5
    assert np.max(np.abs(result.states[-1].accel_bias)) < 0.1  # m/s^2; as declared, it is 0.005


@pytest.mark.parametrize("kind", ["slow carrying", "violent carrying"])
def test_the_field_becomes_another_on_half_a_metre_of_way(kind):
    """What is swung past iron at a slower pace would tell an offset, and with it a heading."""
    log, site = worlds.simulated(kind, 0, duration=25.0, rate=50.0)
    estimator = OrientationFilter(site)
    last = [estimator.take(stretch) for stretch in pieces(log, site)][-2]
    assert not last.stretch.rests
    length = last.state.time - last.stretch.begin
    after = -length / np.log(last.transition[NEAR, NEAR][0, 0])
    late = log.truth.time > 20.0
    speed = np.gradient(log.truth.position_world[late], log.truth.time[late], axis=0)
    way = after * np.sqrt(np.mean(np.sum(speed**2, axis=1)))
    assert 0.25 < way < 1.0


def test_speed_does_not_inform_on_the_heading(attached):
    """Motion and a rest after it would otherwise reduce its sigma by linearisation alone."""
    log, site = attached
    estimator = OrientationFilter(site)
    variance = []
    for stretch in pieces(log, site):
        none = replace(stretch, field_time=stretch.field_time[:0], field=stretch.field[:0])
        variance.append(estimator.take(none).state.cov[TURN, TURN][2, 2])
    assert np.min(variance) > 0.999 * variance[0]


@pytest.mark.slow
def test_in_the_mean_it_is_better_than_vqf_and_claims_no_more_than_is_true():
    pytest.importorskip("vqf")
    rows = []
    for kind in ("slow turning", "fast carrying", "both, pauses", "magnet attached"):
        for seed in range(3):
            rows += scenario.rows_of(*worlds.simulated(kind, seed, 30.0, 50.0, 1.0))
    for way in ("online", "offline"):
        ours, others = ([r for r in rows if r.way == w] for w in (way, f"VQF {way}"))
        mean = [np.mean([np.hypot(r.heading_deg, r.tilt_deg) for r in o]) for o in (ours, others)]
        assert mean[0] < mean[1]
        assert np.mean([r.heading_nees for r in ours]) < 1.5


@pytest.mark.slow
def test_drawn_twins_are_not_worse_than_by_vqf():
    pytest.importorskip("vqf")
    rows = [row for seed in range(100, 105) for row in twins.compared(*twins.twin(seed))]
    for way in ("online", "offline"):
        own = [row for row in rows if row.way == way]
        assert np.median([row.ratio for row in own]) < 1.05
        assert np.median([row.heading_nees for row in own]) < 1.5
        assert np.median([row.tilt_nees for row in own]) < 3.0
