"""Ground that conducts: its field and derivatives, how it is declared, what jobs make of it."""

from dataclasses import replace

import numpy as np
import pytest
from derivatives import central_difference, relative_to_group
from through_rock import (
    ROCK,
    Config,
    Place,
    log_at,
    site_at,
    smoothed,
    true_site,
    wrong_site,
)

from magfusion.errors import InputError
from magfusion.estimation.demodulation.burial_depth import depths_of
from magfusion.estimation.demodulation.demodulation import phasors
from magfusion.estimation.snapshot.likelihood import fix_epochs
from magfusion.files.site import load_site, save_site
from magfusion.model.coil_field import alone, coil_fields
from magfusion.model.field import driven_field, observe, predict
from magfusion.model.ground import conductivity_of, in_ground
from magfusion.model.parameters import (
    CONDUCTIVITY,
    GROUPS,
    Calibration,
    choose_blocks,
    difference,
    dimension,
    initial_calibration,
    linearize_channels,
    predict_channels,
    retract,
)
from magfusion.model.physics.conduction import conducted_field, decay, skin_depth
from magfusion.model.physics.dipole import dipole_field
from magfusion.model.site import Site
from magfusion.results.coverage import coverage
from magfusion.simulation.demo_site import demo_site
from magfusion.simulation.field import beacon_fields_world, phasors_world
from magfusion.simulation.ground import dipole_in_ground

MOMENT = np.array([3.0, -2.0, 5.0])  # A m^2
TIME = np.array([0.0, 1.0])
POSES = np.tile(np.eye(3), (2, 1, 1)), np.array([[3.0, -1.0, 0.5], [-2.0, 4.0, -1.0]])

# Field (T) of MOMENT at OFFSETS in 0.01 S/m at 1 kHz, by empymod 2.6.1 (Werthmueller, 2017):
# empymod.bipole(msrc=True, mrec=True, depth=[], epermH=[0]) times j w mu0^2, for exp(+j w t).
OFFSETS = np.array([[9.0, 4.0, -12.0], [60.0, -40.0, 70.0], [500.0, 300.0, -550.0]])
EMPYMOD = np.array(
    [
        [
            -2.0304603238424646e-10 - 2.747696114673957e-13j,
            -1.0491458668181234e-12 + 6.157104491945034e-13j,
            2.990549815830865e-11 - 1.6257822646295069e-12j,
        ],
        [
            7.121977669497342e-13 - 1.6594308621048476e-13j,
            -4.747985112998226e-13 + 1.1062872414032318e-13j,
            6.61111266822984e-13 - 2.0855651689346408e-13j,
        ],
        [
            2.9570878312375355e-16 - 1.5809608758164038e-16j,
            -6.680640701340008e-17 + 1.7682137267308597e-17j,
            2.0817373808163758e-16 - 7.190489720630838e-17j,
        ],
    ]
)


def test_the_full_space_is_that_of_empymod_and_of_the_simulator() -> None:
    lag = decay(np.full(len(OFFSETS), 1000.0), 0.01)
    moments = np.broadcast_to(MOMENT, OFFSETS.shape)
    result = dipole_field(OFFSETS, moments) + conducted_field(OFFSETS, moments, lag)
    for field, expected in zip(result, EMPYMOD, strict=True):
        assert relative_to_group(field, expected) < 1e-7
    simulated = dipole_in_ground(OFFSETS, MOMENT, 1000.0, 0.01)
    for field, expected in zip(simulated, EMPYMOD, strict=True):
        assert relative_to_group(field, expected) < 1e-7


@pytest.mark.parametrize("depths", [0.1, 1.0, 5.0])
def test_the_full_space_is_that_of_empymod_installed(depths: float) -> None:
    empymod = pytest.importorskip("empymod")
    frequency, conductivity = 35.0, 0.2
    towards = np.array([0.5, -0.6, 0.62])
    offset = depths * float(skin_depth(frequency, conductivity)) * towards
    azimuth, dip = np.arctan2(MOMENT[1], MOMENT[0]), np.arcsin(MOMENT[2] / np.linalg.norm(MOMENT))
    source = [0.0, 0.0, 0.0, np.degrees(azimuth), np.degrees(dip)]
    seen = [
        empymod.bipole(
            source,
            [*offset, *angles],
            depth=[],
            res=1.0 / conductivity,
            freqtime=frequency,
            msrc=True,
            mrec=True,
            epermH=[0],
            verb=0,
        )
        for angles in ((0, 0), (90, 0), (0, 90))
    ]
    to_tesla = 2j * np.pi * frequency * (4e-7 * np.pi) ** 2 * np.linalg.norm(MOMENT)
    expected = to_tesla * np.squeeze(seen)
    lag = decay(np.array(frequency), conductivity)
    result = dipole_field(offset, MOMENT) + conducted_field(offset, MOMENT, lag)
    assert relative_to_group(result, expected) < 1e-6


