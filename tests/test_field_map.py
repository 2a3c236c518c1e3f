"""A field map is a Gaussian process: its textbook form, its limits and difference quotients."""

from dataclasses import replace

import numpy as np
import pytest
from derivatives import central_difference, relative_to_group

from magfusion.model.field_map import FieldMap
from magfusion.model.noise import measurement_cov, model_error, model_error_cov
from magfusion.model.samples import FieldSamples
from magfusion.simulation.demo_site import demo_site

LENGTH, GAIN, TURN, RESIDUAL = 0.9, 0.2, 0.15, 0.01
PRIOR = np.diag([GAIN, TURN, TURN, TURN]) ** 2
RNG = np.random.default_rng(3)
POINTS = RNG.uniform(0.0, 3.0, (9, 3))
MAX_EPOCHS = RNG.uniform(0.0, 3.0, (40, 3))
FAR = np.array([[100.0, -50.0, 30.0]])
DATA = RNG.normal(0.0, 0.1, (9, 4))
_ROOT = RNG.normal(0.0, 20.0, (9, 4, 4))
INFORMATION = _ROOT @ np.swapaxes(_ROOT, 1, 2) + np.eye(4)


def covariance(first, second):
    """Return the prior covariance entry by entry, shape (4 n, 4 m)."""
    out = np.zeros((4 * len(first), 4 * len(second)))
    for i, a in enumerate(first):
        for j, b in enumerate(second):
            near = np.exp(-np.sum((a - b) ** 2) / (2.0 * LENGTH**2))
            out[4 * i : 4 * i + 4, 4 * j : 4 * j + 4] = near * PRIOR
    return out


def noise(information):
    out = np.zeros((4 * len(information), 4 * len(information)))
    for i, block in enumerate(information):
        out[4 * i : 4 * i + 4, 4 * i : 4 * i + 4] = np.linalg.inv(block)
    return out


def learnt(information=INFORMATION, points=POINTS, data=DATA):
    """Return the map of data; its weights from the textbook form of the posterior."""
    weights = np.linalg.solve(covariance(points, points) + noise(information), data.ravel())
    return FieldMap(points, weights.reshape(data.shape), information, LENGTH, GAIN, TURN, RESIDUAL)


def textbook_variance(requested, information=INFORMATION, points=POINTS):
    """Return the variance of gain and, mean of the axes, of rotation, shape (n, 2)."""
    reach = covariance(requested, points)
    known = np.linalg.solve(covariance(points, points) + noise(information), reach.T)
    remaining = np.diag(covariance(requested, requested) - reach @ known).reshape(-1, 4)
    return np.stack([remaining[:, 0], remaining[:, 1:].mean(axis=1)], axis=1)


def test_the_mean_goes_through_data_without_noise():
    result, _ = learnt(np.tile(1e10 * np.eye(4), (9, 1, 1))).mean(POINTS)
    np.testing.assert_allclose(result, DATA, rtol=0.0, atol=1e-6)


def test_the_mean_is_that_of_the_posterior():
    weights = np.linalg.solve(covariance(POINTS, POINTS) + noise(INFORMATION), DATA.ravel())
    expected = (covariance(MAX_EPOCHS, POINTS) @ weights).reshape(-1, 4)
    np.testing.assert_allclose(learnt().mean(MAX_EPOCHS)[0], expected, rtol=0.0, atol=1e-12)


def test_the_mean_takes_any_shape_of_positions_and_many_of_them():
    field_map = learnt()
    value, gradient = field_map.mean(np.tile(MAX_EPOCHS[:2].reshape(2, 1, 3), (1, 5000, 1)))
    assert value.shape == (2, 5000, 4)
    assert gradient.shape == (2, 5000, 4, 3)
    alone = field_map.mean(MAX_EPOCHS[1])
    np.testing.assert_allclose(value[1, -1], alone[0], rtol=1e-12)
    np.testing.assert_allclose(gradient[1, -1], alone[1], rtol=1e-12)


@pytest.mark.parametrize("place", [*MAX_EPOCHS[:3], POINTS[0]])
def test_the_gradient_is_that_of_the_mean(place):
    field_map = learnt()
    expected = central_difference(lambda step: field_map.mean(place + step)[0], 3, 1e-5)
    assert relative_to_group(field_map.mean(place)[1], expected) < 1e-8


def test_the_variance_is_that_of_the_posterior():
    everywhere = np.concatenate([MAX_EPOCHS, POINTS])
    np.testing.assert_allclose(
        learnt().variance(everywhere), textbook_variance(everywhere), rtol=1e-9, atol=1e-14
    )


def test_points_that_tell_nothing_leave_the_prior():
    nothing = FieldMap(POINTS, np.zeros((9, 4)), np.zeros((9, 4, 4)), LENGTH, GAIN, TURN, RESIDUAL)
    expected = np.tile([GAIN**2, TURN**2], (len(MAX_EPOCHS), 1))
    np.testing.assert_allclose(nothing.variance(MAX_EPOCHS), expected, rtol=1e-12)
    assert np.all(nothing.mean(MAX_EPOCHS)[0] == 0.0)


