"""The antennas' model and calibration: the one measurement model, derivatives, ranks, fits."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from derivatives import central_difference
from scipy.spatial.transform import Rotation
from tracker_antennas import (
    Config,
    Errors,
    draw_antennas,
    draw_survey,
    noise_sigma,
    nominal,
    random_poses,
    usual_prior,
)
from tracker_bench import bench_points, helmert, measure
from tracker_site import body_poses, in_beacon, tracker_site
from tracker_table1 import POSITION_BEACON, one_of
from tracker_table1_printed import TABLE

from magfusion.calibration.antenna import (
    AntennaFit,
    AntennaSurvey,
    fit_at_known_poses,
    prior_sigma,
    with_receiver_gain,
)
from magfusion.calibration.antenna_graph import fit_at_uncertain_poses
from magfusion.calibration.antenna_observability import AntennaObservability, observability
from magfusion.errors import EstimationError, InputError
from magfusion.model.antenna import (
    KAPPAS,
    Antenna,
    antenna_from_vector,
    antenna_of,
    observe_antenna,
)
from magfusion.model.field import observe, observe_from, predict
from magfusion.model.physics.dipole import dipole_field
from magfusion.model.physics.finite_size import coil_kappa, coil_shape
from magfusion.model.receive_coils import Observation
from magfusion.model.site import Magnetometer
from magfusion.papers.p000_tracker.equations import (
    attitude_from_angles,
    bursa_wolf_matrix,
    mean_shift,
    shift_as_printed,
)
from magfusion.units import DEGREE


def tracker() -> Antenna:
    """Return one antenna of plausible errors."""
    return draw_antennas(Errors(0.01, 0.5, 2e-3), 1, np.random.default_rng(1)).at(0)


def sized(antenna: Antenna) -> Antenna:
    return antenna_from_vector(np.concatenate([antenna.vector(), [5e-4, 4e-4, 6e-4, 3e-4]]))


# The model


def test_it_is_the_one_measurement_model() -> None:
    rng = np.random.default_rng(0)
    site = tracker_site(rng, gain=0.1, tilt=0.1, centre=0.01)
    beacon, sensor = site.beacons[0], site.platform.magnetometer
    attitude, place = body_poses(site, 6, rng)
    seen = observe_antenna(antenna_of(beacon, sensor), *in_beacon(site, attitude, place))
    turned_back = np.exp(-0.3j * np.arange(3))[:, None]  # of the coils' own phases
    whole = observe(beacon, sensor, attitude, place)
    for result in (whole.phasor_sensor, predict(beacon, sensor, attitude, place)):
        coupling = np.swapaxes(result * turned_back, 1, 2)
        atol = 1e-13 * np.max(seen.value)
        np.testing.assert_allclose(coupling, seen.value, rtol=0, atol=atol)
    # Of the sensor's pose, as observe has it of the mounting; its coils' centres turn with it.
    by_mounting = np.swapaxes(whole.body_from_sensor * turned_back[..., None], 1, 2)
    atol = 1e-12 * np.max(np.abs(seen.pose))
    np.testing.assert_allclose(by_mounting, seen.pose, rtol=0, atol=atol)


@pytest.mark.parametrize("antenna", [tracker(), sized(tracker())], ids=["points", "sized"])
def test_derivatives_of_the_antennas(antenna: Antenna) -> None:
    rotation, position = random_poses((5,), np.random.default_rng(2))
    seen, vector = observe_antenna(antenna, rotation, position), antenna.vector()

    def by_antenna(step: np.ndarray) -> np.ndarray:
        moved = antenna_from_vector(vector + step)
        return observe_antenna(moved, rotation, position).value

    def by_pose(step: np.ndarray) -> np.ndarray:
        turn = rotation @ Rotation.from_rotvec(step[:3]).as_matrix()
        return observe_antenna(antenna, turn, position + rotation @ step[3:]).value

    groups = [(seen.antenna, by_antenna, 1e-5), (seen.pose, by_pose, 1e-5)]
    for result, function, step in groups:
        expected = central_difference(function, result.shape[-1], step)
        scale = np.max(np.abs(expected), axis=(0, 1, 2))
        np.testing.assert_allclose(result / scale, expected / scale, rtol=0, atol=3e-7)


def test_many_antennas_at_once() -> None:
    antennas = draw_antennas(Errors(0.01, 0.5, 2e-3), 4, np.random.default_rng(3))
    rotation, position = random_poses((4, 7), np.random.default_rng(4))
    together = observe_antenna(antennas.at(np.s_[:, None]), rotation, position)
    for k in range(4):
        alone = observe_antenna(antennas.at(k), rotation[k], position[k])
        for result, expected in zip(together, alone, strict=True):
            np.testing.assert_allclose(result[k], expected, rtol=1e-12, atol=1e-22)


def test_a_beacon_of_two_coils_is_no_tracker() -> None:
    site = tracker_site(np.random.default_rng(0))
    flat = replace(site.beacons[0], coils=site.beacons[0].coils[:2])
    with pytest.raises(InputError, match=r"beacon T has 2 coils in 2 tones .* needs three"):
        antenna_of(flat, site.platform.magnetometer)


# Coils of their own in the general model


def _observe(sensor: Magnetometer) -> tuple[Observation, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(5)
    site = tracker_site(rng, centre=0.01)
    attitude, place = body_poses(site, 4, rng)
    twist = rng.standard_normal((4, 6))
    return observe(site.beacons[0], sensor, attitude, place, None, twist), attitude, place


@pytest.mark.parametrize(("radius", "length"), [(0.04, None), (None, 0.12), (0.03, 0.1)])
def test_a_receiving_coil_measures_its_mean_flux(
    radius: float | None, length: float | None
) -> None:
    """Against the mean over the coil, by many points; and the antenna's own model of it."""
    rng = np.random.default_rng(5)
    site = tracker_site(rng, centre=0.0)
    beacon, kappa = site.beacons[0], coil_kappa(radius, length)
    sensor = replace(site.platform.magnetometer, coil_kappa=kappa, coil_centres_sensor=None)
    point = replace(sensor, coil_kappa=0.0)
    attitude, place = body_poses(site, 4, rng)
    result = predict(beacon, sensor, attitude, place)
    nodes, weights = np.polynomial.legendre.leggauss(6)
    turn = np.arange(8) * np.pi / 4.0
    for i, axis in enumerate(sensor.matrix / np.linalg.norm(sensor.matrix, axis=1)[:, None]):
        across = np.linalg.svd(axis[None])[2][1:]
        circle = np.cos(turn)[:, None] * across[0] + np.sin(turn)[:, None] * across[1]
        mean = np.zeros(result.shape[:-1], dtype=complex)
        for z, share in zip(nodes, weights, strict=True):
            for s, part in zip(nodes, weights, strict=True):
                ring = (radius or 0.0) * np.sqrt(0.5 * (s + 1.0)) * circle
                for spot in ring + 0.5 * (length or 0.0) * z * axis:
                    arm = sensor.position_body + sensor.body_from_sensor @ spot
                    at = replace(point, position_body=arm)
                    mean += share * part / 32.0 * predict(beacon, at, attitude, place)[..., i]
        plain = predict(beacon, point, attitude, place)[..., i]
        assert np.max(np.abs(result[..., i] - mean)) < 0.1 * np.max(np.abs(plain - mean))
    seen = observe_antenna(antenna_of(beacon, sensor), *in_beacon(site, attitude, place))
    turned_back = np.exp(-0.3j * np.arange(3))[:, None]
    separate = np.swapaxes(result * turned_back, 1, 2) - seen.value
    far = np.swapaxes(predict(beacon, point, attitude, place) * turned_back, 1, 2) - seen.value
    assert np.max(np.abs(separate)) < 0.1 * np.max(np.abs(far))


