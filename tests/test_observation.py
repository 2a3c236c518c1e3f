"""The measurement model against difference quotients and against magpylib."""

from dataclasses import replace

import magpylib
import numpy as np
import pytest
from derivatives import central_difference, relative_to_group
from scipy.spatial.transform import Rotation

from magfusion.model.field import observe, predict, skew
from magfusion.model.field_map import FieldMap
from magfusion.model.noise import model_error_cov
from magfusion.model.site import Beacon, BeaconSigma, Coil, Magnetometer, MagnetometerSigma
from magfusion.model.steel_field import SteelField

STEP = 1e-5  # rad, m, 1; its square is the quotient's error where lengths are metres
AGREE = 1e-8  # relative; the quotient's rounding is 1e-16 / STEP

ATTITUDES = {
    "near identity": 1e-7 * np.array([0.3, -0.5, 0.8]),
    "generic": np.array([0.7, -1.1, 0.4]),
    "near a half turn": (np.pi - 1e-6) * np.array([2.0, -1.0, 2.0]) / 3.0,
}


def beacon(coils, synchronised=True):
    none = np.zeros(3)
    return Beacon(
        name="A",
        position_world=np.array([0.4, -0.3, 0.2]),
        world_from_beacon=Rotation.from_euler("xyz", (0.3, -0.4, 2.0)).as_matrix(),
        frequency_hz=25.0,
        coils=coils,
        synchronised=synchronised,
        sigma=BeaconSigma(none, none, np.zeros(len(coils))),
    )


FIELD_MAP = FieldMap(
    points_world=np.array([[1.6, 0.9, 1.2], [2.4, 1.5, 1.9], [3.0, 0.2, 1.0]]),
    weights=np.array([[4.0, -3.0, 2.0, 6.0], [-7.0, 5.0, 1.0, -2.0], [2.0, 4.0, -6.0, 3.0]]),
    information=np.broadcast_to(300.0 * np.eye(4), (3, 4, 4)),
    length_scale=0.9,
    gain_sigma=0.2,
    rotation_sigma=0.15,
    residual=0.01,
)
STEEL = SteelField(
    centre_world=np.array([[3.0, 0.9, 1.2], [2.4, 2.5, 1.9]]),
    radius=np.array([0.2, 0.3]),
    moment_world=np.array(
        [[[3.0, 1.0, -2.0], [0.5, 4.0, 1.0]], [[-1.0, 2.0, 6.0], [2.0, 0.0, 5.0]]]
    ),
)
BEACONS = {
    "two axes": beacon(
        (
            Coil(np.array([220.0, 3.0, -2.0]), phase=0.1),
            Coil(np.array([-4.0, 180.0, 5.0]), phase=-1.5),
        )
    ),
    "three coils, each at its own frequency": beacon(
        (
            Coil(np.array([90.0, 0.0, 4.0]), 0.2, np.array([0.03, -0.01, 0.02]), frequency_hz=21.0),
            Coil(np.array([0.0, 70.0, 0.0]), -0.7, np.array([0.0, 0.05, 0.0]), frequency_hz=23.0),
            Coil(np.array([1.0, 0.0, 110.0]), 2.0, np.array([0.0, -0.02, 0.06]), frequency_hz=27.0),
        )
    ),
    "two axes with a field map": replace(
        beacon((Coil(np.array([220.0, 3.0, -2.0])), Coil(np.array([-4.0, 180.0, 5.0]), -1.5))),
        field_map=FIELD_MAP,
    ),
    "two axes beside steel": replace(
        beacon((Coil(np.array([220.0, 3.0, -2.0])), Coil(np.array([-4.0, 180.0, 5.0]), -1.5))),
        steel=STEEL,
    ),
    "coils of true size": beacon(
        (
            Coil(np.array([220.0, 3.0, -2.0]), radius=0.6),
            Coil(np.array([-4.0, 180.0, 5.0]), -1.5, np.array([0.05, 0.0, 0.1]), 0.4, length=0.8),
            Coil(np.array([3.0, -4.0, 90.0]), 0.3, length=0.5),
            Coil(np.array([3.0, -4.0, 70.0]), 0.8),
        )
    ),
    "loops with a field map": replace(
        beacon((Coil(np.array([220.0, 3.0, -2.0]), radius=0.7), Coil(np.array([0.0, 9.0, 5.0])))),
        field_map=FIELD_MAP,
    ),
    "two axes in conducting ground": replace(
        beacon((Coil(np.array([220.0, 3.0, -2.0]), 0.1), Coil(np.array([-4.0, 180.0, 5.0]), -1.5))),
        conductivity=5e3,  # S/m; a metre and a half of skin depth
    ),
    "one coil": beacon((Coil(np.array([10.0, -20.0, 150.0]), phase=0.4),)),
}

