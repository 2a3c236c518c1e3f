"""Hundreds of beacons in a building: only detected ones are used, and frequencies are reused.

1. Of 200 beacons in a building of 100 by 60 m, on forty frequencies, a walk in one wing receives
   some. Does it err as with those alone, and what does it cost compared with them?  Both are
   smoothed, and both are navigated as they come; a beacon is detected if it is above the noise of a
   window anywhere on the true path.
2. Tones 0.5 Hz apart need windows of four seconds to be separated, in which a platform passes a
   beacon; short ones fit them together.  Do 60 beacons so close err more than the same 60 with
   5 Hz between them (``--spacing``)?

``--minutes`` sets the length of the walk::

    python scenarios/many_beacons.py --minutes 20
    python scenarios/many_beacons.py --minutes 2 --spacing

All coils are dipoles whose survey is exact, and no error of their fields is constant in place: to
estimate the survey of so many beacons in one log takes memory that grows with their square.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from harness import conclude, rms, scenario_parser
from scipy.spatial.transform import Rotation

from magfusion.estimation.batch.batch import smooth
from magfusion.estimation.online.navigator import Navigator
from magfusion.estimation.online.navigator_settings import NavigatorSettings
from magfusion.model.detection_range import largest_fields, phasor_sigma
from magfusion.model.samples import Log
from magfusion.model.site import Beacon, BeaconSigma, Coil, Site
from magfusion.receiver.windows import default_settings
from magfusion.simulation.demo_site import demo_site
from magfusion.simulation.log import SimulationConfig, simulate_log
from magfusion.units import Array

BUILDING = (100.0, 60.0)  # m
HEIGHTS = (0.2, 2.8)  # m
WING_WORLD = np.array([[20.0, 15.0, 0.8], [80.0, 45.0, 1.6]])  # m
MOMENT = 10.0  # A m^2
CELL = (8, 5)  # beacons along and across, after which the frequencies come again
MAINS_HZ = 50.0
PIECE = 0.1  # s; that a stream brings at once
CONVERGED_STEP = 10.0  # s; after which states of an estimator that runs are compared


@dataclass(frozen=True)
class Run:
    """What came of one site.

    Parameters
    ----------
    beacons, detected : int
        Declared, and above the noise somewhere on the way.
    rms_m, online_rms_m : float
        Of the position, smoothed and as it came.
    nees : float
        Mean of the smoothed position's; three are expected.
    processor_s, online_processor_s : float
        Of the whole run.
    """

    beacons: int
    detected: int
    rms_m: float
    online_rms_m: float
    nees: float
    processor_s: float
    online_processor_s: float


def building(
    rng: np.random.Generator, along: int, across: int, frequency_hz: Callable[[int, int], float]
) -> Site:
    """Return a building full of rotating beacons, in rows and columns, each a little out of them.

    Parameters
    ----------
    frequency_hz : callable
        Of the column and the row.
    """
    width, depth = BUILDING
    exact = BeaconSigma(np.zeros(3), np.zeros(3), np.zeros(2))
    beacons = []
    for i, j in np.ndindex(along, across):
        place = np.array([(i + 0.5) * width / along, (j + 0.5) * depth / across, 0.0])
        place += [*rng.uniform(-1.0, 1.0, 2), rng.uniform(*HEIGHTS)]
        coils = (
            Coil(np.array([MOMENT, 0.0, 0.0]), phase=0.0),
            Coil(np.array([0.0, MOMENT, 0.0]), phase=-np.pi / 2.0),
        )
        beacons.append(
            Beacon(
                name=f"B{i:02d}{j:02d}",
                position_world=place,
                world_from_beacon=Rotation.random(random_state=rng).as_matrix(),
                frequency_hz=frequency_hz(i, j),
                coils=coils,
                synchronised=True,
                sigma=exact,
            )
        )
    return replace(demo_site(), beacons=tuple(beacons), model_error_length=0.0)


def reused_hz(i: int, j: int) -> float:
    """Return a frequency of forty, 5 Hz apart and none of the mains'; the same in every cell."""
    usable = [f for f in np.arange(20.0, 300.0, 5.0).tolist() if f % MAINS_HZ]
    number = (i % CELL[0]) * CELL[1] + j % CELL[1]
    return float(usable[17 * number % 40])


def spaced_hz(spacing: float) -> Callable[[int, int], float]:
    """Return frequencies so far apart (Hz), neighbours in the building far from each other."""

    def frequency(i: int, j: int) -> float:
        usable = np.arange(60.0, 1000.0, spacing)
        clear = np.abs(usable - MAINS_HZ * np.round(usable / MAINS_HZ)) >= 0.9 * spacing
        return float(usable[clear][(23 * (6 * i + j)) % 60])

    return frequency


def detected_alone(site: Site, log: Log) -> Site:
    """Return the beacons that are above the noise somewhere on the true path."""
    assert log.truth is not None
    largest = np.max(largest_fields(site, log.truth.position_world[::20]), axis=0)
    sigma = phasor_sigma(site, default_settings(site).window)
    kept = tuple(b for b, field in zip(site.beacons, largest, strict=True) if field > sigma)
    return replace(site, beacons=kept)