def test_shape_and_constant_of_a_coil() -> None:
    assert coil_kappa(0.2, None) == pytest.approx(0.005)
    assert coil_kappa(0.1, 0.1 * np.sqrt(3.0)) == pytest.approx(0.0, abs=1e-18)
    for kappa, length in ((3e-3, None), (-2e-3, None), (1e-3, 0.2), (-1e-3, 0.2), (-1e-2, 0.2)):
        assert coil_kappa(*coil_shape(kappa, length)) == pytest.approx(kappa, rel=1e-12)


def test_coils_at_one_place_change_nothing() -> None:
    sensor = tracker_site(np.random.default_rng(5), centre=0.0).platform.magnetometer
    plain, _, _ = _observe(sensor)
    separate, _, _ = _observe(replace(sensor, coil_centres_sensor=np.zeros((3, 3))))
    for name, value in vars(plain).items():
        if value is None:
            assert getattr(separate, name) is None
            continue
        np.testing.assert_allclose(getattr(separate, name), value, rtol=1e-12, atol=1e-22)
    # All three moved alike are a lever arm.
    shift = np.array([0.01, -0.02, 0.03])
    arm = sensor.position_body + sensor.body_from_sensor @ shift
    moved, _, _ = _observe(replace(sensor, coil_centres_sensor=np.tile(shift, (3, 1))))
    lever, _, _ = _observe(replace(sensor, position_body=arm))
    for name in ("phasor_sensor", "platform_pose", "beacon_pose", "matrix", "time_offset"):
        np.testing.assert_allclose(getattr(moved, name), getattr(lever, name), rtol=1e-9)


