"""The error of a field that is constant in place: its modes, and what it does to an estimate."""

from dataclasses import replace

import numpy as np
import pytest
from gtsam.symbol_shorthand import X

from magfusion.estimation.batch.batch import SmootherSettings, smooth, solved_again
from magfusion.estimation.graph.considered import responses
from magfusion.estimation.graph.state import states_in
from magfusion.estimation.measurements.field_error import largest_combinations, modes_in_place
from magfusion.estimation.measurements.phasors import FieldPhasors
from magfusion.model.noise import stacked
from magfusion.model.parameters.parameter import PhasorView
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import SimulationConfig, simulate_log

LENGTH = 0.5  # m


def test_an_error_at_one_place_is_one_mode() -> None:
    here = np.array([1.0, 2.0, 0.5]) + np.zeros((200, 3))
    modes = modes_in_place(here, LENGTH, 20)
    assert modes.shape == (200, 1)
    assert np.allclose(modes**2, 1.0, rtol=1e-12, atol=0.0)


def test_modes_have_the_correlation_of_iron() -> None:
    rng = np.random.default_rng(3)
    walk = np.cumsum(0.03 * rng.standard_normal((400, 3)), axis=0)
    modes = modes_in_place(walk, LENGTH, 10_000)
    separate = np.linalg.norm(walk[:, None] - walk, axis=2)
    error = modes @ modes.T - np.exp(-separate / LENGTH)
    assert np.sqrt(np.mean(error**2)) < 0.05
    # All of a cell have the same: its diagonal is as long as sqrt(3) / 4 lengths.
    assert np.max(np.abs(error)) < 1.0 - np.exp(-np.sqrt(3.0) / 4.0) + 0.03
    assert np.mean(np.sum(modes**2, axis=1)) == pytest.approx(1.0, abs=0.04)


def test_fewer_modes_are_those_with_most_variance() -> None:
    rng = np.random.default_rng(4)
    walk = np.cumsum(0.05 * rng.standard_normal((300, 3)), axis=0)
    few, more = (np.sum(modes_in_place(walk, LENGTH, n) ** 2) for n in (3, 9))
    assert 0.2 * 300 < few < more < 300.0


def test_combinations_are_all_that_bends_more_than_independent_errors() -> None:
    """Against the covariance of the bent field itself, in which matrix and field are multiplied."""
    rng = np.random.default_rng(7)
    walk = np.cumsum(0.1 * rng.standard_normal((120, 3)), axis=0)
    path = np.cumsum(0.2 * rng.standard_normal((120, 1, 1, 3)), axis=0)
    field_world = path.astype(np.complex128)
    modes = modes_in_place(walk, LENGTH, 120)
    combine = largest_combinations(modes[:, None], field_world, 1000)
    unit = field_world[:, 0, 0].real
    unit *= np.sqrt(2.0) / np.linalg.norm(unit, axis=1, keepdims=True)
    value = np.linalg.eigvalsh((modes @ modes.T) * (unit @ unit.T))[::-1]
    kept = np.einsum("nm,nj,mjk->nk", modes, unit, combine)
    assert combine.shape == (modes.shape[1], 3, np.sum(value > 1.0))
    assert np.sum(kept**2, axis=0) == pytest.approx(value[value > 1.0], rel=1e-9)
    few = largest_combinations(modes[:, None], field_world, 4)
    assert np.allclose(few, combine[..., :4], rtol=0.0, atol=1e-12)


def test_a_mode_moves_the_estimate_as_its_response_says() -> None:
    """An amplitude added to what was measured, and solved again, against the linear response."""
    config = SimulationConfig(DEMO_BOX_WORLD, duration=12.0, motion="walk", perturb=False)
    built = simulate_log(demo_site(), config, np.random.default_rng(5))
    settings = SmootherSettings(tune=False, loss=None)
    result = smooth(built.log, replace(demo_site(), model_error=0.005), settings)
    block = result.field_errors[0]
    site, fields = result.calibration.site, result.fields
    poses = result.states
    column = 1  # of the second combination
    steps = list(responses(result.graph, result.estimate, result.uncertain))
    first = result.uncertain[-len(result.field_errors)].columns.start
    response = steps[first + column]
    phasors = next(m for m in result.graph.measurements if isinstance(m, FieldPhasors))
    reference = result.calibration.reference_time
    own = [i for i, b in enumerate(site.beacons) for _ in b.tones if b.name == block.owner]
    view = PhasorView(
        result.calibration,
        site.beacons[own[0]],
        fields.time - reference,
        fields.phasor_sensor[:, own],
        None,
    )
    shape = block.parameter.phasor_jacobian(view, block.owner)
    assert shape is not None
    amplitude = 0.05
    added = np.zeros_like(phasors.measured)
    added[:, own] = stacked(shape[..., column]) * amplitude
    others = [m for m in result.graph.measurements if m is not phasors]
    moved = solved_again(result, (replace(phasors, measured=phasors.measured - added), *others))
    before = states_in(result.estimate.values)
    after = states_in(moved.estimate.values)
    shift = np.einsum(
        "nji,nj->ni", before.world_from_body, after.position_world - before.position_world
    )
    expected = amplitude * np.array([response.at(X(i))[3:] for i in range(len(poses))])
    assert np.max(np.abs(expected)) > 1e-5  # m
    # An error e of the prediction is what -e of the measurement is; the rest is second order.
    assert np.max(np.abs(shift - expected)) < 0.02 * np.max(np.abs(expected))
