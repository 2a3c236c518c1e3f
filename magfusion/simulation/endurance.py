"""Days of samples, generated in blocks: mostly at rest, a walk every hour, with all drifts.

Each block of a minute has a random generator of its own, so that neither the length of the
stretches nor where a run is resumed changes a sample.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from magfusion.errors import InputError
from magfusion.model.samples import FieldSamples, ImuSamples
from magfusion.model.site import ImuModel, Site
from magfusion.model.trajectory import Trajectory, interpolated
from magfusion.simulation.demo_site import DEMO_BOX_WORLD
from magfusion.simulation.disturbance import DayNight
from magfusion.simulation.drift import (
    COPPER_PER_KELVIN,
    DailySwing,
    Drift,
    DriveClock,
    Wander,
    WarmUp,
    draw_drift,
)
from magfusion.simulation.events import DrawnEvents, Events, draw_events
from magfusion.simulation.inertial import BiasInstability
from magfusion.simulation.log import draw_drives, perturb_site, simulate_fields
from magfusion.simulation.motion import Rests, SimulatedMotion, random_walk_motion
from magfusion.units import HOUR, NANOTESLA, Array, BoolArray, ComplexArray

BLOCK = 60.0  # s
MAX_HOURS = 1000.0
SCHEDULE = Rests(start=40.0, move=180.0, pause=3420.0)
MARGIN = 10.0  # s before and after a walk in which fields come as often as in it
DAYTIME = 14.0 * HOUR  # loudest and warmest; the run starts at midnight
HEAT = WarmUp(rise=20.0, time_constant=90.0 * 60.0)
CLOCK_WALK = 1e-9  # s per root second; a quartz
CURRENT_PER_KELVIN = 1e-4  # what a current source loses
_WORLD, _IMU, _FIELDS = range(3)  # first key of each stream of random numbers


def usual_drift(drive: str, clock_rate: float) -> Drift:
    """Return drifts of the moments, their gain, a common drive clock, and the sensor's scale.

    `drive`: 'current' or 'voltage': a constant voltage drives less current through warmer copper.
    `clock_rate`: relative error of the drives' common clock.
    """
    return Drift(
        coils=HEAT,
        fading_per_kelvin=COPPER_PER_KELVIN if drive == "voltage" else CURRENT_PER_KELVIN,
        gain=Wander(rms=0.003, time_constant=4.0 * HOUR),
        clock=DriveClock(rate=clock_rate, walk=CLOCK_WALK),
        sensor=DailySwing(amplitude=4.0, warmest_time=DAYTIME),
        scale_per_kelvin=5e-5,
    )


@dataclass(frozen=True, eq=False)
class EnduranceConfig:
    """Configuration of a run of hours."""

    hours: float
    # of moments and sensor, and of the clock common to all drives; beacons that are not
    # synchronised also drift relative to it, each at a rate of its own
    drift: Drift = field(default_factory=lambda: usual_drift("current", 0.0))
    events: Events = field(default_factory=Events)
    schedule: Rests = SCHEDULE  # walks, and the rests between them
    # (2, 3), range of the platform (m)
    box_world: Array = field(default_factory=lambda: DEMO_BOX_WORLD)
    speed: float = 0.5  # (m/s)
    imu_rate_hz: float = 100.0
    instability: BiasInstability | None = None  # of the IMU, in addition to its bias walk
    # of the field
    noise: DayNight = field(
        default_factory=lambda: DayNight(0.2 * NANOTESLA, 0.4 * NANOTESLA, DAYTIME)
    )
    window: float = 0.4  # of a phasor (s)
    # rest_interval, walk_interval: between two phasors (s)
    rest_interval: float = 60.0
    walk_interval: float = 1.0

    def __post_init__(self) -> None:
        """Raise an error if the configuration cannot be simulated."""
        if not 0.0 < self.hours <= MAX_HOURS:
            raise InputError(f"hours: found {self.hours:g}; give more than 0 and at most 1000")
        for name in ("rest_interval", "walk_interval"):
            ratio = BLOCK / getattr(self, name)
            if ratio < 1.0 or abs(ratio - round(ratio)) > 1e-9:
                raise InputError(f"{name}: found {getattr(self, name):g} s; give a divisor of 60 s")

    @property
    def blocks(self) -> int:
        """Number of blocks."""
        return max(1, round(self.hours * HOUR / BLOCK))

    def active(self, time: Array) -> BoolArray:
        """Return at which times the platform walks, is about to walk, or has just walked."""
        rests = self.schedule
        cycle = rests.move + rests.pause
        start_time = (time - rests.start + MARGIN) % cycle
        walks = time >= rests.start - MARGIN
        return walks & (start_time <= rests.move + 2.0 * MARGIN)


@dataclass(frozen=True, eq=False)
class Biases:
    """State of the bias processes between two blocks: walks and Gauss-Markov parts, (2, 3) each.

    First the gyro's (rad/s), then the accelerometer's (m/s^2).
    """

    walk: Array
    wander: Array


@dataclass(frozen=True, eq=False)
class SimulatedStretch:
    """Some minutes of samples and their true values."""

    first: int  # first block
    imu: ImuSamples
    fields: FieldSamples
    # gyro_bias_body, accel_bias_body: (n, 3), at the inertial samples (rad/s, m/s^2)
    gyro_bias_body: Array
    accel_bias_body: Array
    after: Biases  # start of the next stretch


@dataclass(frozen=True, eq=False)
class EnduranceWorld:
    """One draw of all true values of a run; a few megabytes for 48 hours."""

    config: EnduranceConfig
    site: Site  # known to the estimator
    true_site: Site
    motion: SimulatedMotion
    log_gain: Array  # (blocks + 1, beacons), of the moments, at the blocks' edges
    phase: Array  # (blocks + 1, channels), in addition to the declared (rad)
    scale: Array  # (blocks + 1,), of the magnetometer
    events: DrawnEvents
    seed: tuple[int, ...]

    def start(self) -> Biases:
        """Return the biases at the beginning."""
        rng = _generator(self.seed, _WORLD, 1)
        imu = self.true_site.platform.imu
        first = np.array([[imu.gyro_bias_sigma], [imu.accel_bias_sigma]])
        walk = first * rng.standard_normal((2, 3))
        return Biases(walk, _wander_sigma(self.config.instability) * rng.standard_normal((2, 3)))

    def stretch(self, first: int, count: int, before: Biases) -> SimulatedStretch:
        """Return some blocks of samples.

        `first`, `count`: blocks; no more than there are. `before`: from the previous stretch.
        """
        count = min(count, self.config.blocks - first)
        inertial, fields = [], []
        still: dict[tuple[int, float], ComplexArray] = {}
        for block in range(first, first + count):
            built = self._inertial(block, before)
            before = built[-1]
            inertial.append(built)
            fields.append(self._fields(block, still))
        time, gyro, accel, gyro_bias, accel_bias = (
            np.concatenate([built[i] for built in inertial]) for i in range(5)
        )
        return SimulatedStretch(
            first=first,
            imu=ImuSamples(time, gyro, accel),
            fields=FieldSamples.joined(fields),
            gyro_bias_body=gyro_bias,
            accel_bias_body=accel_bias,
            after=before,
        )

    def truth(self, stretch: SimulatedStretch, time: Array) -> Trajectory:
        """Return the true values at times within a stretch."""
        known = stretch.imu.time
        return replace(
            self.motion.trajectory(time),
            gyro_bias_body=interpolated(time, known, stretch.gyro_bias_body),
            accel_bias_body=interpolated(time, known, stretch.accel_bias_body),
        )

    def _inertial(
        self, block: int, before: Biases
    ) -> tuple[Array, Array, Array, Array, Array, Biases]:
        rng, imu = _generator(self.seed, _IMU, block), self.true_site.platform.imu
        rate_hz = self.config.imu_rate_hz
        begin, end = (round(k * BLOCK * rate_hz) for k in (block, block + 1))
        time = np.arange(begin, end) / rate_hz
        ideal = self._ideal(time + imu.time_offset)
        bias, after = _continued_biases(
            before, imu, self.config.instability, rate_hz, len(time), rng
        )
        bias = bias + self.events.bias(time)
        white = np.sqrt(rate_hz) * rng.standard_normal((2, len(time), 3))
        gyro = ideal[0] + bias[0] + imu.gyro_noise * white[0]
        accel = ideal[1] + bias[1] + imu.accel_noise * white[1]
        return time, gyro, accel, bias[0], bias[1], after

    def _ideal(self, time: Array) -> tuple[Array, Array]:
        """Return rate and specific force; evaluated once per rest."""
        requested = time if np.any(self.config.active(time)) else time[:1]
        return (
            self.motion.rate_body(requested),
            self.motion.specific_force_body(requested, self.true_site.gravity),
        )

    def _fields(self, block: int, still: dict[tuple[int, float], ComplexArray]) -> FieldSamples:
        config, site = self.config, self.true_site
        time = self._field_times(block)
        rng = _generator(self.seed, _FIELDS, block)
        share = time / BLOCK - block
        log_gain, phase, scale = (
            _between(known[block : block + 2], share)
            for known in (self.log_gain, self.phase, self.scale[:, None])
        )
        owner = [i for i, b in enumerate(site.beacons) for _ in b.tones]
        drive = scale * np.exp(log_gain[:, owner] + 1j * phase)
        seen = drive[..., None] * self._undisturbed(time, still) + self._hum(time, site)
        sigma = config.noise.density(time) / np.sqrt(config.window)
        noise = sigma[:, None, None] * rng.standard_normal((2, *seen.shape))
        cov = sigma[:, None, None, None] ** 2 * np.eye(3)
        return FieldSamples(
            time=time,
            window=np.full(len(time), config.window),
            channels=site.channels,
            phasor_sensor=seen + noise[0] + 1j * noise[1],
            phasor_cov=np.broadcast_to(cov, (*seen.shape, 3)).copy(),
        )

    def _hum(self, time: Array, site: Site) -> ComplexArray:
        hum_world = self.events.hum(time, site.tone_frequencies_hz, self.config.window)
        sensor_from_body = site.platform.magnetometer.body_from_sensor.T
        body_from_world = np.swapaxes(self.motion.trajectory(time).world_from_body, 1, 2)
        sensor_from_world = sensor_from_body @ body_from_world
        return np.asarray((sensor_from_world[:, None] @ hum_world[..., None])[..., 0])

    def _undisturbed(
        self, time: Array, still: dict[tuple[int, float], ComplexArray]
    ) -> ComplexArray:
        """Return the phasors as declared; those of a rest are computed once, at its middle."""
        if np.any(self.config.active(time)):
            return self._phasors(time, float(time[0]))
        rests = self.config.schedule
        cycle = rests.move + rests.pause
        rest = int(np.floor((time[0] - rests.start) / cycle))
        key = rest, self.events.constant_since(float(time[0]))
        if key not in still:
            middle = rests.start + rest * cycle + rests.move + 0.5 * rests.pause
            still[key] = self._phasors(np.array([max(middle, 0.0)]), float(time[0]))
        return np.repeat(still[key], len(time), axis=0)

    def _phasors(self, time: Array, now: float) -> ComplexArray:
        poses, site = self.motion.trajectory(time), self.events.site_at(self.true_site, now)
        rng = np.random.default_rng(0)  # of noise that is none
        return simulate_fields(site, poses, 0.0, rng).phasor_sensor

    def _field_times(self, block: int) -> Array:
        config = self.config
        count = round(BLOCK / config.walk_interval)
        often = block * BLOCK + np.arange(count, dtype=float) * config.walk_interval
        every = round(config.rest_interval / config.walk_interval)
        seldom = np.arange(len(often)) % every == 0
        return often[config.active(often) | seldom]


def draw_endurance(site: Site, config: EnduranceConfig, seed: tuple[int, ...]) -> EnduranceWorld:
    """Draw a world.

    `site`: known to the estimator; the true calibration is drawn from its sigmas. Raises InputError
    if the site or the configuration cannot be simulated.
    """
    site_rng, motion_rng, drift_rng, clock_rng, event_rng = _generator(seed, _WORLD, 0).spawn(5)
    true_site = perturb_site(site, site_rng)
    motion = random_walk_motion(
        motion_rng, config.blocks * BLOCK, config.box_world, config.speed, rests=config.schedule
    )
    edges = BLOCK * np.arange(config.blocks + 1, dtype=float)
    drawn = draw_drift(config.drift, edges, len(site.beacons), drift_rng)
    tones_hz = site.tone_frequencies_hz
    drives = draw_drives(site, clock_rng)
    tones = [len(b.tones) for b in site.beacons]
    own = [
        np.zeros(len(edges))
        if beacon.synchronised
        else DriveClock(float(rate), CLOCK_WALK).lead(edges, clock_rng)
        for beacon, rate in zip(site.beacons, drives.drift, strict=True)
    ]
    lead = drawn.lead[:, None] + np.repeat(np.stack(own, axis=1), tones, axis=1)
    return EnduranceWorld(
        config=config,
        site=site,
        true_site=true_site,
        motion=motion,
        log_gain=drawn.log_gain,
        phase=drives.phase + 2.0 * np.pi * lead * tones_hz,
        scale=drawn.sensor_scale,
        events=draw_events(config.events, true_site, edges, event_rng),
        seed=seed,
    )


def _generator(seed: tuple[int, ...], stream: int, block: int) -> np.random.Generator:
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(stream, block)))


def _wander_sigma(instability: BiasInstability | None) -> Array:
    """Return the standard deviation of the Gauss-Markov parts, (2, 1)."""
    if instability is None:
        return np.zeros((2, 1))
    return instability.sigma[:, None]


def _continued_biases(
    before: Biases,
    imu: ImuModel,
    instability: BiasInstability | None,
    rate_hz: float,
    count: int,
    rng: np.random.Generator,
) -> tuple[Array, Biases]:
    """Return the biases at the samples of a block, (2, n, 3), and their final state."""
    steps = np.array([imu.gyro_bias_walk, imu.accel_bias_walk]) / np.sqrt(rate_hz)
    walk = steps[:, None, None] * rng.standard_normal((2, count, 3))
    np.cumsum(walk, axis=1, out=walk)
    walk += before.walk[:, None]
    if instability is None:
        return walk, Biases(walk[:, -1], before.wander)
    from scipy.signal import lfilter  # takes as long as all else to import

    decay = instability.decay(rate_hz)
    sigma = _wander_sigma(instability)[..., None] * np.sqrt(1.0 - decay**2)
    drive = sigma * rng.standard_normal((2, count, 3))
    wander, _ = lfilter([1.0], [1.0, -decay], drive, axis=1, zi=decay * before.wander[:, None])
    return walk + wander, Biases(walk[:, -1], wander[:, -1])


def _between(known: Array, share: Array) -> Array:
    after = share[:, None]
    return (1.0 - after) * known[0] + after * known[1]