def test_far_from_the_survey_the_map_is_the_prior_again():
    field_map = learnt()
    np.testing.assert_allclose(field_map.variance(FAR), [[GAIN**2, TURN**2]], rtol=1e-12)
    np.testing.assert_allclose(field_map.mean(FAR)[0], 0.0, atol=1e-12)


def test_a_point_more_makes_no_place_worse_known_and_its_own_better():
    before = learnt(INFORMATION[:-1], POINTS[:-1], DATA[:-1])
    gained = before.variance(MAX_EPOCHS) - learnt().variance(MAX_EPOCHS)
    assert np.all(gained > -1e-12)
    there = POINTS[-1:]
    assert np.all(learnt().variance(there) < 0.7 * before.variance(there))


def test_a_direction_that_no_point_tells_stays_as_it_was():
    """A field along x turns visibly about y and z alone."""
    blind = np.tile(np.diag([1e6, 0.0, 1e6, 1e6]), (9, 1, 1))
    field_map = FieldMap(POINTS, np.zeros((9, 4)), blind, LENGTH, GAIN, TURN, RESIDUAL)
    gain, turn = field_map.variance(POINTS[:1])[0]
    assert gain < 1e-5
    assert turn == pytest.approx(TURN**2 / 3.0, rel=1e-3)


def test_the_relative_variance_is_what_gain_and_turn_do_to_a_field():
    """Against random draws of both, on fields of any direction."""
    field_map, rng = learnt(), np.random.default_rng(4)
    gain, turn = field_map.variance(MAX_EPOCHS[:1])[0]
    field = rng.normal(size=(400_000, 3))
    field /= np.linalg.norm(field, axis=1, keepdims=True)
    moved = rng.normal(0.0, np.sqrt(gain), (len(field), 1)) * field
    moved += np.cross(rng.normal(0.0, np.sqrt(turn), field.shape), field)
    moved += rng.normal(0.0, RESIDUAL / np.sqrt(3.0), field.shape)
    expected = np.mean(np.sum(moved**2, axis=1))
    assert field_map.relative_variance(MAX_EPOCHS[:1])[0] == pytest.approx(expected, rel=0.01)


def test_where_the_place_is_unknown_that_of_a_typical_point_is_meant():
    field_map = learnt()
    gain, turn = np.median(textbook_variance(POINTS), axis=0)
    expected = RESIDUAL**2 + gain + 2.0 * turn
    assert float(field_map.relative_variance()) == pytest.approx(expected, rel=1e-9)


# In the weights --------------------------------------------------------------------------------


def half_mapped():
    """Return two beacons, of which the second has a map."""
    site = demo_site(coil_radius=None)
    first, second = site.beacons[:2]
    beacons = (first, replace(second, field_map=learnt()))
    return replace(site, beacons=beacons, model_error=0.03)


def owners(site):
    return np.array([name == site.beacons[1].name for name, _ in site.channels])


def test_each_channel_has_the_error_of_its_own_beacon_where_the_sensor_is():
    site = half_mapped()
    mapped = owners(site)
    error = model_error(site, np.concatenate([POINTS[:1], FAR])[:, None])
    assert error.shape == (2, len(site.channels))
    assert np.all(error[:, ~mapped] == 0.03)
    gain, turn = textbook_variance(POINTS[:1])[0]
    near, far = np.sqrt([RESIDUAL**2 + gain + 2 * turn, RESIDUAL**2 + GAIN**2 + 2 * TURN**2])
    np.testing.assert_allclose(error[0, mapped], near, rtol=1e-9)
    np.testing.assert_allclose(error[1, mapped], far, rtol=1e-9)
    anywhere = model_error(site)
    assert anywhere.shape == (len(site.channels),)
    assert np.all((near < anywhere[mapped]) | (anywhere[mapped] < far))


def test_phasors_weigh_less_where_the_map_is_not_known():
    site = half_mapped()
    mapped, rng = owners(site), np.random.default_rng(5)
    shape = (2, len(site.channels), 3)
    samples = FieldSamples(
        time=np.arange(2.0),
        window=np.full(2, 0.4),
        channels=site.channels,
        phasor_sensor=1e-8 * (rng.normal(size=shape) + 1j * rng.normal(size=shape)),
        phasor_cov=np.broadcast_to(1e-20 * np.eye(3), (*shape, 3)).copy(),
    )
    places = np.concatenate([POINTS[:1], FAR])
    cov = measurement_cov(site, samples, sensor_world=places[:, None])
    expected = samples.phasor_cov + model_error_cov(
        samples.phasor_sensor, model_error(site, places[:, None])
    )
    np.testing.assert_allclose(cov, expected, rtol=1e-12)
    plain = replace(site, beacons=tuple(replace(b, field_map=None) for b in site.beacons))
    without = measurement_cov(plain, samples)
    np.testing.assert_allclose(cov[:, ~mapped], without[:, ~mapped], rtol=1e-12)
    size = np.trace(cov, axis1=-2, axis2=-1) / np.trace(without, axis1=-2, axis2=-1)
    assert np.all(size[1, mapped] > 10.0)
