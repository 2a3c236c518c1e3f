"""A log, the site that is declared of it, and how a mistake changes either.

Three logs: moving with an exact survey, moving with a rough one, and at rest.  A mistake takes a
`Case` and returns another; those of the world simulate the same motion again.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal

import numpy as np

from magfusion.model.samples import ImuSamples, Log, Waveform
from magfusion.model.site import Beacon, ImuModel, Magnetometer, Site
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import SimulatedLog, SimulationConfig, simulate_log
from magfusion.simulation.waveform import simulate_waveform
from magfusion.units import DEGREE, Array

Group = Literal["none", "site", "data", "world", "midway", "instrument", "aiding"]
LOGS = ("moving", "rough", "rest")
DURATION = 40.0  # s
TIME_OFFSET = 0.004  # s, of the IMU, within its prior


@dataclass(frozen=True, eq=False)
class Case:
    """What a user hands in, and what it was made of.

    Parameters
    ----------
    log : Log
    site : Site
        As declared.
    truth : SimulatedLog
    config : SimulationConfig
    seed : int
    """

    log: Log
    site: Site
    truth: SimulatedLog
    config: SimulationConfig
    seed: int

    @property
    def imu(self) -> ImuSamples:
        """Inertial samples."""
        return self.log.imu

    @property
    def waveform(self) -> Waveform:
        """Magnetometer samples."""
        assert self.log.waveform is not None
        return self.log.waveform

    @property
    def rng(self) -> np.random.Generator:
        """What a mistake draws from."""
        return np.random.default_rng([self.seed, 1])


Change = Callable[[Case], Case]


@dataclass(frozen=True)
class Mistake:
    """Something that people get wrong.

    Parameters
    ----------
    name : str
    group : str
        Where it is made: in the site's file, in the data, in the world, by an instrument; or when:
        during the log.
    change : callable
    codes : tuple of str
        Of `magfusion.model.trust.CODES`: the right diagnoses; none where none is expected.
    unseen : tuple of str
        Logs in which it leaves no trace, so that its parameter is to be listed as unverified.
    parameter : str
        Part of that parameter's name.
    harmless : bool
        Whether a trustworthy verdict is right, as the error stays covered.
    unknowable : bool
        Whether no log could reveal it: what all poses share.
    """

    name: str
    group: Group
    change: Change
    codes: tuple[str, ...] = ()
    unseen: tuple[str, ...] = ()
    parameter: str = ""
    harmless: bool = False
    unknowable: bool = False


@lru_cache(maxsize=3)
def good_case(kind: str, seed: int) -> Case:
    """Return a log with which nothing is wrong."""
    site = demo_site(coil_radius=None)
    if kind == "rough":
        site = _roughly_surveyed(site)
    motions: dict[str, Literal["walk", "turn", "static"]]
    motions = {"moving": "walk", "rough": "turn", "rest": "static"}
    config = SimulationConfig(
        box_world=DEMO_BOX_WORLD,
        duration=DURATION,
        motion=motions[kind],
        time_offset=0.0 if kind == "rest" else TIME_OFFSET,
    )
    return simulated(site, config, seed)


def simulated(site: Site, config: SimulationConfig, seed: int) -> Case:
    """Return a case of a site that is declared as it is."""
    truth = simulate_log(site, config, np.random.default_rng(seed))
    return Case(truth.log, site, truth, config, seed)


def again(case: Case, world: Site | None = None, **changes: object) -> Case:
    """Return the same case in a world of which the declared site knows nothing.

    Parameters
    ----------
    world : Site, optional
        In place of the declared one.
    **changes : object
        Of the `SimulationConfig`.
    """
    config = replace(case.config, **changes)  # type: ignore[arg-type]
    built = simulated(case.site if world is None else world, config, case.seed)
    return replace(built, site=case.site)


def _roughly_surveyed(site: Site) -> Site:
    beacons = tuple(
        with_sigma(beacon, position=0.05, rotation=2.0 * DEGREE, log_moment=0.03)
        for beacon in site.beacons
    )
    sigma = replace(
        site.platform.magnetometer.sigma,
        matrix=np.full((3, 3), 0.01),
        offset=np.full(3, 4e-8),
        rotation_sensor=np.full(3, 1.0 * DEGREE),
    )
    return with_magnetometer(replace(site, beacons=beacons), sigma=sigma)


def with_sigma(beacon: Beacon, position: float, rotation: float, log_moment: float) -> Beacon:
    """Return a beacon whose survey is so uncertain (m, rad)."""
    sigma = replace(
        beacon.sigma,
        position_world=np.full(3, position),
        rotation_beacon=np.full(3, rotation),
        log_moment=np.full(len(beacon.coils), log_moment),
    )
    return replace(beacon, sigma=sigma)


def with_magnetometer(site: Site, **changes: object) -> Site:
    """Return a site with another magnetometer."""
    magnetometer: Magnetometer = replace(site.platform.magnetometer, **changes)  # type: ignore[arg-type]
    return replace(site, platform=replace(site.platform, magnetometer=magnetometer))


def with_imu(site: Site, **changes: object) -> Site:
    """Return a site with another inertial sensor."""
    imu: ImuModel = replace(site.platform.imu, **changes)  # type: ignore[arg-type]
    return replace(site, platform=replace(site.platform, imu=imu))


def declared(case: Case, site: Site) -> Case:
    """Return the case with another site."""
    return replace(case, site=site)


def of_beacons(change: Callable[[Beacon], Beacon], *names: str) -> Change:
    """Return a mistake in the declared beacons of these names, or in all."""

    def changed(case: Case) -> Case:
        beacons = tuple(change(b) if not names or b.name in names else b for b in case.site.beacons)
        return declared(case, replace(case.site, beacons=beacons))

    return changed


def of_imu(change: Callable[[Case, Array, Array, Array], tuple[Array, Array, Array]]) -> Change:
    """Return a mistake in stamps, rates and specific forces."""

    def changed(case: Case) -> Case:
        imu = ImuSamples(*change(case, case.imu.time, case.imu.gyro_body, case.imu.accel_body))
        return replace(case, log=replace(case.log, imu=imu))

    return changed


def of_waveform(change: Callable[[Case, Array, Array], tuple[Array, Array]]) -> Change:
    """Return a mistake in stamps and samples of the magnetometer."""

    def changed(case: Case) -> Case:
        wave = Waveform(*change(case, case.waveform.time, case.waveform.measured_sensor))
        return replace(case, log=replace(case.log, waveform=wave))

    return changed


def beacon_waveform(case: Case, name: str) -> Array:
    """Return the field that one beacon alone gives in the magnetometer, shape (n, 3) (T)."""
    site = case.truth.true_site
    index = [beacon.name for beacon in site.beacons].index(name)
    first = sum(len(beacon.tones) for beacon in site.beacons[:index])
    tones = len(site.beacons[index].tones)
    drives = replace(
        case.truth.drives,
        phase=case.truth.drives.phase[first : first + tones],
        drift=case.truth.drives.drift[index : index + 1],
    )
    alone = replace(site, beacons=(site.beacons[index],), earth_field_world=None)
    alone = with_magnetometer(alone, noise_density=0.0, offset=np.zeros(3))
    wave = simulate_waveform(
        case.truth.motion,
        alone,
        drives,
        case.config.magnetometer_rate_hz,
        case.config.duration,
        np.random.default_rng(0),
    )
    return wave.measured_sensor
