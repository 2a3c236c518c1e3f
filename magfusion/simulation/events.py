"""What happens to an installation within days: beacons that sink or are exchanged, hum, heat."""

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.model.site import Beacon, Site
from magfusion.simulation.drift import DailySwing, Wander
from magfusion.units import DAY, DEGREE, NANOTESLA, Array, ComplexArray


@dataclass(frozen=True)
class Settlement:
    """Beacons that sink steadily."""

    per_day: float = 1e-3  # m
    whole: bool = False  # all of them together, instead of one that is drawn


@dataclass(frozen=True)
class Exchange:
    """A drawn beacon is exchanged for another one, mounted about where it was."""

    time: float  # s
    position: float = 0.02  # standard deviation of each axis (m)
    rotation: float = DEGREE  # of each axis (rad)
    log_moment: float = 0.05  # of each coil


@dataclass(frozen=True)
class Hum:
    """Mains whose frequency wanders; demodulation rejects it at its nominal frequency."""

    amplitude: float = 200.0 * NANOTESLA
    frequency_hz: float = 50.0
    wander: Wander = field(default_factory=lambda: Wander(rms=0.05, time_constant=300.0))  # Hz


@dataclass(frozen=True)
class ThermalBias:
    """Biases of the IMU that follow the temperature, linearly."""

    swing: DailySwing
    gyro_per_kelvin: float = 1e-4  # standard deviation of each axis (rad/s)
    accel_per_kelvin: float = 1e-3  # (m/s^2)


@dataclass(frozen=True)
class Events:
    """The events of a run; None where absent."""

    settlement: Settlement | None = None
    exchange: Exchange | None = None
    hum: Hum | None = None
    thermal_bias: ThermalBias | None = None


@dataclass(frozen=True, eq=False)
class DrawnEvents:
    """One draw of the events of a run."""

    events: Events
    beacon: int  # that settles or is exchanged
    exchanged: Beacon  # what replaces it
    # of the mains: direction (3,) in world axes, phase (rad), times (s) and frequencies (Hz)
    hum_direction_world: Array
    hum_phase: float
    hum_time: Array
    hum_frequency_hz: Array
    bias_per_kelvin: Array  # (2, 3), of gyro (rad/s) and accelerometer (m/s^2)

    def site_at(self, site: Site, time: float) -> Site:
        """Return the true site at a time (s); `site`: at the beginning."""
        beacons = list(site.beacons)
        settlement, exchange = self.events.settlement, self.events.exchange
        if settlement is not None:
            down = np.array([0.0, 0.0, -settlement.per_day * time / DAY])
            for k in range(len(beacons)) if settlement.whole else (self.beacon,):
                place = beacons[k].position_world + down
                beacons[k] = replace(beacons[k], position_world=place)
        if exchange is not None and time >= exchange.time:
            beacons[self.beacon] = self.exchanged
        return replace(site, beacons=tuple(beacons))

    def constant_since(self, time: float) -> float:
        """Return since when the true site at a time (s) has been as it is."""
        if self.events.settlement is not None:
            return time
        exchange = self.events.exchange
        return 0.0 if exchange is None or time < exchange.time else exchange.time

    def hum(self, time: Array, tones_hz: Array, window: float) -> ComplexArray:
        """Return what demodulation takes from the mains, in world axes.

        `time` (n,): of the windows' middles (s). `window`: their length (s), whole periods of the
        tones and of the mains' nominal frequency. Returns (n, tones, 3) (T).
        """
        hum = self.events.hum
        if hum is None:
            return np.zeros((len(time), len(tones_hz), 3), dtype=np.complex128)
        frequency_hz = np.interp(time, self.hum_time, self.hum_frequency_hz)[:, None]
        turn = np.exp(1j * (2.0 * np.pi * frequency_hz * time[:, None] + self.hum_phase))
        # Of a rectangular window about its middle.
        leaked = turn * np.sinc((frequency_hz - tones_hz) * window)
        leaked += np.conj(turn) * np.sinc((frequency_hz + tones_hz) * window)
        return np.asarray(hum.amplitude * leaked[..., None] * self.hum_direction_world)

    def bias(self, time: Array) -> Array:
        """Return the biases due to heat, (2, n, 3): gyro (rad/s), accelerometer (m/s^2)."""
        thermal = self.events.thermal_bias
        if thermal is None:
            return np.zeros((2, len(time), 3))
        return self.bias_per_kelvin[:, None] * thermal.swing.temperature(time)[:, None]


def draw_events(events: Events, site: Site, edges: Array, rng: np.random.Generator) -> DrawnEvents:
    """Draw the events of a run.

    `site`: true at the beginning. `edges` (n,): times between which the mains' frequency is
    interpolated (s).
    """
    beacon = int(rng.integers(len(site.beacons)))
    exchange, hum, thermal = events.exchange, events.hum, events.thermal_bias
    replaced = site.beacons[beacon]
    if exchange is not None:
        turn = Rotation.from_rotvec(exchange.rotation * rng.standard_normal(3)).as_matrix()
        gain = np.exp(exchange.log_moment * rng.standard_normal(len(replaced.coils)))
        replaced = replace(
            replaced,
            position_world=replaced.position_world + exchange.position * rng.standard_normal(3),
            world_from_beacon=replaced.world_from_beacon @ turn,
            coils=tuple(
                replace(coil, moment_beacon=float(g) * coil.moment_beacon)
                for coil, g in zip(replaced.coils, gain, strict=True)
            ),
        )
    direction, per_kelvin = rng.standard_normal(3), rng.standard_normal((2, 3))
    wander = np.zeros(len(edges))
    if hum is not None:
        wander = hum.frequency_hz + hum.wander.draw(edges, 1, rng)[:, 0]
    scale = (0.0, 0.0) if thermal is None else (thermal.gyro_per_kelvin, thermal.accel_per_kelvin)
    return DrawnEvents(
        events=events,
        beacon=beacon,
        exchanged=replaced,
        hum_direction_world=direction / np.linalg.norm(direction),
        hum_phase=float(rng.uniform(-np.pi, np.pi)),
        hum_time=edges,
        hum_frequency_hz=wander,
        bias_per_kelvin=np.array(scale)[:, None] * per_kelvin,
    )
