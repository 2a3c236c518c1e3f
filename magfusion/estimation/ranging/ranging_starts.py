"""Starts of the search for the relative position of two wells."""

import numpy as np

from magfusion.estimation.ranging.ranging_model import RangingModel
from magfusion.estimation.ranging.ranging_noise import real_and_imaginary
from magfusion.model.field import skew
from magfusion.units import Array, ComplexArray

DIRECTIONS, DISTANCES = 12, 10  # of starts: about the axis, and outwards


def starts(model: RangingModel) -> Array:
    """Return poses over all directions and distances, the most probable first."""
    windows, size = model.windows, np.linalg.norm(model.seen[:, 0], axis=-1)
    others = windows.sensor == windows.sensor[np.argmax(size)]
    simultaneous = float(windows.magnet[np.argmax(np.where(others, size, 0.0)), 1])
    simultaneous_from = float(windows.sensor[np.argmax(size)])
    span = max(float(np.ptp(windows.magnet)), 1.0)
    assert model.beacon.rotor is not None
    zero, axis = model.beacon.rotor.zero_beacon, model.axis
    other = np.cross(axis, zero)
    out = []
    for sign in (1.0, -1.0):
        for angle in 2.0 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS:
            up = np.cos(angle) * zero + np.sin(angle) * other
            x = sign * axis
            rotation = np.stack([x, np.cross(up, x), up], axis=1)
            for distance in np.geomspace(0.02 * span, 2.0 * span, DISTANCES):
                place = distance * zero + simultaneous * axis - simultaneous_from * x
                out.append(np.concatenate([rotation.ravel(), place, 0.0 * model.prior]))
    states = _turned_to_phase(model, np.array(out))
    cost = np.sum(_scaled(model, states) ** 2, axis=1)
    return states[np.argsort(cost)]


def _scaled(model: RangingModel, states: Array) -> Array:
    """Return residuals of states at the best-fitting moment of each."""
    phasor, _ = model.predicted(states)
    seen = np.broadcast_to(model.seen, phasor.shape)
    if not model.windows.angle_known:
        seen = seen * np.exp(-1j * model.phase(phasor)[..., None, None] * model.orders[:, None])
    mine, its = _weighed(model, phasor), _weighed(model, seen)
    gain = np.sum(mine * its, 1) / np.sum(mine**2, 1)
    return np.asarray(np.maximum(gain, 0.0)[:, None] * mine - its)


def _weighed(model: RangingModel, phasor: ComplexArray) -> Array:
    """Return whitened parts (k, d), independent for each window."""
    whitened: ComplexArray = (model.weight @ phasor[..., None])[..., 0]
    return real_and_imaginary(whitened).reshape(len(phasor), -1)


def _turned_to_phase(model: RangingModel, states: Array) -> Array:
    """Return states rotated about the magnet's axis to match the measured phase."""
    if not model.windows.angle_known:
        return states
    phasor, _ = model.predicted(states)
    mine, its = ((model.weight @ p[..., None])[..., 0] for p in (phasor, model.seen))
    angle = -np.angle(np.sum(np.conj(mine) * its, axis=(1, 2, 3)))
    turn = np.cos(angle)[:, None, None] * np.eye(3)
    turn = turn + np.sin(angle)[:, None, None] * skew(model.axis)
    turn = turn + (1.0 - np.cos(angle))[:, None, None] * np.outer(model.axis, model.axis)
    out = states.copy()
    out[:, :9] = (turn @ states[:, :9].reshape(-1, 3, 3)).reshape(-1, 9)
    out[:, 9:12] = (turn @ states[:, 9:12, None])[..., 0]
    return out