@pytest.mark.parametrize("kappa", [0.0, 2e-3, -3e-3])
def test_derivatives_with_coils_apart(kappa: float) -> None:
    rng = np.random.default_rng(5)
    site = tracker_site(rng, centre=0.01)
    beacon, sensor = site.beacons[0], replace(site.platform.magnetometer, coil_kappa=kappa)
    seen, attitude, place = _observe(sensor)

    def turn(matrix: np.ndarray, step: np.ndarray) -> np.ndarray:
        return matrix @ Rotation.from_rotvec(step).as_matrix()

    def platform(step: np.ndarray) -> np.ndarray:
        return predict(beacon, sensor, turn(attitude, step[:3]), place + attitude @ step[3:])

    def mounting(step: np.ndarray) -> np.ndarray:
        moved = replace(
            sensor,
            body_from_sensor=turn(sensor.body_from_sensor, step[:3]),
            position_body=sensor.position_body + sensor.body_from_sensor @ step[3:],
        )
        return predict(beacon, moved, attitude, place)

    def source(step: np.ndarray) -> np.ndarray:
        moved = replace(
            beacon,
            world_from_beacon=turn(beacon.world_from_beacon, step[:3]),
            position_world=beacon.position_world + beacon.world_from_beacon @ step[3:],
        )
        return predict(moved, sensor, attitude, place)

    def matrix(step: np.ndarray) -> np.ndarray:
        moved = replace(sensor, matrix=sensor.matrix + step.reshape(3, 3))
        return predict(beacon, moved, attitude, place)

    def moments(step: np.ndarray) -> np.ndarray:
        coils = tuple(
            replace(coil, moment_beacon=coil.moment_beacon * np.exp(change))
            for coil, change in zip(beacon.coils, step, strict=True)
        )
        return predict(replace(beacon, coils=coils), sensor, attitude, place)

    for result, function in (
        (seen.platform_pose, platform),
        (seen.body_from_sensor, mounting),
        (seen.beacon_pose, source),
        (seen.matrix, matrix),
        (seen.log_moments, moments),
    ):
        expected = central_difference(function, result.shape[-1], 1e-6)
        atol = 1e-8 * np.max(np.abs(expected))
        np.testing.assert_allclose(result, expected, rtol=0, atol=atol)
    np.testing.assert_array_equal(observe_from(beacon, sensor, attitude, place)[0].shape, (4, 3, 3))
    np.testing.assert_allclose(
        observe_from(beacon, sensor, attitude, place)[1], seen.platform_pose, rtol=1e-12
    )


# The bench


def bench_fields(moments: np.ndarray, centres: np.ndarray, distance: float) -> np.ndarray:
    offset = bench_points(distance) - centres[:, None, None, :]
    return dipole_field(offset, moments[:, None, None, :])


def test_six_points_see_all_of_a_centre_and_four_not_the_axis() -> None:
    antenna, distance = tracker(), 0.3
    fields = bench_fields(antenna.moments_beacon, antenna.centres_beacon, distance)
    six = measure(fields, distance, on_axis=True)
    four = measure(fields, distance, on_axis=False)
    # What is left is of the second order in the offset over the distance.
    second = 6.0 * np.max(np.linalg.norm(antenna.centres_beacon, axis=1) / distance) ** 2
    assert second < 0.01
    tilt = np.max(np.abs(antenna.moments_beacon * (1.0 - np.eye(3))))
    atol = 2.0 * tilt * np.max(np.abs(antenna.centres_beacon))  # the axes err too
    np.testing.assert_allclose(six.centres, antenna.centres_beacon, rtol=0, atol=atol)
    np.testing.assert_allclose(six.moments, antenna.moments_beacon, rtol=0, atol=second)
    np.testing.assert_allclose(four.moments, antenna.moments_beacon, rtol=0, atol=second)
    np.testing.assert_array_equal(np.diagonal(four.centres), 0.0)
    across = ~np.eye(3, dtype=bool)
    np.testing.assert_array_equal(four.centres[across], six.centres[across])


