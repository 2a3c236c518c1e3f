"""Predicted windows of a sensor at rest while a rotating magnet passes, with derivatives.

The wells of the magnet and of the sensor are straight over the detection range.  The world frame
here is that of the magnet, which the sensor passes.  `observe` predicts its measurement; the
unknowns are the six of the sensor's pose, with the moment, the response of the casing, the scale of
the depths and the ground.

The sensor's frame here is that of its high side: x down the hole, z towards the high side.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from magfusion.estimation.posterior.separation import POSE
from magfusion.estimation.ranging.ranging_casing import CasingModel, CasingResponse, casing_unknowns
from magfusion.estimation.ranging.ranging_data import FIRST, SHARE, RangingWindows
from magfusion.estimation.ranging.ranging_noise import (
    WindowPrediction,
    real_and_imaginary,
    whitening,
    window_weight,
)
from magfusion.model.field import observe, skew
from magfusion.model.physics.casing import Response
from magfusion.model.receive_coils import Observation
from magfusion.model.site import Beacon, Site
from magfusion.units import Array, ComplexArray

OPEN = 1.0  # rad; prior of a rotation about the magnet's axis where its angle is not measured
_NONE = np.zeros((), dtype=np.complex128)

_Sources = list[tuple[ComplexArray | float, Observation]]


class _Unknown(NamedTuple):
    name: str
    sigma: float


class RangingModel:
    """Residuals of windows and their derivatives; one problem per start.

    `about` (12 + unknowns,): state at which errors of depths and of the model are weighted.
    """

    def __init__(self, site: Site, windows: RangingWindows, about: Array | None = None) -> None:
        beacon = site.beacons[0]
        assert beacon.rotor is not None
        windows = windows.spread(beacon.rotor.length)
        self.windows, self.sensor = windows, site.platform.magnetometer
        self.beacon = Beacon(
            beacon.name,
            np.zeros(3),
            np.eye(3),
            beacon.frequency_hz,
            beacon.coils,
            True,
            beacon.sigma,
            conductivity=beacon.conductivity,
            rotor=beacon.rotor,
        )
        self.axis = beacon.rotor.axis_beacon
        self.orders = np.rint(beacon.tone_frequencies_hz / beacon.frequency_hz)
        self.unknowns = tuple(_unknowns(site, windows))
        self.names = tuple(one.name for one in self.unknowns)
        self.prior = np.array([one.sigma for one in self.unknowns])
        rotated = windows.roll
        cosine, sine, one = np.cos(rotated), np.sin(rotated), np.ones_like(rotated)
        zero = 0.0 * one
        rows = [[one, zero, zero], [zero, cosine, -sine], [zero, sine, cosine]]
        self.side_from_body = np.moveaxis(np.array(rows), -1, 0)  # (n, 3, 3)
        self.casing = None
        if self.sensor.casing is not None:
            self.casing = CasingModel(self.sensor, self.orders, beacon.frequency_hz, windows)
        valid = windows.fields.valid[..., None]
        self.seen = np.where(valid, windows.fields.phasor_sensor, 0.0)
        self._kept = np.repeat(valid[..., 0].ravel(), 6)
        self.weight = window_weight(site, windows)
        course = None if about is None else self._course(about)
        self._whitening = whitening(site, windows, course)

    def _course(self, state: Array) -> WindowPrediction:
        phasor, by = self.predicted(state[None])
        way = -state[:9].reshape(3, 3).T @ self.axis  # of the sensor from the magnet, side's axes
        slope, gathered = by[0, ..., 3:POSE] @ way, np.zeros(phasor.shape[1:3])
        if self.casing is not None:
            column = by[0, ..., POSE + self.names.index("log_gather")]
            gathered = np.linalg.norm(column, axis=-1) / np.linalg.norm(phasor[0], axis=-1)
        return WindowPrediction(phasor[0], slope, gathered)

    def predicted(self, state: Array) -> tuple[ComplexArray, ComplexArray]:
        """Return phasors (k, n, tones, 3) of states (k, 12 + unknowns), and their Jacobian."""
        beacon = self.beacon
        if "log_conductivity" in self.names:
            change = state[:, 12 + self.names.index("log_conductivity")]
            if np.any(change != change[0]):
                each_ground = zip(*(self.predicted(one[None]) for one in state), strict=True)
                phasor, jacobian = map(np.concatenate, each_ground)
                return phasor, jacobian
            beacon = _in_other_ground(self.beacon, float(change[0]))
        rotation, place = state[:, :9].reshape(-1, 3, 3), state[:, 9:12]
        extra = dict(zip(self.names, state[:, 12:].T, strict=True))
        scale = 1.0 + extra.get("depth_scale", np.zeros(len(state)))
        windows, turn = self.windows, self.side_from_body
        body = rotation[:, None] @ turn  # (k, n, 3, 3)
        along = windows.sensor[:, None] * FIRST
        there = place[:, None] + np.einsum("kab,nb->kna", rotation, along)
        travel = scale[:, None, None] * windows.magnet
        position = there[:, :, None] - travel[..., None] * self.axis  # (k, n, g, 3)
        attitude = np.broadcast_to(body[:, :, None], (*position.shape[:3], 3, 3))
        seen = observe(beacon, self.sensor, attitude, position)
        share = SHARE[:, None, None]
        sources: _Sources = [(1.0, seen)]
        if "ellipse_cos" in extra:
            against = observe(_counter(beacon), self.sensor, attitude, position)
            part = (extra["ellipse_cos"] - 1j * extra["ellipse_sin"])[:, None, None, None, None]
            sources.append((part, against))
        whole = sum((part * one.phasor_sensor for part, one in sources), start=_NONE)
        each_pose = sum((_wide(part) * one.platform_pose for part, one in sources), start=_NONE)
        bend: CasingResponse | None = None
        steel: list[Response] = []
        if self.casing is not None:
            steel = self.casing.responses(extra, len(state))
            middle = attitude[:, :, 1:2], position[:, :, 1:2]  # poles are far: a window is short
            bend = self.casing.gathered(beacon, *middle, extra, steel)
            whole, each_pose = whole + bend.phasor, each_pose + bend.by_pose
        phasor = np.sum(share * whole, axis=2)
        by_pose = np.sum(share[..., None] * each_pose, axis=2)  # (k, n, t, 3, 6)
        back = np.swapaxes(turn, -1, -2)[:, None]  # body from side
        by_turn, by_shift = by_pose[..., :3] @ back, by_pose[..., 3:] @ back
        by_turn = by_turn - by_shift @ skew(along)[:, None]
        columns = [by_turn, by_shift]
        way = np.einsum("knba,b->kna", body, -self.axis)  # body axes
        for name in self.names:
            if name == "depth_scale":
                each = windows.magnet[..., None, None, None] * each_pose[..., 3:]
                by_way = np.sum(share[..., None] * each, axis=2)
                column = np.einsum("kntab,knb->knta", by_way, way)
            else:
                column = self._of_steel(name, bend, steel)
                if column is None:
                    column = _column(name, sources, bend, phasor, share)
            columns.append(column[..., None])
        size = np.exp(extra.get("log_moment", np.zeros(len(state))))[:, None, None, None]
        phasor, jacobian = size * phasor, size[..., None] * np.concatenate(columns, axis=-1)
        if self.casing is None:
            return phasor, jacobian
        return self.casing.through(phasor, jacobian, extra, self.names, steel)

    def _of_steel(
        self, name: str, bend: CasingResponse | None, steel: list[Response]
    ) -> ComplexArray | None:
        """Return the derivative by an unknown of the casing; None for any other."""
        if self.casing is None or bend is None:
            return None
        return self.casing.column(name, bend, steel)

    def residuals(self, state: Array) -> tuple[Array, Array]:
        """Return whitened residuals (k, d) and their Jacobian (k, d, n)."""
        phasor, jacobian = self.predicted(state)
        size, n = len(state), jacobian.shape[-1]
        by = np.concatenate([jacobian.real, jacobian.imag], axis=-2).reshape(size, -1, n)
        by = self._whitening @ np.where(self._kept[:, None], by, 0.0)
        if self.windows.angle_known:
            return self.white(phasor - self.seen), by
        # Windows are independent: a window's whitening does not depend on its phase.
        phase = self.phase(phasor)[..., None, None] * self.orders[:, None]
        error = self.white(phasor - self.seen * np.exp(-1j * phase))
        free_parameters = self.white(1j * self.orders[:, None] * phasor)
        rows = np.concatenate([error[..., None], by], axis=2)
        rows = rows.reshape(size, len(self.seen), -1, n + 1)
        free_parameters = free_parameters.reshape(size, len(self.seen), -1)
        free_parameters = free_parameters / np.maximum(
            np.linalg.norm(free_parameters, axis=-1, keepdims=True), 1e-300
        )
        rows = (
            rows
            - free_parameters[..., None]
            * np.einsum("kwd,kwdn->kwn", free_parameters, rows)[:, :, None]
        )
        rows = rows.reshape(size, -1, n + 1)
        return rows[..., 0], rows[..., 1:]

    def white(self, residual: ComplexArray) -> Array:
        """Return whitened parts (k, d) of phasors (k, n, tones, 3)."""
        parts = np.where(self._kept, real_and_imaginary(residual).reshape(len(residual), -1), 0.0)
        return np.asarray(parts @ self._whitening.T)

    def with_priors(self, state: Array) -> tuple[Array, Array]:
        """Return the same with the rows of the priors."""
        error, by = self.residuals(state)
        size, n = len(state), by.shape[-1]
        reported = state[:, 12:] / self.prior
        rows = np.zeros((size, len(self.prior), n))
        rows[:, np.arange(len(self.prior)), POSE + np.arange(len(self.prior))] = 1.0 / self.prior
        if not self.windows.angle_known:
            about = self.about_axis(state)[:, None] / OPEN
            rows = np.concatenate(
                [rows, np.concatenate([about, np.zeros((size, 1, n - POSE))], 2)], 1
            )
            reported = np.concatenate([reported, np.zeros((size, 1))], 1)
        return np.concatenate([error, reported], 1), np.concatenate([by, rows], 1)

    def about_axis(self, state: Array) -> Array:
        """Return the unit step of a rotation about the magnet's axis, shape (k, 6)."""
        rotation, place = state[:, :9].reshape(-1, 3, 3), state[:, 9:12]
        turn = np.einsum("kba,b->ka", rotation, self.axis)
        shift = np.einsum("kba,kb->ka", rotation, np.cross(self.axis, place))
        whole = np.concatenate([turn, shift], axis=1)
        return np.asarray(whole / np.linalg.norm(whole, axis=1, keepdims=True))

    def phase(self, phasor: ComplexArray) -> Array:
        """Return the phase from each window's prediction to its measurement (k, n)."""
        first = self.weight[:, 0]
        seen = (first @ self.seen[:, 0, :, None])[..., 0]
        mine = (first @ phasor[:, :, 0, :, None])[..., 0]
        return np.angle(np.sum(np.conj(mine) * seen, axis=-1))