NOTHING = np.zeros(3)
MAGNETOMETER = Magnetometer(
    position_body=np.array([0.15, -0.1, 0.08]),
    body_from_sensor=Rotation.from_euler("xyz", (0.5, -1.2, 2.5)).as_matrix(),
    noise_density=1e-10,
    matrix=np.array([[1.05, 0.02, -0.03], [0.01, 0.93, 0.04], [-0.02, 0.05, 1.08]]),
    offset=NOTHING,
    sigma=MagnetometerSigma(np.zeros((3, 3)), NOTHING, NOTHING, NOTHING),
)
POSITION = np.array([2.1, 1.3, 1.4])

every_beacon = pytest.mark.parametrize("source", BEACONS.values(), ids=BEACONS)
every_attitude = pytest.mark.parametrize("rotvec", ATTITUDES.values(), ids=ATTITUDES)


def attitude(rotvec):
    return Rotation.from_rotvec(rotvec).as_matrix()


def rotated(rotation, rotvec):
    return rotation @ attitude(rotvec)


def phases(source):
    return np.array([0.3, -1.2, 2.2])[: len(source.tones)]


def seen_from(source, rotvec, **options):
    return observe(source, MAGNETOMETER, attitude(rotvec), POSITION, phases(source), **options)


def agrees(block, function):
    expected = central_difference(function, block.shape[-1], STEP)
    return relative_to_group(block, expected) < AGREE


@every_attitude
@every_beacon
def test_the_platforms_block_is_the_right_perturbation_of_its_pose(source, rotvec):
    rotation, phase = attitude(rotvec), phases(source)
    block = seen_from(source, rotvec).platform_pose

    def by_rotation(step):
        return predict(source, MAGNETOMETER, rotated(rotation, step), POSITION, phase)

    def by_translation(step):
        return predict(source, MAGNETOMETER, rotation, POSITION + rotation @ step, phase)

    assert agrees(block[..., :3], by_rotation)
    assert agrees(block[..., 3:], by_translation)


@every_attitude
@every_beacon
def test_the_beacons_block_is_the_right_perturbation_of_its_pose(source, rotvec):
    rotation, phase, frame = attitude(rotvec), phases(source), source.world_from_beacon
    block = seen_from(source, rotvec).beacon_pose

    def by_rotation(step):
        moved = replace(source, world_from_beacon=rotated(frame, step))
        return predict(moved, MAGNETOMETER, rotation, POSITION, phase)

    def by_translation(step):
        moved = replace(source, position_world=source.position_world + frame @ step)
        return predict(moved, MAGNETOMETER, rotation, POSITION, phase)

    assert agrees(block[..., :3], by_rotation)
    assert agrees(block[..., 3:], by_translation)


@every_attitude
@every_beacon
def test_the_sensors_block_is_the_right_perturbation_of_its_mounting(source, rotvec):
    rotation, phase = attitude(rotvec), phases(source)
    mounting, lever = MAGNETOMETER.body_from_sensor, MAGNETOMETER.position_body
    block = seen_from(source, rotvec).body_from_sensor

    def by_rotation(step):
        moved = replace(MAGNETOMETER, body_from_sensor=rotated(mounting, step))
        return predict(source, moved, rotation, POSITION, phase)

    def by_translation(step):
        moved = replace(MAGNETOMETER, position_body=lever + mounting @ step)
        return predict(source, moved, rotation, POSITION, phase)

    assert agrees(block[..., :3], by_rotation)
    assert agrees(block[..., 3:], by_translation)


@every_attitude
@every_beacon
def test_the_matrix_block_goes_row_by_row(source, rotvec):
    def by_matrix(step):
        moved = replace(MAGNETOMETER, matrix=MAGNETOMETER.matrix + step.reshape(3, 3))
        return predict(source, moved, attitude(rotvec), POSITION, phases(source))

    assert agrees(seen_from(source, rotvec).matrix, by_matrix)


@every_attitude
@every_beacon
def test_the_moments_block_is_by_the_logarithm_of_each_coils_moment(source, rotvec):
    def by_logarithm(step):
        coils = tuple(
            replace(c, moment_beacon=c.moment_beacon * np.exp(change))
            for c, change in zip(source.coils, step, strict=True)
        )
        moved = replace(source, coils=coils)
        return predict(moved, MAGNETOMETER, attitude(rotvec), POSITION, phases(source))

    assert agrees(seen_from(source, rotvec).log_moments, by_logarithm)


