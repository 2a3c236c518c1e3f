"""What a sensor at rest measures of a magnet that turns and goes by: predicted, with derivatives.

The well of the magnet is straight as far as it is heard, and so is the sensor's.  Seen from the
magnet, whose frame is the world here, the sensor goes by: what it should measure is `observe`, and
the pose of the sensor is what is sought, six numbers, with the moment, what comes through the
casing, the scale of the depths and the ground.

The sensor's frame for this is that of its high side: x down the hole, z towards the high side.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from magfusion.model.field import observe, skew
from magfusion.model.physics.casing import tube_gathering, tube_transmission
from magfusion.model.receive_coils import Observation
from magfusion.model.samples import FieldSamples
from magfusion.model.site import Beacon, Site
from magfusion.units import Array, ComplexArray

# Gauss and Legendre's points of a window, over its length from its middle: it is moved through.
WITHIN, SHARE = np.sqrt(0.6) * np.array([-0.5, 0.0, 0.5]), np.array([5.0, 8.0, 5.0]) / 18.0
FIRST = np.array([1.0, 0.0, 0.0])  # axis of the sensor's body, down its hole
DIRECTIONS, DISTANCES = 12, 10  # of starts: about the axis, and outwards
OPEN = 1.0  # rad; prior of a turn about the magnet's axis where its angle is not measured
ASIDE = 0.5  # m; of the second difference along a casing
POSE = 6
_NONE = np.zeros((), dtype=np.complex128)


@dataclass(frozen=True, eq=False)
class RangingWindows:
    """What was measured while a magnet went by.

    Parameters
    ----------
    fields : FieldSamples
        Of one rotor, by its angle.
    angle_known : bool
        Whether that was measured; otherwise each window has a phase of its own.
    magnet : ndarray, shape (n, 3)
        Depth of the magnet at the points `WITHIN` each window (m), from ``magnet_from``.
    sensor : ndarray, shape (n,)
        Depth of the sensor (m), from ``sensor_from``.
    roll : ndarray, shape (n,)
        Of the sensor about its hole, from its high side (rad).
    depth_sigma : float
        Of a window's depth (m).
    depth_scale_sigma : float
        Of all, relative.
    """

    fields: FieldSamples
    angle_known: bool
    magnet: Array
    sensor: Array
    roll: Array
    magnet_from: float
    sensor_from: float
    depth_sigma: float = 0.0
    depth_scale_sigma: float = 1e-3

    def rows(self, kept: slice) -> "RangingWindows":
        """Return some windows."""
        return replace(
            self,
            fields=self.fields.rows(kept),
            magnet=self.magnet[kept],
            sensor=self.sensor[kept],
            roll=self.roll[kept],
        )


class _Gathered(NamedTuple):
    """What a casing gathers: phasors, and their derivatives by pose and by the ground."""

    phasor: ComplexArray
    by_pose: ComplexArray
    by_ground: ComplexArray | None


_Sources = list[tuple[ComplexArray | float, Observation]]


class _Unknown(NamedTuple):
    name: str
    sigma: float


class RangingModel:
    """Residuals of windows and their derivatives; one problem a start."""

    def __init__(self, site: Site, windows: RangingWindows) -> None:
        beacon = site.beacons[0]
        assert beacon.rotor is not None
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
        turned = windows.roll
        cosine, sine, one = np.cos(turned), np.sin(turned), np.ones_like(turned)
        zero = 0.0 * one
        rows = [[one, zero, zero], [zero, cosine, -sine], [zero, sine, cosine]]
        self.side_from_body = np.moveaxis(np.array(rows), -1, 0)  # (n, 3, 3)
        seen = windows.fields.phasor_sensor
        self.seen = np.where(windows.fields.valid[..., None], seen, 0.0)
        self.weight = self._weight(site, windows)

    def _weight(self, site: Site, windows: RangingWindows) -> Array:
        """Return the inverse roots of the phasors' covariance, shape (n, tones, 3, 3)."""
        fields = windows.fields
        beacon = site.beacons[0]
        error = site.model_error if beacon.model_error is None else beacon.model_error
        apart = np.median(np.abs(np.diff(windows.magnet[:, 1]))) if len(fields) > 1 else 0.0
        alike = max(1.0, site.model_error_length / max(float(apart), 1e-3))
        power = 0.5 * np.sum(np.abs(self.seen) ** 2, axis=-1)
        cov = fields.phasor_cov + (error**2 * alike * power / 3.0)[..., None, None] * np.eye(3)
        if windows.depth_sigma:
            # What a depth errs by: the slope of the field along the way, from what was measured.
            slope = np.sqrt(self._slope_power()) * windows.depth_sigma
            cov = cov + (slope**2 / 3.0)[..., None, None] * np.eye(3)
        root = np.linalg.inv(np.linalg.cholesky(cov))
        return np.where(fields.valid[..., None, None], root, 0.0)

    def _slope_power(self) -> Array:
        """Return the mean square of the field's slope along the magnet's way (n, tones)."""
        place = self.windows.magnet[:, 1]
        size = np.linalg.norm(self.seen, axis=-1)
        # |B| falls as the distance cubed: its slope is at most 3 |B| / r, r from its own width.
        share = size / np.max(size, axis=0)
        half = np.array([np.ptp(place[share[:, t] > 0.5]) for t in range(size.shape[1])])
        return np.asarray(0.5 * (3.0 * size / np.maximum(half, 0.1)) ** 2)

    def predicted(self, state: Array) -> tuple[ComplexArray, ComplexArray]:
        """Return phasors (k, n, tones, 3) of states (k, 12 + unknowns), and their Jacobian."""
        if "log_conductivity" in self.names:
            change = state[:, 12 + self.names.index("log_conductivity")]
            if np.any(change != change[0]):  # each has a ground of its own
                apart = [self.predicted(one[None]) for one in state]
                return np.concatenate([p for p, _ in apart]), np.concatenate([j for _, j in apart])
            beacon = _in_other_ground(self.beacon, float(change[0]))
        else:
            beacon = self.beacon
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
        gather: tuple[ComplexArray, _Gathered] | None = None
        if "ellipse_cos" in extra:
            against = observe(_counter(beacon), self.sensor, attitude, position)
            part = (extra["ellipse_cos"] - 1j * extra["ellipse_sin"])[:, None, None, None, None]
            sources.append((part, against))
        whole = sum((part * one.phasor_sensor for part, one in sources), start=_NONE)
        each_pose = sum((_wide(part) * one.platform_pose for part, one in sources), start=_NONE)
        gathered = _NONE
        if self.sensor.casing is not None:
            bend = self._gathered(seen, beacon, attitude, position)
            part = np.exp(extra["log_gather"])[:, None, None, None, None]
            gathered = part * bend.phasor
            whole, each_pose = whole + gathered, each_pose + part[..., None] * bend.by_pose
            gather = part, bend
        phasor = np.sum(share * whole, axis=2)
        by_pose = np.sum(share[..., None] * each_pose, axis=2)  # (k, n, t, 3, 6)
        back = np.swapaxes(turn, -1, -2)[:, None]  # body from side
        by_turn, by_shift = by_pose[..., :3] @ back, by_pose[..., 3:] @ back
        by_turn = by_turn - by_shift @ skew(along)[:, None]
        columns = [by_turn, by_shift]
        way = np.einsum("knba,b->kna", body, -self.axis)  # body axes
        for name in self.names:
            if name == "log_gather":
                column = np.sum(share * gathered, axis=2)
            elif name == "depth_scale":
                each = windows.magnet[..., None, None, None] * each_pose[..., 3:]
                by_way = np.sum(share[..., None] * each, axis=2)
                column = np.einsum("kntab,knb->knta", by_way, way)
            else:
                column = _column(name, sources, gather, phasor, share)
            columns.append(column[..., None])
        size = np.exp(extra.get("log_moment", np.zeros(len(state))))[:, None, None, None]
        jacobian = size[..., None] * np.concatenate(columns, axis=-1)
        return self._through(size * phasor, jacobian, extra)

    def _gathered(
        self, seen: Observation, beacon: Beacon, attitude: Array, position: Array
    ) -> _Gathered:
        """Return what a casing's poles add along it, outside its wall.

        By the second difference of the field along the hole.
        """
        casing, sensor = self.sensor.casing, self.sensor
        assert casing is not None
        mounted = sensor.matrix @ sensor.body_from_sensor.T
        along = mounted @ np.outer(FIRST, FIRST) @ np.linalg.inv(mounted)
        along = tube_gathering(casing, beacon.frequency_hz) / ASIDE**2 * along
        aside = [
            observe(
                beacon,
                replace(sensor, position_body=sensor.position_body + step * FIRST),
                attitude,
                position,
            )
            for step in (-ASIDE, ASIDE)
        ]
        before, after = aside
        ground = None
        if seen.log_conductivity is not None:
            assert before.log_conductivity is not None
            assert after.log_conductivity is not None
            bent = before.log_conductivity + after.log_conductivity - 2.0 * seen.log_conductivity
            ground = (along @ bent[..., None])[..., 0]
        phasor = before.phasor_sensor + after.phasor_sensor - 2.0 * seen.phasor_sensor
        by_pose = before.platform_pose + after.platform_pose - 2.0 * seen.platform_pose
        return _Gathered((along @ phasor[..., None])[..., 0], along @ by_pose, ground)

    def _through(
        self, phasor: ComplexArray, jacobian: ComplexArray, extra: dict[str, Array]
    ) -> tuple[ComplexArray, ComplexArray]:
        """Return what comes through the casing of what is outside."""
        casing, sensor = self.sensor.casing, self.sensor
        if casing is None:
            return phasor, jacobian
        size, tones = len(phasor), len(self.orders)
        first = np.outer(FIRST, FIRST)
        mounted = sensor.matrix @ sensor.body_from_sensor.T
        back = np.linalg.inv(mounted)
        parts = np.zeros((2, size, 1, tones, 3, 3), dtype=np.complex128)
        for t, order in enumerate(self.orders):
            plain = tube_transmission(casing, float(order) * self.beacon.frequency_hz)
            for k, (kind, tensor) in enumerate((("across", np.eye(3) - first), ("along", first))):
                gain = np.exp(extra[f"log_{kind}"] + 1j * extra[f"phase_{kind}"])
                own = mounted @ tensor @ back
                parts[k, :, 0, t] = (getattr(plain, kind) * gain)[:, None, None] * own
        through = parts[0] + parts[1]
        out = through @ jacobian
        for k, kind in enumerate(("across", "along")):
            by = (parts[k] @ phasor[..., None])[..., 0]
            out[..., POSE + self.names.index(f"log_{kind}")] = by
            out[..., POSE + self.names.index(f"phase_{kind}")] = 1j * by
        return (through @ phasor[..., None])[..., 0], out

    def residuals(self, state: Array) -> tuple[Array, Array]:
        """Return whitened residuals (k, d) and their Jacobian (k, d, n), priors last."""
        phasor, jacobian = self.predicted(state)
        seen = np.broadcast_to(self.seen, phasor.shape)
        if not self.windows.angle_known:
            phase = self._phase(phasor)[..., None, None] * self.orders[:, None]
            seen = seen * np.exp(-1j * phase)
        left = (self.weight @ (phasor - seen)[..., None])[..., 0]
        slope = self.weight @ jacobian
        error = np.concatenate([left.real, left.imag], axis=-1)  # (k, n, t, 6)
        by = np.concatenate([slope.real, slope.imag], axis=-2)
        size, n = len(state), by.shape[-1]
        error = error.reshape(size, len(self.seen), -1)
        by = by.reshape(*error.shape, n)
        if not self.windows.angle_known:
            turned = (self.weight @ (1j * self.orders[:, None] * phasor)[..., None])[..., 0]
            free = np.concatenate([turned.real, turned.imag], axis=-1).reshape(error.shape)
            free = free / np.maximum(np.linalg.norm(free, axis=-1, keepdims=True), 1e-300)
            error = error - free * np.sum(free * error, axis=-1, keepdims=True)
            by = by - free[..., None] * np.einsum("knd,kndm->knm", free, by)[:, :, None]
        return error.reshape(size, -1), by.reshape(size, -1, n)

    def with_priors(self, state: Array) -> tuple[Array, Array]:
        """Return the same with the rows of what is known before."""
        error, by = self.residuals(state)
        size, n = len(state), by.shape[-1]
        told = state[:, 12:] / self.prior
        rows = np.zeros((size, len(self.prior), n))
        rows[:, np.arange(len(self.prior)), POSE + np.arange(len(self.prior))] = 1.0 / self.prior
        if not self.windows.angle_known:
            about = self.about_axis(state)[:, None] / OPEN
            rows = np.concatenate(
                [rows, np.concatenate([about, np.zeros((size, 1, n - POSE))], 2)], 1
            )
            told = np.concatenate([told, np.zeros((size, 1))], 1)
        return np.concatenate([error, told], 1), np.concatenate([by, rows], 1)

    def about_axis(self, state: Array) -> Array:
        """Return the step of a turn about the magnet's axis, of length one, shape (k, 6)."""
        rotation, place = state[:, :9].reshape(-1, 3, 3), state[:, 9:12]
        turn = np.einsum("kba,b->ka", rotation, self.axis)
        shift = np.einsum("kba,kb->ka", rotation, np.cross(self.axis, place))
        whole = np.concatenate([turn, shift], axis=1)
        return np.asarray(whole / np.linalg.norm(whole, axis=1, keepdims=True))

    def _phase(self, phasor: ComplexArray) -> Array:
        """Return the phase that brings each window's prediction to its measurement (k, n)."""
        first = self.weight[:, 0]
        seen = (first @ self.seen[:, 0, :, None])[..., 0]
        mine = (first @ phasor[:, :, 0, :, None])[..., 0]
        return np.angle(np.sum(np.conj(mine) * seen, axis=-1))

    def starts(self) -> Array:
        """Return poses over all directions and distances, the likeliest first."""
        windows, size = self.windows, np.linalg.norm(self.seen[:, 0], axis=-1)
        beside = windows.sensor == windows.sensor[np.argmax(size)]
        abreast = float(windows.magnet[np.argmax(np.where(beside, size, 0.0)), 1])
        abreast_from = float(windows.sensor[np.argmax(size)])
        span = max(float(np.ptp(windows.magnet)), 1.0)
        out = []
        zero, axis = self._across(), self.axis
        other = np.cross(axis, zero)
        for sign in (1.0, -1.0):
            for angle in 2.0 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS:
                up = np.cos(angle) * zero + np.sin(angle) * other
                x = sign * axis
                rotation = np.stack([x, np.cross(up, x), up], axis=1)
                for distance in np.geomspace(0.02 * span, 2.0 * span, DISTANCES):
                    place = distance * zero + abreast * axis - abreast_from * x
                    out.append(np.concatenate([rotation.ravel(), place, 0.0 * self.prior]))
        states = self._turned_to_phase(np.array(out))
        cost = np.sum(self.scaled(states) ** 2, axis=1)
        return states[np.argsort(cost)]

    def scaled(self, states: Array) -> Array:
        """Return residuals of states at the moment that suits each best."""
        phasor, _ = self.predicted(states)
        seen = np.broadcast_to(self.seen, phasor.shape)
        if not self.windows.angle_known:
            phase = self._phase(phasor)[..., None, None] * self.orders[:, None]
            seen = seen * np.exp(-1j * phase)
        mine, its = ((self.weight @ part[..., None])[..., 0] for part in (phasor, seen))
        mine, its = mine.reshape(len(states), -1), its.reshape(len(states), -1)
        gain = np.sum(np.real(np.conj(mine) * its), 1) / np.sum(np.abs(mine) ** 2, 1)
        left = np.maximum(gain, 0.0)[:, None] * mine - its
        return np.concatenate([left.real, left.imag], axis=1)

    def _across(self) -> Array:
        assert self.beacon.rotor is not None
        return self.beacon.rotor.zero_beacon

    def _turned_to_phase(self, states: Array) -> Array:
        """Return states turned about the magnet's axis until the phase is the measured one."""
        if not self.windows.angle_known:
            return states
        phasor, _ = self.predicted(states)
        mine, its = ((self.weight @ p[..., None])[..., 0] for p in (phasor, self.seen))
        angle = -np.angle(np.sum(np.conj(mine) * its, axis=(1, 2, 3)))
        turn = np.cos(angle)[:, None, None] * np.eye(3)
        turn = turn + np.sin(angle)[:, None, None] * skew(self.axis)
        turn = turn + (1.0 - np.cos(angle))[:, None, None] * np.outer(self.axis, self.axis)
        out = states.copy()
        out[:, :9] = (turn @ states[:, :9].reshape(-1, 3, 3)).reshape(-1, 9)
        out[:, 9:12] = (turn @ states[:, 9:12, None])[..., 0]
        return out