def test_the_printed_sum_doubles_a_common_offset() -> None:
    common = np.array([1e-3, -2e-3, 3e-3])
    centres = np.tile(common, (3, 1))
    np.testing.assert_allclose(shift_as_printed(centres), 2.0 * common, rtol=1e-14)
    np.testing.assert_allclose(mean_shift(centres), common, rtol=1e-14)


def test_bursa_and_wolf() -> None:
    rotation = np.array([0.02, -0.03, 0.05])  # rad
    square = float(rotation @ rotation)
    size = np.linalg.svd(bursa_wolf_matrix(rotation), compute_uv=False)
    np.testing.assert_allclose(size, [np.sqrt(1.0 + square)] * 2 + [1.0], rtol=1e-14)
    turn = Rotation.from_rotvec(rotation).as_matrix()
    np.testing.assert_allclose(helmert(2.0 * turn.T), rotation, rtol=0, atol=square**1.5)
    assert np.max(np.abs(helmert(np.diag([1.0, 1.1, 0.9])))) == 0.0  # gains are no rotation


# What is observable


def _survey(rotation: np.ndarray, position: np.ndarray) -> AntennaSurvey:
    sigma = noise_sigma(60.0, np.linalg.norm(position, axis=-1))
    return AntennaSurvey(rotation, position, np.zeros((len(sigma), 3, 3)), sigma)


def _varied(number: int = 30) -> AntennaSurvey:
    return _survey(*random_poses((number,), np.random.default_rng(6)))


def _nullity(result: AntennaObservability) -> int:
    return result.parameters - result.rank


GAIN = "the share of moments and sensitivities in their product"


def test_known_poses_leave_one_gain() -> None:
    result = observability(_varied(), tracker())
    assert (result.rank, result.null_space) == (35, (GAIN,))
    assert result.min_poses == 4
    assert result.singular[35] < 1e-13 < 1e-3 < result.singular[34]
    with_sizes = observability(_varied(), sized(tracker()))
    assert (with_sizes.parameters, with_sizes.rank) == (40, 39)


def test_one_position_leaves_two_and_one_attitude_four() -> None:
    rotation, position = random_poses((30,), np.random.default_rng(6))
    one_position = _survey(rotation, np.tile(POSITION_BEACON, (30, 1)))
    assert observability(one_position, tracker()).rank == 34
    attitudes = np.swapaxes(attitude_from_angles(TABLE[:, 0] * DEGREE), 1, 2)
    table = _survey(attitudes, np.tile(POSITION_BEACON, (13, 1)))
    result = observability(table, tracker())
    assert result.rank == 34
    assert 1e-5 < result.singular[33] < 1e-2  # barely seen
    one_attitude = _survey(np.tile(rotation[0], (30, 1, 1)), position)
    result = observability(one_attitude, tracker())
    assert result.rank == 32
    assert result.null_space == (GAIN, "shift of both antennas' centres together (3)")


def test_unknown_poses_leave_frames_and_scale() -> None:
    survey, antenna = _varied(), tracker()
    no_attitude = observability(survey, antenna, attitudes_known=False)
    assert _nullity(no_attitude) == 4
    assert no_attitude.null_space == (GAIN, "rotation of the receiver's frame (3)")
    no_position = observability(survey, antenna, positions_known=False)
    assert _nullity(no_position) == 8
    nothing = observability(survey, antenna, attitudes_known=False, positions_known=False)
    assert (_nullity(nothing), nothing.rank, nothing.min_poses) == (14, 22, 8)
    assert len(nothing.null_space) == 6
    assert "the scale of all lengths" in nothing.null_space


