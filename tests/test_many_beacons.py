"""Many beacons: which are heard, and whose a phasor is where frequencies are shared."""

from dataclasses import replace
from pathlib import Path

import many_beacons
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from magfusion.errors import InputError
from magfusion.estimation.demodulation.beacon_selection import (
    MAX_START_BEACONS,
    select_detected,
    select_strongest,
)
from magfusion.files.site import load_site, save_site
from magfusion.model.detection_range import are_many, largest_fields, owned_at, tones_of
from magfusion.model.parameters import (
    channels_of,
    choose_blocks,
    initial_calibration,
    linearize_channels,
    of_beacons,
    predict_channels,
    with_undetected,
)
from magfusion.model.samples import FieldSamples, ImuSamples, Log
from magfusion.model.site import BeaconSigma, Site, Slots
from magfusion.model.trajectory import Trajectory
from magfusion.receiver.cells import owned_by, way_of
from magfusion.receiver.windows import default_settings, sent_frequencies_hz
from magfusion.results.coverage import coverage
from magfusion.simulation.field import phasors_world
from magfusion.simulation.log import simulate_fields
from magfusion.units import Array

SIGMA = 4e-10  # T; of a phasor's component


@pytest.fixture(scope="module")
def building() -> Site:
    return many_beacons.building(np.random.default_rng(5), 12, 10, many_beacons.reused_hz)


def walk(count: int, begin: tuple[float, float], step: float = 0.4) -> Trajectory:
    along = step * np.arange(count)
    place = np.stack([begin[0] + along, begin[1] + 0.3 * along, np.full(count, 1.2)], axis=1)
    turn = Rotation.from_euler("z", 0.1 * np.arange(count)[:, None]).as_matrix()
    return Trajectory(0.4 * np.arange(count), turn, place)


def received(site: Site, states: Trajectory, seed: int = 1) -> FieldSamples:
    """Return what a receiver finds of each channel: the sum of all on its frequency."""
    own = simulate_fields(site, states, SIGMA, np.random.default_rng(seed))
    exact = simulate_fields(site, states, 1e-30, np.random.default_rng(seed))
    tones = tones_of(site)
    first = [int(np.argmax(tones.of_channel == k)) for k in tones.of_channel]
    noise = (own.phasor_sensor - exact.phasor_sensor)[:, first]
    of_tone = np.equal.outer(tones.of_channel, tones.of_channel).astype(float)
    sums = np.einsum("cd,ndi->nci", of_tone, exact.phasor_sensor)
    return replace(own, phasor_sensor=sums + noise)


def log_of(fields: FieldSamples) -> Log:
    nothing = ImuSamples(np.arange(2.0), np.zeros((2, 3)), np.zeros((2, 3)))
    return Log("log", 0, "test", nothing, fields=fields)


def test_a_frequency_that_is_used_again_is_one_tone(building: Site) -> None:
    tones, channels = tones_of(building), len(building.channels)
    sent = sent_frequencies_hz(building)
    assert len(set(sent.tolist())) == len(sent) == 40 < channels == 120
    declared = [b.frequency_hz for b in building.beacons]
    assert tones.frequencies_hz[tones.of_channel].tolist() == declared
    assert default_settings(building).window == pytest.approx(0.4)


def test_beacons_that_hear_each_other_do_not_share_a_frequency(building: Site) -> None:
    near = replace(building.beacons[1], frequency_hz=building.beacons[0].frequency_hz)
    with pytest.raises(InputError, match="both transmit at 20 Hz"):
        sent_frequencies_hz(replace(building, beacons=(building.beacons[0], near)))


def test_no_field_is_larger_than_the_largest(building: Site) -> None:
    places = np.random.default_rng(2).uniform([0.0, 0.0, 0.0], [100.0, 60.0, 3.0], (40, 3))
    largest = largest_fields(building, places)
    for k, beacon in enumerate(building.beacons):
        size = np.linalg.norm(phasors_world(beacon, places, None, None)[:, 0], axis=1)
        assert np.all(size <= largest[:, k] * (1.0 + 1e-9))
        assert np.all(size > 0.3 * largest[:, k])