@every_attitude
@every_beacon
def test_the_phase_block_is_by_the_tones_own_phase_and_no_other(source, rotvec):
    tones = len(source.tones)

    def by_phase(step):
        lag = phases(source) + step
        return predict(source, MAGNETOMETER, attitude(rotvec), POSITION, lag)

    block = seen_from(source, rotvec).phase[..., None] * np.eye(tones)[:, None, :]
    expected = central_difference(by_phase, tones, STEP)
    assert relative_to_group(block, expected) < AGREE


@every_attitude
@every_beacon
def test_the_time_offset_block_goes_back_along_the_twist(source, rotvec):
    rotation, phase = attitude(rotvec), phases(source)
    rate, velocity_body = np.array([0.5, -0.8, 0.3]), np.array([0.4, 1.1, -0.6])

    def by_offset(step):
        # Stamped t but taken later: at the time t of the log the body is not yet there.
        elapsed = -step[0]
        place = POSITION + rotation @ velocity_body * elapsed
        return predict(source, MAGNETOMETER, rotated(rotation, rate * elapsed), place, phase)

    twist = np.concatenate([rate, velocity_body])
    block = seen_from(source, rotvec, twist_body=twist).time_offset
    assert agrees(block[..., None], by_offset)


@every_beacon
def test_without_a_twist_there_is_no_time_offset_block(source):
    assert seen_from(source, ATTITUDES["generic"]).time_offset is None


def magpylibs_coil(coil):
    """Return a dipole, a circle, a cylinder magnetised along its axis, or a line of dipoles."""
    size = np.linalg.norm(coil.moment_beacon)
    if coil.radius is None and coil.length is None:
        return magpylib.misc.Dipole(moment=coil.moment_beacon)
    if coil.radius is None:
        nodes, weights = np.polynomial.legendre.leggauss(40)
        ways = 0.5 * coil.length * nodes[:, None] * coil.moment_beacon / size
        dipoles = zip(ways, 0.5 * weights, strict=True)
        return magpylib.Collection(
            *(magpylib.misc.Dipole(moment=w * coil.moment_beacon, position=x) for x, w in dipoles),
            override_parent=True,
        )
    area = np.pi * coil.radius**2
    if coil.length is None:
        built = magpylib.current.Circle(diameter=2.0 * coil.radius, current=size / area)
    else:
        magnetisation = (0.0, 0.0, size / (area * coil.length))
        built = magpylib.magnet.Cylinder(
            dimension=(2.0 * coil.radius, coil.length), magnetization=magnetisation
        )
    return built.rotate(Rotation.align_vectors(coil.moment_beacon, [0.0, 0.0, 1.0])[0])


@every_attitude
@every_beacon
def test_the_value_is_what_a_magnetometer_sees_of_magpylibs_sources(source, rotvec):
    rotation, lag = attitude(rotvec), phases(source)
    sensor_world = POSITION + rotation @ MAGNETOMETER.position_body
    measured_from_world = MAGNETOMETER.matrix @ (rotation @ MAGNETOMETER.body_from_sensor).T
    sources = []
    for coil in source.coils:
        own = magpylibs_coil(coil).move(coil.centre_beacon)
        own.rotate(Rotation.from_matrix(source.world_from_beacon), anchor=0)
        sources.append(own.move(source.position_world))
    fields_world = np.array([s.getB(sensor_world) for s in sources])
    bare = replace(source, field_map=None, steel=None, conductivity=0.0)
    value = seen_from(bare, rotvec).phasor_sensor
    # The currents and the field are followed as functions of time over a cycle.
    cycle = np.linspace(0.0, 2.0 * np.pi, 7)
    tones = [(c.frequency_hz or source.frequency_hz) for c in source.coils]
    for k, frequency_hz in enumerate(source.tone_frequencies_hz):
        currents = np.array(
            [
                np.cos(cycle + c.phase + lag[k]) * (tone == frequency_hz)
                for c, tone in zip(source.coils, tones, strict=True)
            ]
        )
        expected = (measured_from_world @ fields_world.T @ currents).T
        result = np.real(value[k] * np.exp(1j * cycle)[:, None])
        # magpylib takes mu0 as measured, which is 4 pi 1e-7 within 1e-9.
        assert relative_to_group(result, expected) < 1e-9