def _column(
    name: str,
    sources: _Sources,
    gather: tuple[ComplexArray, _Gathered] | None,
    phasor: ComplexArray,
    share: Array,
) -> ComplexArray:
    """Return the derivative of phasors by one number, zero where that is the casing's."""
    if name == "log_moment":
        return phasor
    if name == "log_conductivity":
        grounds = ((part, one.log_conductivity) for part, one in sources)
        ground = sum((p * g for p, g in grounds if g is not None), start=_NONE)
        if gather is not None and gather[1].by_ground is not None:
            ground = ground + gather[0] * gather[1].by_ground
        return np.asarray(np.sum(share * ground, axis=2))
    if name.startswith("ellipse"):
        turned = 1.0 if name == "ellipse_cos" else -1j
        return np.asarray(turned * np.sum(share * sources[1][1].phasor_sensor, axis=2))
    return np.zeros_like(phasor)


def _wide(part: ComplexArray | float) -> ComplexArray | float:
    return part if isinstance(part, float) else part[..., None]


def _counter(beacon: Beacon) -> Beacon:
    """Return the same magnet turning the other way, harmonics left out: none of them is so."""
    cosine, sine = beacon.coils[:2]
    silent = tuple(replace(c, moment_beacon=0.0 * c.moment_beacon) for c in beacon.coils[2:])
    return replace(beacon, coils=(cosine, replace(sine, phase=-sine.phase), *silent))