def test_a_phasor_is_of_the_loudest_that_drowns_the_others() -> None:
    site = many_beacons.building(np.random.default_rng(5), 2, 1, lambda _i, _j: 40.0)
    a, b = (beacon.position_world for beacon in site.beacons)
    lateral = np.array([2.0, 0.0, 0.0])
    owned = owned_at(site, np.array([a + lateral, 0.5 * (a + b), b - lateral]))
    assert owned.channels.tolist() == [[True, False], [False, False], [False, True]]
    # What is not foreseen of the other is added to the covariance.
    largest = largest_fields(site, np.array([a + lateral]))
    assert owned.others[0, 0] == pytest.approx(largest[0, 1])


def test_of_many_only_those_are_calculated_that_are_heard(building: Site) -> None:
    sigma = BeaconSigma(np.full(3, 1e-2), np.full(3, 1e-2), np.full(2, 1e-2))
    site = replace(building, beacons=tuple(replace(b, sigma=sigma) for b in building.beacons[:40]))
    calibration, blocks = initial_calibration(site, 0.0), choose_blocks(site)
    states = walk(40, (20.0, 20.0))
    detected = np.random.default_rng(3).random((40, 40)) < 0.1
    place = states.time, states.world_from_body, states.position_world
    twist = np.zeros((40, 6))
    whole = linearize_channels(calibration, blocks, *place, twist)
    some = linearize_channels(calibration, blocks, *place, twist, detected)
    for every, part in zip(whole, some, strict=True):
        size = np.max(np.abs(every))
        np.testing.assert_allclose(part[detected], every[detected], rtol=1e-9, atol=1e-12 * size)


def test_the_strengths_of_tones_tell_the_way(building: Site) -> None:
    states = walk(30, (30.0, 22.0))
    way = way_of(received(building, states), building)
    place, margin = way.at(states.time)
    off = np.linalg.norm((place - states.position_world)[:, :2], axis=1)
    assert np.all(off < margin)
    assert np.median(off) < 2.0


def test_each_phasor_that_is_left_is_of_its_beacon(building: Site) -> None:
    states = walk(30, (30.0, 22.0))
    result = owned_by(received(building, states), building)
    true = simulate_fields(building, states, 1e-30, np.random.default_rng(0)).phasor_sensor
    valid = result.valid
    assert 3 < np.mean(np.sum(valid, axis=1)) < 40
    error = (result.phasor_sensor - true)[valid]
    sigma = np.sqrt(np.trace(result.phasor_cov, axis1=-2, axis2=-1)[valid] / 3.0)
    assert np.max(np.abs(error) / sigma[:, None]) < 6.0
    assert np.sqrt(np.mean(np.abs(error) ** 2 / sigma[:, None] ** 2 / 2.0)) < 1.1


def test_two_halves_alike_are_ambiguous() -> None:
    half = many_beacons.building(np.random.default_rng(5), 8, 5, many_beacons.reused_hz)
    away = np.array([300.0, 0.0, 0.0])
    moved = tuple(
        replace(b, name=f"{b.name}'", position_world=b.position_world + away) for b in half.beacons
    )
    site = replace(half, beacons=(*half.beacons, *moved))
    samples = received(site, walk(10, (40.0, 25.0)))
    with pytest.raises(InputError, match="ambiguous"):
        owned_by(samples, site)


def test_what_is_not_heard_stays_as_declared(building: Site, tmp_path: Path) -> None:
    samples = received(building, walk(20, (30.0, 22.0)))
    log, site = select_detected(log_of(owned_by(samples, building)), building)
    assert 3 < len(site.beacons) < 60
    assert log.fields is not None
    assert log.fields.channels == site.channels
    assert [finding.code for finding in log.findings] == ["beacons_unheard"]
    assert site.every_beacon == building.beacons
    save_site(site, tmp_path / "site.yaml")
    again = load_site(tmp_path / "site.yaml")
    assert [b.name for b in again.beacons] == [b.name for b in building.beacons]
    every = with_undetected(initial_calibration(site, 0.0))
    assert len(every.site.beacons) == len(every.drift) == len(building.beacons)


def test_few_beacons_are_left_as_they_are(building: Site) -> None:
    few = replace(building, beacons=building.beacons[:4])
    log = log_of(simulate_fields(few, walk(3, (3.0, 3.0)), SIGMA, np.random.default_rng(0)))
    assert select_detected(log, few) == (log, few)