@every_attitude
def test_a_field_map_turns_and_stretches_the_field_in_world_axes(rotvec):
    source = BEACONS["two axes with a field map"]
    rotation = attitude(rotvec)
    sensor_world = POSITION + rotation @ MAGNETOMETER.position_body
    log_gain, *turn_world = FIELD_MAP.mean(sensor_world)[0]
    measured_from_world = MAGNETOMETER.matrix @ (rotation @ MAGNETOMETER.body_from_sensor).T
    plain = seen_from(replace(source, field_map=None), rotvec).phasor_sensor
    plain_world = plain @ np.linalg.inv(measured_from_world).T
    mapped_world = np.exp(log_gain) * (plain_world + np.cross(turn_world, plain_world))
    result = seen_from(source, rotvec).phasor_sensor
    assert abs(log_gain) > 0.01
    assert relative_to_group(result, mapped_world @ measured_from_world.T) < 1e-13


def test_the_offset_of_the_magnetometer_leaves_phasors_alone():
    source = BEACONS["two axes"]
    moved = replace(MAGNETOMETER, offset=np.array([1e-5, 2e-5, -3e-5]))
    rotation = attitude(ATTITUDES["generic"])
    result, expected = (predict(source, m, rotation, POSITION) for m in (moved, MAGNETOMETER))
    assert np.array_equal(result, expected)


@every_beacon
def test_without_a_phase_the_drive_is_as_the_coils_declare(source):
    rotation = attitude(ATTITUDES["generic"])
    args = source, MAGNETOMETER, rotation, POSITION
    bare, zero = observe(*args), observe(*args, np.zeros(len(source.tones)))
    for name, block in vars(zero).items():
        if block is not None:
            assert np.array_equal(getattr(bare, name), block), name


@every_beacon
def test_predict_gives_the_value_of_observe(source):
    value = predict(source, MAGNETOMETER, attitude(ATTITUDES["generic"]), POSITION, phases(source))
    seen = seen_from(source, ATTITUDES["generic"]).phasor_sensor
    assert relative_to_group(seen, value) < 1e-14


@every_beacon
def test_a_batch_is_what_its_epochs_are(source):
    rng = np.random.default_rng(1)
    rotation = Rotation.random(6, random_state=2).as_matrix().reshape(2, 3, 3, 3)
    position = POSITION + rng.normal(0.0, 0.5, (2, 3, 3))
    phase = rng.uniform(-3.0, 3.0, (2, 3, len(source.tones)))
    twist = rng.normal(size=(2, 3, 6))
    batch = observe(source, MAGNETOMETER, rotation, position, phase, twist)
    for epoch in np.ndindex(2, 3):
        single = observe(
            source, MAGNETOMETER, rotation[epoch], position[epoch], phase[epoch], twist[epoch]
        )
        for name, block in vars(single).items():
            if block is not None:
                assert relative_to_group(getattr(batch, name)[epoch], block) < 1e-13, name


def test_model_error_is_a_share_of_the_mean_square_of_the_quadratures():
    phasor = 1e-7 * np.array([3.0 + 4.0j, 0.0, 12.0j])  # mean square (25 + 144) / 2
    cov = model_error_cov(np.stack([phasor, 2.0 * phasor]), 0.02)
    expected = 0.02**2 * 1e-14 * 84.5 / 3.0 * np.eye(3)
    np.testing.assert_allclose(cov, [expected, 4.0 * expected], rtol=1e-13, atol=0.0)


def test_model_error_is_the_same_for_every_attitude_and_drive_phase():
    source, rng = BEACONS["two axes"], np.random.default_rng(3)
    sensor = replace(MAGNETOMETER, matrix=np.eye(3), position_body=NOTHING)
    rotation = Rotation.random(20, random_state=4).as_matrix()
    position = np.broadcast_to(POSITION, (20, 3))
    phasor = predict(source, sensor, rotation, position, rng.uniform(-3.0, 3.0, (20, 1)))
    cov = model_error_cov(phasor, 0.01)
    np.testing.assert_allclose(cov, np.broadcast_to(cov[:1], cov.shape), rtol=1e-12, atol=0.0)


def test_the_skew_matrix_is_the_cross_product():
    rng = np.random.default_rng(5)
    a, b = rng.normal(size=(2, 4, 3)) + 1j * rng.normal(size=(2, 4, 3))
    np.testing.assert_allclose((skew(a) @ b[..., None])[..., 0], np.cross(a, b), rtol=1e-13)