def test_centred_antennas() -> None:
    known = observability(_varied(), nominal(), centred=True)
    assert (known.parameters, _nullity(known)) == (18, 1)
    unknown = observability(
        _varied(), nominal(), centred=True, attitudes_known=False, positions_known=False
    )
    assert _nullity(unknown) == 8


def test_what_has_no_name_is_told_by_its_parts() -> None:
    rotation, _ = random_poses((30,), np.random.default_rng(6))
    result = observability(_survey(rotation, np.tile(POSITION_BEACON, (30, 1))), tracker())
    assert result.null_space[0] == GAIN
    assert result.null_space[1].startswith("1 more, in moments")


# Fits


def at_unknown_poses(survey: AntennaSurvey, start: Antenna, sigma: np.ndarray) -> AntennaFit:
    return fit_at_uncertain_poses(survey, start, sigma, np.inf, np.inf)


def test_the_fit_is_exact_without_noise() -> None:
    """But for the one gain that no couplings tell: its product with the other is."""
    config = Config(snr_db=140.0, antennas=3, poses=20, pose_deg=0.0, pose_m=0.0)
    rng = np.random.default_rng(7)
    truth = draw_antennas(config.errors, 3, rng)
    survey = draw_survey(truth, config, rng)
    fit = fit_at_known_poses(survey, nominal(), usual_prior(config.errors))
    result, true = fit.antenna, truth
    np.testing.assert_allclose(result.centres_beacon, true.centres_beacon, rtol=0, atol=1e-7)
    np.testing.assert_allclose(result.centres_sensor, true.centres_sensor, rtol=0, atol=1e-7)
    for k in range(3):
        product = np.kron(result.moments_beacon[k], result.sensitivities_sensor[k])
        expected = np.kron(true.moments_beacon[k], true.sensitivities_sensor[k])
        np.testing.assert_allclose(product, expected, rtol=0, atol=1e-6)


def test_the_covariance_is_honest() -> None:
    """NEES of 60 antennas of 36 parameters: 1 within three of its standard errors."""
    config = Config(errors=Errors(0.005, 0.12, 0.5e-3), antennas=60, pose_deg=0.0, pose_m=0.0)
    rng = np.random.default_rng(8)
    truth = draw_antennas(config.errors, config.antennas, rng)
    survey = draw_survey(truth, config, rng)
    fit = fit_at_known_poses(survey, nominal(), usual_prior(config.errors))
    off = fit.antenna.vector() - truth.vector()
    nees = np.einsum("ni,nij,nj->n", off, np.linalg.inv(fit.cov), off) / 36.0
    # The prior is four times as wide as the draws along the one gain: 35 parameters count whole.
    assert np.mean(nees) == pytest.approx(35.0 / 36.0, abs=3.0 * np.sqrt(2.0 / 36.0 / 60.0))
    assert np.mean(fit.chi2 / fit.dof) == pytest.approx(0.9, abs=0.03)


def test_a_held_gain_leaves_only_errors_of_couplings() -> None:
    config = Config(antennas=60, pose_deg=0.0, pose_m=0.0)
    rng = np.random.default_rng(13)
    truth = draw_antennas(config.errors, config.antennas, rng)
    survey, prior = draw_survey(truth, config, rng), 10.0 * usual_prior(config.errors)
    rotation, position = random_poses((5,), rng)
    normalised = []
    for k in range(config.antennas):
        fit = fit_at_known_poses(one_of(survey, k), nominal(), prior)
        fixed = with_receiver_gain(fit, nominal())
        size = np.linalg.norm(fixed.antenna.sensitivities_sensor, axis=1)
        assert np.prod(size) == pytest.approx(1.0, rel=1e-12)
        before, after = (observe_antenna(f.antenna, rotation, position) for f in (fit, fixed))
        np.testing.assert_allclose(after.value, before.value, rtol=0, atol=1e-12 * 1e-5)
        # What the couplings' covariance was it still is; that of the gains is now small.
        old, new = (
            s.antenna[0, 0, 0] @ f.cov @ s.antenna[0, 0, 0]
            for s, f in ((before, fit), (after, fixed))
        )
        assert new == pytest.approx(old, rel=1e-4)
        true = with_receiver_gain(replace(fit, antenna=truth.at(k)), nominal()).antenna
        off = fixed.antenna.vector() - true.vector()
        sigma = np.sqrt(np.diagonal(fixed.cov))
        assert np.max(sigma[:9]) < 1e-3 < 5e-3 < np.max(np.sqrt(np.diagonal(fit.cov))[:9])
        normalised.append(off / sigma)
    assert np.mean(np.square(normalised)) == pytest.approx(1.0, abs=0.12)