def test_the_strongest_of_many_start_and_the_others_wait(building: Site) -> None:
    states = walk(20, (30.0, 22.0))
    beacons = tuple(
        replace(b, frequency_hz=20.0 + 2.5 * k) for k, b in enumerate(building.beacons[:40])
    )
    site = replace(building, beacons=beacons)
    fields = simulate_fields(site, states, SIGMA, np.random.default_rng(0))
    log, some = select_strongest(log_of(fields), site)
    assert len(some.beacons) == MAX_START_BEACONS
    assert some.every_beacon == site.beacons
    assert log.fields is not None
    assert log.fields.channels == some.channels
    power = np.sum(np.abs(fields.phasor_sensor) ** 2, axis=(0, 2))
    weakest = min(power[site.owner == beacons.index(b)].sum() for b in some.beacons)
    assert all(power[site.owner == k].sum() <= weakest for k, _ in some.undetected)
    # What a start must estimate cannot wait.
    unsynchronised = replace(beacons[-1], synchronised=False)
    unready = replace(site, beacons=(*beacons[:-1], unsynchronised))
    assert select_strongest(log_of(fields), unready)[1] is unready


def test_some_beacons_are_predicted_as_among_all(building: Site) -> None:
    calibration, beacons = initial_calibration(building, 0.0), np.array([3, 50, 77])
    states = walk(4, (30.0, 22.0))
    place = states.time, states.world_from_body, states.position_world
    every = predict_channels(calibration, *place)[:, beacons]
    some = predict_channels(of_beacons(calibration, beacons), *place)
    np.testing.assert_allclose(some, every, rtol=1e-9)


def test_coverage_of_many_is_that_of_those_in_reach(building: Site) -> None:
    points: Array = np.array([[40.0, 30.0, 1.2], [42.0, 31.0, 1.2]])
    whole = coverage(building, points, 0.4)
    near = np.max(largest_fields(building, points), axis=0) > SIGMA
    alone = tuple(b for b, detected in zip(building.beacons, near, strict=True) if detected)
    few = coverage(replace(building, beacons=alone[:24]), points, 0.4)
    assert np.all(whole.determined)
    assert np.all(whole.position_sigma < 0.1)
    assert np.all(whole.beacons < len(building.beacons) / 4)
    assert np.all(few.position_sigma > 0.5 * whole.position_sigma)


def test_slots_are_told_apart_by_when_they_are_sent(building: Site) -> None:
    slots = Slots(5e-3, 4)
    first = building.beacons[0]
    coils = tuple(replace(coil, slot=k) for k, coil in enumerate(first.coils))
    site = replace(building, beacons=(replace(first, coils=coils, slots=slots),))
    assert len(site.channels) == 2
    assert not tones_of(site).reused
    assert np.all(owned_at(site, first.position_world + np.eye(3)).channels)


def test_of_several_magnetometers_all_beacons_are_calculated(building: Site) -> None:
    known = building.platform.magnetometer
    pair = replace(known, name="a"), replace(known, name="b", position_body=np.array([0.1, 0, 0]))
    site = replace(building, platform=building.platform.with_magnetometers(pair))
    assert are_many(building)
    assert not are_many(site)
    log = log_of(simulate_fields(site, walk(3, (3.0, 3.0)), SIGMA, np.random.default_rng(0)))
    assert select_detected(log, site) == (log, site)
    calibration, beacons = initial_calibration(site, 0.0), np.array([3, 50, 77])
    states = walk(4, (30.0, 22.0))
    place = states.time, states.world_from_body, states.position_world
    channels = channels_of(site, beacons)
    assert [site.channels[k][0] for k in channels] == [site.beacons[k].name for k in beacons] * 2
    some = predict_channels(of_beacons(calibration, beacons), *place)
    np.testing.assert_allclose(some, predict_channels(calibration, *place)[:, channels], rtol=1e-9)


@pytest.mark.slow
def test_a_building_errs_as_those_that_are_heard() -> None:
    result = many_beacons.compared_detection(0.4, 1)
    assert result["all"].rms_m < 1.2 * result["detected only"].rms_m
    assert result["all"].nees < 6.0