def test_the_field_lags_behind_the_current() -> None:
    """On its axis a dipole's phasor turns back from that of its current, as a cosine comes late."""
    offset, moment = np.array([0.0, 0.0, 80.0]), np.array([0.0, 0.0, 1.0])
    field = dipole_field(offset, moment) + conducted_field(
        offset, moment, decay(np.array(1000.0), 0.01)
    )
    assert -0.5 * np.pi < np.angle(field[2]) < -0.01
    assert abs(field[2]) < dipole_field(offset, moment)[2]


def salty(**sizes: float) -> Site:
    """Return the demo's beacons in something that conducts: a few metres of skin depth."""
    site = demo_site()
    beacon = site.beacons[0]
    coils = tuple(replace(coil, radius=None, **sizes) for coil in beacon.coils)
    beacons = (replace(beacon, coils=coils), *site.beacons[1:])
    return replace(in_ground(replace(site, beacons=beacons), 800.0), log_conductivity_sigma=0.5)


def test_the_simulators_beacons_are_those_of_the_model_where_they_are_dipoles() -> None:
    beacon, points = salty().beacons[0], np.random.default_rng(1).uniform(2.0, 9.0, (20, 3))
    offset = (points - beacon.position_world) @ beacon.world_from_beacon
    model = coil_fields(alone(beacon), offset) @ beacon.world_from_beacon.T
    assert relative_to_group(beacon_fields_world(beacon, points), model) < 1e-12
    wide = replace(beacon, coils=tuple(replace(c, radius=0.3, length=0.2) for c in beacon.coils))
    model = coil_fields(alone(wide), offset) @ beacon.world_from_beacon.T
    # The model's conduction is that of a dipole: what is left is (size / distance)^2 of it.
    assert 1e-6 < relative_to_group(beacon_fields_world(wide, points), model) < 3e-3


def test_samples_are_phasors_times_what_turns_with_them() -> None:
    beacon, site = salty().beacons[0], salty()
    time = np.linspace(0.0, 0.1, 50)
    carrier = np.exp(2j * np.pi * beacon.frequency_hz * time)[:, None]
    place = np.tile([3.0, 2.0, 1.0], (len(time), 1))
    current = carrier * np.ones((1, 1)) @ beacon.excitation.T
    result = driven_field(beacon, place, current).field
    expected = np.real(phasors_world(beacon, place)[:, 0] * carrier)
    assert relative_to_group(result, expected) < 1e-12
    assert conductivity_of(site) == 800.0


def moved() -> tuple[Calibration, tuple]:
    site = salty()
    return initial_calibration(site, 0.0), choose_blocks(site, GROUPS)


def test_every_column_is_the_derivative() -> None:
    start, blocks = moved()
    wanted = tuple(b for b in blocks if b.group in ("beacons", "moments", "ground", "extrinsics"))
    _, by_pose, by_calibration = linearize_channels(start, blocks, TIME, *POSES, np.zeros((2, 6)))

    def real(at: Calibration) -> np.ndarray:
        phasor = predict_channels(at, TIME, *POSES)
        return np.concatenate([phasor.real, phasor.imag], axis=-1)

    for block in wanted:
        alone_block = (block._replace(columns=slice(0, len(block.sigma))),)
        expected = central_difference(
            lambda step, a=alone_block: real(retract(start, a, step)), len(block.sigma), 1e-5
        )
        assert relative_to_group(by_calibration[..., block.columns], expected) < 1e-7, block.name
    shifted = central_difference(
        lambda step: np.concatenate(
            [
                f(predict_channels(start, TIME, POSES[0], POSES[1] + step))
                for f in (np.real, np.imag)
            ],
            axis=-1,
        ),
        3,
        1e-5,
    )
    assert relative_to_group(by_pose[..., 3:], shifted) < 1e-7


