"""Effect of a casing about the sensor on a field: flux gathering and attenuation by its wall."""

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from magfusion.estimation.posterior.separation import POSE
from magfusion.estimation.ranging.ranging_data import FIRST, RangingWindows
from magfusion.model.field import observe
from magfusion.model.physics.casing import (
    MAX_LOG_ERROR,
    STEEL,
    Casing,
    Response,
    gathering_weights,
    tube_response,
)
from magfusion.model.site import Beacon, Magnetometer
from magfusion.units import Array, ComplexArray

LOGS = tuple(f"log_casing_{name}" for name in STEEL)
PER_REACH, REACHES = (
    10.0,
    1.5,
)  # places along the casing within the reach; how many of it, each side


def casing_unknowns(casing: Casing) -> tuple[tuple[str, float], ...]:
    """Return names and sigmas of a casing's estimated parameters."""
    result = list[tuple[str, float]]()
    for kind in ("gather", "across", "along"):
        result.append((f"log_{kind}", casing.log_gain_sigma))
        result.append((f"phase_{kind}", casing.phase_sigma))
    steel = zip(LOGS, casing.steel_sigma.tolist(), strict=True)
    return (*result, *((name, sigma) for name, sigma in steel if sigma))


class CasingResponse(NamedTuple):
    """Field gathered by a casing: phasors (k, n, 1, tones, 3), and derivatives.

    ``by_strength`` is that by the logarithm of the tube's strength, a complex number.
    """

    phasor: ComplexArray
    by_pose: ComplexArray
    by_ground: ComplexArray | None
    by_strength: ComplexArray


class CasingModel:
    """A casing at the frequencies of a rotor, for many states at once."""

    def __init__(
        self, sensor: Magnetometer, orders: Array, frequency_hz: float, windows: RangingWindows
    ) -> None:
        assert sensor.casing is not None
        self._sensor, self._casing = sensor, sensor.casing
        self._tones_hz = [float(order) * frequency_hz for order in orders]
        self._mounted = sensor.matrix @ sensor.body_from_sensor.T
        step = float(windows.reach[0]) / PER_REACH
        count = int(np.ceil(REACHES * PER_REACH))
        self._place = step * np.arange(-count, count + 1.0)

    def responses(self, extra: Mapping[str, Array], size: int) -> list[Response]:
        """Return the response of the tube at each tone, for states (k,)."""
        zero = np.zeros(size)
        change = np.stack([extra.get(name, zero) for name in LOGS], axis=1)
        return [tube_response(self._casing, tone, change) for tone in self._tones_hz]

    def gathered(
        self,
        beacon: Beacon,
        attitude: Array,
        position: Array,
        extra: Mapping[str, Array],
        responses: list[Response],
    ) -> CasingResponse:
        """Return the field of a casing's poles along it, outside its wall.

        `attitude`, `position` (k, n, 1, 3, 3) and (k, n, 1, 3): of the sensor in the middle of
        windows.
        """
        factor = np.exp(
            np.clip(extra["log_gather"], -MAX_LOG_ERROR, MAX_LOG_ERROR) + 1j * extra["phase_gather"]
        )
        both = [
            gathering_weights(factor * own.strength, self._casing.radius, self._place)
            for own in responses
        ]
        weight, slope = (np.stack(part)[:, :, None, None] for part in zip(*both, strict=True))
        along = self._part(np.outer(FIRST, FIRST))
        whole = by_pose = by_ground = by_strength = np.zeros((), dtype=np.complex128)
        has_ground = False
        for j, place in enumerate(self._place):
            moved = replace(self._sensor, position_body=self._sensor.position_body + place * FIRST)
            seen = observe(beacon, moved, attitude, position)
            own, bent = (np.moveaxis(part[..., j], 0, -1)[..., None] for part in (weight, slope))
            phasor = (along @ seen.phasor_sensor[..., None])[..., 0]
            whole = whole + own * phasor
            by_strength = by_strength + bent * phasor
            by_pose = by_pose + own[..., None] * (along @ seen.platform_pose)
            if seen.log_conductivity is not None:
                has_ground = True
                by_ground = by_ground + own * (along @ seen.log_conductivity[..., None])[..., 0]
        return CasingResponse(whole, by_pose, by_ground if has_ground else None, by_strength)

    def column(
        self, name: str, bend: CasingResponse, responses: list[Response]
    ) -> ComplexArray | None:
        """Return the derivative of the gathered field (k, n, tones, 3) by a casing parameter."""
        by = bend.by_strength[:, :, 0]
        if name in {"log_gather", "phase_gather"}:
            return by if name == "log_gather" else 1j * by
        if name not in LOGS:
            return None
        steel = np.stack([own.by_steel[2, :, LOGS.index(name)] for own in responses], axis=-1)
        return np.asarray(steel[:, None, :, None] * by)

    def through(
        self,
        phasor: ComplexArray,
        jacobian: ComplexArray,
        extra: Mapping[str, Array],
        names: tuple[str, ...],
        responses: list[Response],
    ) -> tuple[ComplexArray, ComplexArray]:
        """Return phasors inside the wall for phasors (k, n, tones, 3) outside it."""
        first = np.outer(FIRST, FIRST)
        tensors = self._part(np.eye(3) - first), self._part(first)
        parts = []
        for kind, tensor in zip(("across", "along"), tensors, strict=True):
            gain = np.exp(extra[f"log_{kind}"] + 1j * extra[f"phase_{kind}"])
            plain = np.stack([getattr(own, kind) for own in responses], axis=1)  # (k, tones)
            parts.append((plain * gain[:, None])[:, None, :, None, None] * tensor)
        through = parts[0] + parts[1]
        out = through @ jacobian
        for k, kind in enumerate(("across", "along")):
            by = (parts[k] @ phasor[..., None])[..., 0]
            out[..., POSE + names.index(f"log_{kind}")] = by
            out[..., POSE + names.index(f"phase_{kind}")] = 1j * by
            for i, name in enumerate(LOGS):
                if name in names:
                    steel = np.stack([own.by_steel[k, :, i] for own in responses], axis=1)
                    out[..., POSE + names.index(name)] += steel[:, None, :, None] * by
        return (through @ phasor[..., None])[..., 0], out

    def _part(self, tensor: Array) -> Array:
        """Return a tensor in body axes converted to the sensor's measured axes."""
        return np.asarray(self._mounted @ tensor @ np.linalg.inv(self._mounted))
