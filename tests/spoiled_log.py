"""Small simulated logs, and what spoils them; the package's own simulator, no truth is used."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.model.samples import Log
from magfusion.model.site import Beacon, Site
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import SimulatedLog, SimulationConfig, simulate_log
from magfusion.simulation.waveform import Mains
from magfusion.units import DEGREE, Array

SECONDS = 24.0


@dataclass(frozen=True, eq=False)
class Recorded:
    """A log with the site that is declared of it."""

    log: Log
    site: Site


Change = Callable[[Recorded], Recorded]


@cache
def simulated(motion: str = "turn", seed: int = 3, **world: float) -> SimulatedLog:
    """Return a simulated log; ``line_hz`` and ``line`` (T) add a line to the field."""
    mains = None
    if "line_hz" in world:
        mains = Mains(world["line"], world["line_hz"], (), np.array([0.3, 0.5, 0.8]))
    config = SimulationConfig(
        box_world=DEMO_BOX_WORLD,
        duration=world.get("seconds", SECONDS),
        motion=motion,  # type: ignore[arg-type]
        magnetometer_rate_hz=250.0,
        mains=mains,
    )
    return simulate_log(demo_site(coil_radius=None), config, np.random.default_rng(seed))


def good(motion: str = "turn", seed: int = 3) -> Recorded:
    """Return a log with which nothing is wrong."""
    return Recorded(simulated(motion, seed).log, demo_site(coil_radius=None))


def with_line(frequency_hz: float, amplitude: float) -> Change:
    """Return a log with a line in its field (Hz, T), in place of any other."""
    return lambda _: Recorded(
        simulated(line_hz=frequency_hz, line=amplitude).log, demo_site(coil_radius=None)
    )


def imu(
    gyro: Callable[[Array], Array] = lambda v: v,
    accel: Callable[[Array], Array] = lambda v: v,
    time: Callable[[Array], Array] = lambda t: t,
) -> Change:
    """Return a change of the inertial samples."""

    def changed(one: Recorded) -> Recorded:
        old = one.log.imu
        new = replace(
            old,
            time=time(old.time),
            gyro_body=gyro(old.gyro_body.copy()),
            accel_body=accel(old.accel_body.copy()),
        )
        return replace(one, log=replace(one.log, imu=new))

    return changed


def field(change: Callable[[Array], Array]) -> Change:
    """Return a change of the magnetometer's samples."""

    def changed(one: Recorded) -> Recorded:
        wave = one.log.waveform
        assert wave is not None
        new = replace(wave, measured_sensor=change(wave.measured_sensor.copy()))
        return replace(one, log=replace(one.log, waveform=new))

    return changed


def without_gravity(one: Recorded) -> Recorded:
    """Return the accelerations from which a smart sensor has removed gravity."""
    old = one.log.imu
    attitude = simulated().motion.world_from_body(old.time)
    force = old.accel_body - attitude.inv().apply([0.0, 0.0, one.site.gravity])
    return replace(one, log=replace(one.log, imu=replace(old, accel_body=force)))


def kept(share: Callable[[Array], Array], *, of_imu: bool) -> Change:
    """Return a log without the samples that a mask of their times does not keep."""

    def changed(one: Recorded) -> Recorded:
        old, wave = one.log.imu, one.log.waveform
        assert wave is not None
        if of_imu:
            rows = share(old.time)
            new = replace(
                old,
                time=old.time[rows],
                gyro_body=old.gyro_body[rows],
                accel_body=old.accel_body[rows],
            )
            return replace(one, log=replace(one.log, imu=new))
        rows = share(wave.time)
        short = replace(wave, time=wave.time[rows], measured_sensor=wave.measured_sensor[rows])
        return replace(one, log=replace(one.log, waveform=short))

    return changed


def beacons(change: Callable[[tuple[Beacon, ...]], tuple[Beacon, ...]]) -> Change:
    """Return a change of the declared beacons."""
    return lambda one: replace(one, site=replace(one.site, beacons=change(one.site.beacons)))


def mounted(rpy_deg: tuple[float, float, float]) -> Change:
    """Return a magnetometer that is declared to be mounted otherwise."""
    turn = Rotation.from_euler("xyz", rpy_deg, degrees=True).as_matrix()

    def changed(one: Recorded) -> Recorded:
        platform = one.site.platform
        sensor = platform.magnetometer
        sensor = replace(sensor, body_from_sensor=sensor.body_from_sensor @ turn)
        site = replace(one.site, platform=replace(platform, magnetometer=sensor))
        return replace(one, site=site)

    return changed