def test_a_step_is_a_factor_and_comes_back() -> None:
    start, blocks = moved()
    only = tuple(b._replace(columns=slice(0, 1)) for b in blocks if b.parameter == CONDUCTIVITY)
    assert dimension(only) == 1
    after = retract(start, only, np.array([-30.0]))
    assert 0.0 < conductivity_of(after.site) == pytest.approx(800.0 * np.exp(-30.0), rel=1e-12)
    np.testing.assert_allclose(difference(start, after, only), [-30.0], rtol=1e-12)


def test_without_conductivity_nothing_of_it_is_there(tmp_path) -> None:
    site = demo_site()
    beacon, magnetometer = site.beacons[0], site.platform.magnetometer
    pose = np.eye(3), np.array([3.0, 2.0, 1.0])
    seen = observe(beacon, magnetometer, *pose)
    assert seen.log_conductivity is None
    assert coil_fields(alone(beacon), pose[1]).dtype == float
    assert all(block.group != "ground" for block in choose_blocks(site, GROUPS))
    save_site(site, tmp_path / "site.yaml")
    assert "conductivity" not in (tmp_path / "site.yaml").read_text()
    thin = replace(beacon, conductivity=1e-12)
    np.testing.assert_allclose(
        predict(thin, magnetometer, *pose), seen.phasor_sensor, rtol=1e-9, atol=1e-20
    )


def test_the_file_has_it_in_its_own_unit(tmp_path) -> None:
    path = tmp_path / "site.yaml"
    save_site(salty(), path)
    again = load_site(path)
    assert conductivity_of(again) == 800.0
    assert again.log_conductivity_sigma == pytest.approx(0.5, rel=1e-12)
    text = path.read_text()
    path.write_text(text.replace("conductivity_s_m: 800.0", "conductivity_s_m: 0.0"))
    with pytest.raises(InputError, match=r"world\.conductivity_s_m.*likely"):
        load_site(path)
    path.write_text(text.replace("conductivity_s_m: 800.0", "conductivity_s_m: 8e5"))
    with pytest.raises(InputError, match="S/m"):
        load_site(path)


DEEP = Place("deep", 100.0, 1000.0, 0.16, 2e3, 1e-18, 0.0, 0.0)  # two and a half skin depths


def test_a_fix_finds_its_way_through_the_lag() -> None:
    site, config = site_at(DEEP), Config(duration=4.0, every=1.0)
    log = log_at(DEEP, config, site)
    assert log.fields is not None
    assert log.truth is not None
    fixes = fix_epochs(log.fields, initial_calibration(site, 0.0)).best()
    near = np.searchsorted(log.truth.time, fixes.time)
    error = fixes.position_world - log.truth.position_world[near]
    assert np.max(np.linalg.norm(error, axis=1)) < 0.02  # the truth's samples are 5 ms apart
    for distance, depths in depths_of(log.fields, site).values():
        assert distance == pytest.approx(100.0, rel=0.25)
        assert depths == pytest.approx(2.5, rel=0.25)


def test_beyond_five_skin_depths_a_log_is_refused() -> None:
    site = site_at(replace(DEEP, conductivity=1.0))
    log = log_at(replace(DEEP, conductivity=1.0), Config(duration=3.0, every=1.0), site)
    with pytest.raises(InputError, match=r"beacon A is about \d+ m away, .* skin depths"):
        phasors(log, site)


def test_what_the_conductivity_may_be_off_by_is_in_the_bound() -> None:
    """Four beacons know the ground by their ranges; a lone one takes ground for distance."""
    points = np.array([[0.0, 0.0, 0.0], [5.0, -3.0, 1.0]])
    for beacons, least, maximum in ((4, 1.003, 1.1), (1, 10.0, 1e4)):
        site = replace(site_at(ROCK), beacons=site_at(ROCK).beacons[:beacons])
        loose = replace(site, log_conductivity_sigma=float(np.log(3.0)))
        known, unknown = (coverage(s, points, 0.5).position_sigma for s in (site, loose))
        assert np.all(unknown > least * known)
        assert np.all(unknown < maximum * known)


def test_a_log_through_rock_is_smoothed_and_its_ground_is_found() -> None:
    log = log_at(ROCK, Config(duration=10.0, every=1.0), true_site(ROCK, 10))
    row = smoothed(log, wrong_site(ROCK), ROCK, 10, "threefold")
    assert row.position_m < ROCK.bound
    assert row.off_in_sigmas is not None
    assert abs(row.off_in_sigmas) < 3.0