def walked(site: Site, minutes: float, box_world: Array, rate_hz: float, seed: int) -> Log:
    """Return the log of a walk, the same for every site."""
    config = SimulationConfig(
        box_world=box_world,
        duration=60.0 * minutes,
        speed=1.0,
        imu_rate_hz=100.0,
        magnetometer_rate_hz=rate_hz,
        perturb=False,
    )
    return simulate_log(site, config, np.random.default_rng(seed)).log


def tried(site: Site, log: Log) -> Run:
    """Return what smoothing and navigating a log come to."""
    began = time.process_time()
    result = smooth(log, site)
    smoothed = time.process_time() - began
    error = _errors(log, result.states.time, result.states.position_world)
    assert result.states.pose_cov is not None
    body = np.einsum("nji,nj->ni", result.states.world_from_body, error)
    nees = np.einsum(
        "ni,ni->n",
        body,
        np.linalg.solve(result.states.pose_cov[:, 3:, 3:], body[..., None])[..., 0],
    )
    began = time.process_time()
    at, place = _navigated(site, log)
    online = time.process_time() - began
    late = at > (at[0] if len(at) else 0.0) + CONVERGED_STEP
    return Run(
        beacons=len(site.beacons),
        detected=len(detected_alone(site, log).beacons),
        rms_m=rms(np.linalg.norm(error, axis=1)),
        online_rms_m=rms(np.linalg.norm(_errors(log, at[late], place[late]), axis=1)),
        nees=float(np.mean(nees)),
        processor_s=smoothed,
        online_processor_s=online,
    )


def _navigated(site: Site, log: Log) -> tuple[Array, Array]:
    navigator, imu, wave = Navigator(site, NavigatorSettings()), log.imu, log.waveform
    assert wave is not None
    built = []
    for begin in np.arange(0.0, imu.time[-1], PIECE):
        a, b = np.searchsorted(imu.time, [begin, begin + PIECE])
        navigator.add_imu(imu.time[a:b], imu.gyro_body[a:b], imu.accel_body[a:b])
        a, b = np.searchsorted(wave.time, [begin, begin + PIECE])
        navigator.add_magnetometer(wave.time[a:b], wave.measured_sensor[a:b])
        built += navigator.take()
    time = np.array([state.time for state in built])
    return time, np.array([state.position_world for state in built]).reshape(-1, 3)


def _errors(log: Log, at: Array, position_world: Array) -> Array:
    truth = log.truth
    assert truth is not None
    true = [np.interp(at, truth.time, axis) for axis in truth.position_world.T]
    return position_world - np.stack(true, axis=1)


def compared_detection(minutes: float, seed: int) -> dict[str, Run]:
    """Return the result with 200 beacons, and with only the detected ones."""
    whole = building(np.random.default_rng(seed), 20, 10, reused_hz)
    log = walked(whole, minutes, WING_WORLD, 600.0, seed + 1)
    alone = detected_alone(whole, log)
    return {
        "detected only": tried(alone, walked(alone, minutes, WING_WORLD, 600.0, seed + 1)),
        "all": tried(whole, log),
    }


def compared_spacing(minutes: float, seed: int) -> dict[str, Run]:
    """Return what 60 beacons come to at either spacing."""
    out = {}
    for spacing in (5.0, 0.5):
        site = building(np.random.default_rng(seed), 10, 6, spaced_hz(spacing))
        out[f"{spacing:g} Hz"] = tried(site, walked(site, minutes, WING_WORLD, 1200.0, seed + 1))
    return out


def ratios(result: dict[str, Run]) -> dict[str, float]:
    """Return the second case's errors and processor times over the first's."""
    first, last = (vars(run) for run in result.values())
    names = ("rms_m", "online_rms_m", "processor_s", "online_processor_s")
    return {name: last[name] / first[name] for name in names}


def report(result: dict[str, Run]) -> str:
    """Return the table that a reader sees."""
    lines = [
        f"  {'':14}{'beacons':>9}{'heard':>7}{'smooth':>11}{'NEES (3)':>10}{'processor':>11}"
        f"{'navigate':>11}{'processor':>11}"
    ]
    for name, run in result.items():
        lines.append(
            f"  {name:14}{run.beacons:9}{run.detected:7}{1e3 * run.rms_m:8.2f} mm{run.nees:10.2f}"
            f"{run.processor_s:9.0f} s{1e3 * run.online_rms_m:8.2f} mm"
            f"{run.online_processor_s:9.0f} s"
        )
    ratio = ratios(result)
    lines.append(
        f"  {'ratio':14}{'':16}{ratio['rms_m']:11.3f}{'':10}{ratio['processor_s']:11.2f}"
        f"{ratio['online_rms_m']:11.3f}{ratio['online_processor_s']:11.2f}"
    )
    return "\n".join(lines)


def main() -> None:
    """Print the table and one JSON line."""
    parser = scenario_parser(__doc__, 1, "a walk of half a minute", output=None)
    parser.add_argument("--minutes", type=float, default=20.0, help="length of the walk")
    parser.add_argument("--spacing", action="store_true", help="60 beacons, 0.5 or 5 Hz apart")
    given = parser.parse_args()
    minutes = 0.5 if given.quick else given.minutes
    result = (compared_spacing if given.spacing else compared_detection)(minutes, given.seed)
    conclude(report(result), {"cases": list(result.values()), "ratios": ratios(result)})


if __name__ == "__main__":
    main()