def test_the_graph_with_sure_poses_is_least_squares() -> None:
    config = Config(antennas=1, pose_deg=0.0, pose_m=0.0)
    rng = np.random.default_rng(9)
    truth = draw_antennas(config.errors, 1, rng)
    survey, prior = draw_survey(truth, config, rng), usual_prior(config.errors)
    exact = fit_at_known_poses(survey, nominal(), prior)
    graph = fit_at_uncertain_poses(one_of(survey, 0), nominal(), prior, 1e-8, 1e-9)
    separate = (graph.antenna.vector() - exact.antenna.vector()[0]) / prior
    assert np.max(np.abs(separate)) < 1e-4
    np.testing.assert_allclose(np.diagonal(graph.cov), np.diagonal(exact.cov[0]), rtol=1e-3)
    assert graph.chi2 == pytest.approx(exact.chi2[0], rel=1e-4)


def test_self_calibration_finds_shapes_and_mends_the_poses() -> None:
    """With no pose known at all: what no frame or scale changes, from poses a degree wrong."""
    config = Config(errors=Errors(0.01, 0.5, 1e-3), antennas=1, poses=30, pose_deg=1.0, pose_m=3e-3)
    rng = np.random.default_rng(10)
    truth = draw_antennas(config.errors, 1, rng)
    survey = one_of(draw_survey(truth, config, rng), 0)
    fit = fit_at_uncertain_poses(survey, nominal(), usual_prior(config.errors), np.inf, np.inf)
    assert fit.dof == 9 * 30 - 6 * 30

    def angles(coils: np.ndarray) -> np.ndarray:
        unit = coils / np.linalg.norm(coils, axis=-1, keepdims=True)
        return np.asarray((unit @ unit.T)[np.triu_indices(3, 1)])

    for result, true in (
        (fit.antenna.moments_beacon, truth.moments_beacon[0]),
        (fit.antenna.sensitivities_sensor, truth.sensitivities_sensor[0]),
    ):
        error = np.sqrt(np.mean((angles(result) - angles(true)) ** 2)) / DEGREE
        assert error < 0.06 < np.sqrt(np.mean(angles(true) ** 2)) / DEGREE
    assert np.mean(fit.chi2) / fit.dof == pytest.approx(1.0, abs=0.35)


def test_sizes_are_found() -> None:
    rng = np.random.default_rng(11)
    rotation, position = random_poses((40,), rng, nearest=0.15, farthest=0.3)
    truth = sized(tracker())
    sigma = noise_sigma(80.0, np.linalg.norm(position, axis=-1))
    seen = observe_antenna(truth, rotation, position).value
    seen = seen + sigma[:, None, None] * rng.standard_normal(seen.shape)
    survey = AntennaSurvey(rotation, position, seen, sigma)
    start = antenna_from_vector(np.concatenate([nominal().vector(), np.zeros(4)]))
    prior = prior_sigma(start, gain=0.05, tilt=0.05, centre=0.01, kappa=1e-3)
    fit = fit_at_known_poses(survey, start, prior)
    error = (fit.antenna.vector() - truth.vector())[KAPPAS]
    sigma_kappa = np.sqrt(np.diagonal(fit.cov))[KAPPAS]
    assert np.all(np.abs(error) < 3.0 * sigma_kappa)
    assert np.all(sigma_kappa < 0.1 * truth.vector()[KAPPAS])


@pytest.mark.parametrize("fit", [fit_at_known_poses, at_unknown_poses])
def test_nonsense_does_not_converge(
    fit: Callable[[AntennaSurvey, Antenna, np.ndarray], AntennaFit],
) -> None:
    survey = _varied(10)
    noise = np.random.default_rng(12).standard_normal((10, 3, 3))
    survey = replace(survey, coupling=1e4 * survey.sigma[:, None, None] * noise)
    prior = prior_sigma(nominal(), 1.0, 1.0, 0.2)
    with pytest.raises(EstimationError, match="does not converge"):
        fit(survey, nominal(), prior[:36])