def _in_other_ground(beacon: Beacon, log_change: float) -> Beacon:
    return replace(beacon, conductivity=beacon.conductivity * float(np.exp(log_change)))


def _unknowns(site: Site, windows: RangingWindows) -> list[_Unknown]:
    beacon, casing = site.beacons[0], site.platform.magnetometer.casing
    found = []
    moment = float(np.sqrt(np.mean(beacon.sigma.log_moment[:2] ** 2)))
    if moment:
        found.append(_Unknown("log_moment", moment))
    if beacon.rotor is not None and beacon.rotor.ellipse_sigma:
        found.append(_Unknown("ellipse_cos", beacon.rotor.ellipse_sigma))
        found.append(_Unknown("ellipse_sin", beacon.rotor.ellipse_sigma))
    if windows.depth_scale_sigma:
        found.append(_Unknown("depth_scale", windows.depth_scale_sigma))
    if site.log_conductivity_sigma:
        found.append(_Unknown("log_conductivity", site.log_conductivity_sigma))
    if casing is not None:
        found.append(_Unknown("log_gather", casing.log_gain_sigma))
        for kind in ("across", "along"):
            found.append(_Unknown(f"log_{kind}", casing.log_gain_sigma))
            found.append(_Unknown(f"phase_{kind}", casing.phase_sigma))
    return found