def silent(name: str, begin: float, end: float) -> Change:
    """Return a log in which a beacon is switched off from one time to another (s)."""

    def changed(one: Recorded) -> Recorded:
        whole = simulated()
        off = tuple(
            replace(
                beacon,
                coils=tuple(
                    replace(coil, moment_beacon=1e-9 * coil.moment_beacon) for coil in beacon.coils
                ),
            )
            if beacon.name == name
            else beacon
            for beacon in whole.true_site.beacons
        )
        wave, other = one.log.waveform, _again(replace(whole.true_site, beacons=off)).log.waveform
        assert wave is not None
        assert other is not None
        inside = ((wave.time >= begin) & (wave.time < end))[:, None]
        measured = np.where(inside, other.measured_sensor, wave.measured_sensor)
        new = replace(wave, measured_sensor=measured)
        return replace(one, log=replace(one.log, waveform=new))

    return changed


def _again(site: Site) -> SimulatedLog:
    """Return the log of `simulated` in another world."""
    config = SimulationConfig(
        box_world=DEMO_BOX_WORLD,
        duration=SECONDS,
        motion="turn",
        magnetometer_rate_hz=250.0,
        perturb=False,
        time_offset=0.0,
    )
    return simulate_log(site, config, np.random.default_rng(3))


def limited(share: float) -> Callable[[Array], Array]:
    """Return an instrument whose range ends at a share of its largest reading."""
    return lambda v: np.clip(v, -share * np.abs(v).max(), share * np.abs(v).max())


def fixed(every: int) -> Callable[[Array], Array]:
    """Return an instrument that is read more often than it measures."""
    return lambda v: v[np.arange(len(v)) // every * every]


def stuck(axis: int, value: float) -> Callable[[Array], Array]:
    """Return an instrument with a dead axis."""

    def changed(v: Array) -> Array:
        v[:, axis] = value
        return v

    return changed


def frozen(first: int, last: int) -> Callable[[Array], Array]:
    """Return an instrument that hangs for some samples."""

    def changed(v: Array) -> Array:
        v[first:last] = v[first]
        return v

    return changed


def spiky(size: float, seed: int = 1) -> Callable[[Array], Array]:
    """Return an instrument of which two samples in a thousand are false."""

    def changed(v: Array) -> Array:
        rng = np.random.default_rng(seed)
        hit = rng.choice(len(v), len(v) // 500, replace=False)
        v[hit] += size * rng.choice([-1.0, 1.0], (len(hit), 3))
        return v

    return changed


def jittery(sigma: float, seed: int = 2) -> Callable[[Array], Array]:
    """Return stamps that scatter (s) and still increase."""
    return lambda t: np.sort(t + np.random.default_rng(seed).normal(0.0, sigma, len(t)))


RATE = 1.0 / DEGREE


def burst_stamps(count: int, rate_hz: float, rng: np.random.Generator) -> Array:
    """Return stamps (s) of a host that fetches 3 to 20 samples every 50 to 70 ms, 1-2 ms apart."""
    bursts: list[Array] = []
    now, sent = 0.1, 0
    while sent < count:
        now += rng.uniform(0.05, 0.07)
        ready = int((now - rng.uniform(0.0, 0.12)) * rate_hz) - sent
        size = min(int(np.clip(ready, 3, 20)), count - sent)
        bursts.append(now + np.cumsum(rng.uniform(0.001, 0.002, size)))
        now, sent = float(bursts[-1][-1]), sent + size
    return np.concatenate(bursts)


def host_stamps(
    count: int,
    rate_hz: float,
    rng: np.random.Generator,
    inner: tuple[float, float],
    lateness: tuple[float, float],
    size: int | None = None,
) -> Array:
    """Return stamps (s) of a host that reads `size` samples, or all that are ready, at a time.

    `inner`: time between two samples of a burst (s). `lateness`: of each read (s); without a size
    the pause between two.
    """
    stamps, sent, now = np.empty(count), 0, 0.0
    while sent < count:
        if size is None:
            now += rng.uniform(*lateness)
            own = max(int(now * rate_hz) - sent, 1)
        else:
            own = size
            now = (sent + own) / rate_hz + rng.uniform(*lateness)
        own = min(own, count - sent)
        stamps[sent : sent + own] = now + np.cumsum(rng.uniform(*inner, own)) - inner[0]
        now = float(stamps[sent + own - 1])
        sent += own
    return stamps