def _column(
    name: str, sources: _Sources, bend: CasingResponse | None, phasor: ComplexArray, share: Array
) -> ComplexArray:
    """Return the derivative of phasors by one parameter, zero for those of the casing."""
    if name == "log_moment":
        return phasor
    if name == "log_conductivity":
        grounds = ((part, one.log_conductivity) for part, one in sources)
        ground = sum((p * g for p, g in grounds if g is not None), start=_NONE)
        if bend is not None and bend.by_ground is not None:
            ground = ground + bend.by_ground
        return np.asarray(np.sum(share * ground, axis=2))
    if name.startswith("ellipse"):
        rotated = 1.0 if name == "ellipse_cos" else -1j
        return np.asarray(rotated * np.sum(share * sources[1][1].phasor_sensor, axis=2))
    return np.zeros_like(phasor)


def _wide(part: ComplexArray | float) -> ComplexArray | float:
    return part if isinstance(part, float) else part[..., None]


def _counter(beacon: Beacon) -> Beacon:
    """Return the same magnet rotating the other way, without harmonics, which do not reverse."""
    cosine, sine = beacon.coils[:2]
    silent = tuple(replace(c, moment_beacon=0.0 * c.moment_beacon) for c in beacon.coils[2:])
    return replace(beacon, coils=(cosine, replace(sine, phase=-sine.phase), *silent))


def _in_other_ground(beacon: Beacon, log_change: float) -> Beacon:
    return replace(beacon, conductivity=beacon.conductivity * float(np.exp(log_change)))


def _unknowns(site: Site, windows: RangingWindows) -> list[_Unknown]:
    beacon, casing = site.beacons[0], site.platform.magnetometer.casing
    result = []
    moment = float(np.sqrt(np.mean(beacon.sigma.log_moment[:2] ** 2)))
    if moment:
        result.append(_Unknown("log_moment", moment))
    if beacon.rotor is not None and beacon.rotor.ellipse_sigma:
        result.append(_Unknown("ellipse_cos", beacon.rotor.ellipse_sigma))
        result.append(_Unknown("ellipse_sin", beacon.rotor.ellipse_sigma))
    if windows.depth_scale_sigma:
        result.append(_Unknown("depth_scale", windows.depth_scale_sigma))
    if site.log_conductivity_sigma:
        result.append(_Unknown("log_conductivity", site.log_conductivity_sigma))
    if casing is not None:
        result += [_Unknown(name, sigma) for name, sigma in casing_unknowns(casing)]
    return result
