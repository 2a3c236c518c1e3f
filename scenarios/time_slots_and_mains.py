"""Four slots and the mains: what paper 000's ambient removal leaves of 50 Hz, and what does better.

Paper 000 drives three coils in turn and subtracts the field of a fourth, silent slot (Eq 2-8).  The
scenario simulates the waveform of a tracker at rest, 0.5 m away, in a room with hum of 0.15 uT, and
demodulates it in every way that `magfusion.receiver` knows:

1. Subtracting makes hum worse, not better, for slots of 2 to 18 ms: with slots of 5 ms 50 Hz are
   6.0 dB larger in the worst slot, and the attitude is wrong by 14 degrees instead of 8.
2. Slots of 20 ms average the mains out, and are of no use to a head that turns.
3. A straight line between the silent slots helps where the cycle is short; an ambient state with
   the mains in it removes them wherever the cycle separates them from a drift.
4. A carrier of 10 kHz puts 45 dB between hum and tracker, with a tapered window 115 dB, for slots
   of any length; so do three carriers at once, through the ordinary lock-in.
5. Where there is no hum each way costs noise: least of all the state over many cycles.
6. The coils have 4 cm.  Taken for dipoles they turn the closed form by 0.24 degrees half a metre
   away, twice what noise of 60 dB does: their size is taken off the couplings before it.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from harness import blank_figure, conclude, save_picture, scenario_parser
from scipy.spatial.transform import Rotation
from tracker_poses import unit_coupling

from magfusion.model.coil_field import as_points
from magfusion.model.field import observe_from
from magfusion.model.samples import FieldSamples, ImuSamples, Waveform
from magfusion.model.site import (
    Beacon,
    BeaconSigma,
    Coil,
    ImuModel,
    Magnetometer,
    MagnetometerSigma,
    Platform,
    Site,
    Slots,
)
from magfusion.papers.p000_tracker.pose import TrackerFix, locate_by_svd
from magfusion.receiver.ambient import Removal, subtraction_gain
from magfusion.receiver.cycles import whole_cycles
from magfusion.receiver.receivers import received
from magfusion.receiver.slots import SlotSettings
from magfusion.receiver.windows import default_settings
from magfusion.simulation.field import phasors_world, synchronised_drives
from magfusion.simulation.motion import static_motion
from magfusion.simulation.waveform import Mains, simulate_waveform
from magfusion.units import DEGREE, MU0_OVER_4PI, Array, ComplexArray

DISTANCE = 0.5  # m
UNIT = MU0_OVER_4PI / DISTANCE**3  # T; K/R^3 of one A m^2
COIL_RADIUS = 0.02  # m
SIZE_ITERATIONS = 3  # each leaves a hundredth of what the one before did
SILENCE = 1e-16  # T/sqrt(Hz); of an instrument without noise
REMOVALS: tuple[Removal, ...] = ("none", "subtract", "interpolate", "state")
CARRIERS = (  # Hz, s, taper
    (1e3, 5e-3, "rectangular"),
    (1e4, 5e-3, "rectangular"),
    (1e4, 5e-3, "hann"),
    (1e3, 1e-3, "rectangular"),
    (1e4, 1e-3, "rectangular"),
    (1e4, 1e-3, "hann"),
)


@dataclass(frozen=True)
class Config:
    """Poses and the hum that they see.

    Parameters
    ----------
    runs : int
        Each with another pose, and another phase and direction of the hum.
    slots : tuple of float
        (s)
    mains_hz : tuple of float
    mains : float
        (T)
    pulsed_rate_hz, carrier_rate_hz : float
        Of the samples.
    """

    runs: int = 60
    slots: tuple[float, ...] = (0.5e-3, 1e-3, 5e-3, 10e-3, 20e-3)
    mains_hz: tuple[float, ...] = (50.0, 49.8)
    mains: float = 0.15e-6
    pulsed_rate_hz: float = 16e3
    carrier_rate_hz: float = 48e3
    cycles: int = 17
    seed: int = 0


@dataclass(frozen=True)
class Row:
    """Pulses of direct current: one slot length, one hum, one removal."""

    slot_ms: float
    mains_hz: float
    removal: str
    formula_db: tuple[float, ...] | None  # worst phase, slots 1 to 3; of none and subtract
    residual_db: float  # RMS relative to K/R^3
    attitude_deg: float  # RMS


@dataclass(frozen=True)
class CarrierRow:
    """A carrier, without the silent slot; ``slot_ms`` of frequency division is its window."""

    carrier_hz: float
    slot_ms: float
    taper: str
    residual_db: float
    attitude_deg: float


def tracker(
    frequency_hz: float, slots: Slots | None, density: float = SILENCE, phase: float = 0.0
) -> Site:
    """Return an ideal tracker of unit moments, in time slots or at frequencies 100 Hz apart."""
    coils = tuple(
        Coil(moment, phase, radius=COIL_RADIUS, slot=k)
        if slots is not None
        else Coil(moment, phase, frequency_hz=frequency_hz + 100.0 * k, radius=COIL_RADIUS)
        for k, moment in enumerate(np.eye(3))
    )
    known = BeaconSigma(np.zeros(3), np.zeros(3), np.zeros(3))
    beacon = Beacon("T", np.zeros(3), np.eye(3), frequency_hz, coils, True, known, slots=slots)
    zero = np.zeros(3)
    sensor = Magnetometer(
        zero, np.eye(3), density, np.eye(3), zero, MagnetometerSigma(np.zeros((3, 3)), *[zero] * 3)
    )
    imu = ImuModel(1e-4, 1e-3, 1e-6, 1e-5, 5e-3, 0.05, time_offset_sigma=0.0)
    return Site(9.81, 1e-6, (beacon,), Platform(imu, sensor))


@dataclass(frozen=True, eq=False)
class Room:
    """One pose at rest and one hum."""

    rotation: Rotation  # world from body, which is the sensor
    position: Array
    mains_direction: Array
    seed: int


def rooms(config: Config) -> Iterator[Room]:
    """Yield poses in all directions at one distance."""
    rng = np.random.default_rng(config.seed)
    for _ in range(config.runs):
        away = rng.standard_normal(3)
        yield Room(
            rotation=Rotation.random(rng=rng),
            position=DISTANCE * away / np.linalg.norm(away),
            mains_direction=rng.standard_normal(3),
            seed=int(rng.integers(1 << 31)),
        )


def recorded(
    site: Site, room: Room, rate_hz: float, duration: float, mains: Mains | None
) -> tuple[Waveform, ImuSamples]:
    """Return what a magnetometer and an ideal IMU record at rest."""
    motion = static_motion(room.position, room.rotation)
    rng = np.random.default_rng(room.seed)
    drives = synchronised_drives(site)
    waveform = simulate_waveform(motion, site, drives, rate_hz, duration, rng, mains)
    stamps = np.arange(int(np.ceil(duration * 1e3)) + 2) / 1e3
    force = motion.specific_force_body(stamps, site.gravity)
    return waveform, ImuSamples(stamps, np.zeros_like(force), force)


def located(site: Site, seen: ComplexArray, max_iterations: int = SIZE_ITERATIONS) -> TrackerFix:
    """Return the closed form for coils of their true size.

    It is one of dipoles: the model's difference between coils and dipoles, at the pose found, is
    taken off what was seen, and the pose found again.

    Parameters
    ----------
    site : Site
        With one beacon at the origin.
    seen : ndarray, shape (n, tones, 3)
        Phasors (T), sensor axes.
    max_iterations : int
        None for a closed form that takes the coils for dipoles.
    """
    beacon, sensor = site.beacons[0], site.platform.magnetometer
    point = as_points(beacon)
    fix = locate_by_svd(unit_coupling(beacon, seen, np.eye(3)))
    for _ in range(max_iterations):
        world_from_sensor = np.swapaxes(fix.sensor_from_beacon, -1, -2)
        at = fix.position_beacon[:, 0]  # coils and dipoles are alike on both sides
        sized, dipole = (observe_from(b, sensor, world_from_sensor, at)[0] for b in (beacon, point))
        fix = locate_by_svd(unit_coupling(beacon, seen - (sized - dipole), np.eye(3)))
    return fix


def true_phasors(site: Site, room: Room) -> ComplexArray:
    """Return what every tone makes at the sensor (tones, 3) (T), drives without phase."""
    field_world = phasors_world(site.beacons[0], room.position[None])[0]
    return np.asarray(field_world @ room.rotation.as_matrix())


def errors(
    site: Site, room: Room, true: ComplexArray, samples: FieldSamples, drive_phase: float = 0.0
) -> tuple[Array, Array]:
    """Return what is wrong with the field of every channel, relative to K/R^3, and the attitude.

    The former is the root of the mean square of what is in phase with the drive, epoch by epoch and
    channel by channel; the latter is of the closed form (deg).
    """
    wrong: ComplexArray = (samples.phasor_sensor - true) * np.exp(-1j * drive_phase)
    residual = np.linalg.norm(wrong.real, axis=-1) / UNIT
    result = located(site, samples.phasor_sensor).sensor_from_beacon
    turn = Rotation.from_matrix(result @ room.rotation.as_matrix())
    return residual, np.asarray(turn.magnitude() / DEGREE)


def rms(parts: list[Array]) -> float:
    """Return the root of the mean square of all parts together."""
    return float(np.sqrt(np.mean(np.concatenate([p.ravel() for p in parts]) ** 2)))


def decibel(ratio: float) -> float:
    """Return a ratio of fields in dB; nothing at all is -300."""
    return float(20.0 * np.log10(max(ratio, 1e-15)))


def _mains(config: Config, room: Room, frequency_hz: float) -> Mains:
    return Mains(config.mains, frequency_hz, (), room.mains_direction)


def pulsed(
    config: Config, duration: float, mains_hz: float | None, density: float = SILENCE
) -> dict[Removal, tuple[float, float]]:
    """Return residual and attitude error (deg) of each removal, RMS over all rooms."""
    site = tracker(0.0, Slots(duration, 4), density)
    result: dict[Removal, list[tuple[Array, Array]]] = {removal: [] for removal in REMOVALS}
    for room in rooms(config):
        mains = None if mains_hz is None else _mains(config, room, mains_hz)
        length = 4 * duration * config.cycles
        waveform, imu = recorded(site, room, config.pulsed_rate_hz, length, mains)
        true = true_phasors(site, room)
        for removal, parts in result.items():
            slots, _ = received(waveform, imu, site, SlotSettings(removal, "rectangular"))
            samples = whole_cycles(slots, imu, site)
            inner = slice(1, -1)  # the first cycle has no silent slot before it
            residual, attitude = errors(site, room, true, samples)
            parts.append((residual[inner], attitude[inner]))
    return {k: (rms([p[0] for p in v]), rms([p[1] for p in v])) for k, v in result.items()}


def pulsed_rows(config: Config) -> Iterator[Row]:
    """Yield the table of pulsed direct current."""
    for duration in config.slots:
        for mains_hz in config.mains_hz:
            for removal, (residual, attitude) in pulsed(config, duration, mains_hz).items():
                formula = None
                if removal == "none":
                    formula = (decibel(abs(np.sinc(mains_hz * duration))),) * 3
                if removal == "subtract":
                    gains = (subtraction_gain(mains_hz, duration, 3 - k) for k in range(3))
                    formula = tuple(decibel(gain) for gain in gains)
                yield Row(1e3 * duration, mains_hz, removal, formula, decibel(residual), attitude)


def carrier_row(config: Config, carrier_hz: float, duration: float, taper: str) -> CarrierRow:
    """Demodulate a carrier in slots, each rectangular or tapered, under hum of 50 Hz."""
    phase = -np.pi / 2.0  # sine currents, which begin and end a slot at zero
    site = tracker(carrier_hz, Slots(duration, 4), phase=phase)
    settings = SlotSettings("none", "hann" if taper == "hann" else "rectangular")
    parts = []
    # Hum that is a whole number of cycles has few phases: as many rooms as it takes.
    few = replace(config, cycles=3)
    for room in rooms(few):
        mains = _mains(config, room, 50.0)
        length = 4 * duration * few.cycles + 1e-3
        waveform, imu = recorded(site, room, config.carrier_rate_hz, length, mains)
        slots, _ = received(waveform, imu, site, settings)
        samples = whole_cycles(slots, imu, site)
        parts.append(errors(site, room, true_phasors(site, room), samples, phase))
    residual, attitude = rms([p[0] for p in parts]), rms([p[1] for p in parts])
    return CarrierRow(carrier_hz, 1e3 * duration, taper, decibel(residual), attitude)


def frequency_division(config: Config) -> CarrierRow:
    """Demodulate three carriers at once through the ordinary lock-in."""
    site = tracker(1e4, None)
    settings = default_settings(site)
    parts = []
    for room in rooms(config):
        mains = _mains(config, room, 50.0)
        waveform, imu = recorded(site, room, config.carrier_rate_hz, 3.0 * settings.window, mains)
        samples, _ = received(waveform, imu, site, settings)
        parts.append(errors(site, room, true_phasors(site, room), samples))
    residual, attitude = rms([p[0] for p in parts]), rms([p[1] for p in parts])
    return CarrierRow(1e4, 1e3 * settings.window, "three at once", decibel(residual), attitude)


def carrier_rows(config: Config) -> Iterator[CarrierRow]:
    """Yield the table of carriers."""
    for carrier_hz, duration, taper in CARRIERS:
        yield carrier_row(config, carrier_hz, duration, taper)
    yield frequency_division(config)


def noise_deg(config: Config, snr_db: float = 60.0, duration: float = 2.5e-3) -> dict[str, float]:
    """Return the attitude error (deg) of each removal in white noise and no hum."""
    sigma = 10.0 ** (-snr_db / 20.0) * UNIT  # of the mean over a slot
    result = pulsed(config, duration, None, sigma * np.sqrt(2.0 * duration))
    return {removal: attitude for removal, (_, attitude) in result.items()}


def taken_for_dipoles_deg(config: Config) -> dict[str, float]:
    """Return the attitude error (deg) without hum or noise: size neglected, and taken off."""
    site = tracker(0.0, Slots(5e-3, 4))
    every = list(rooms(config))
    turn = Rotation.concatenate([room.rotation for room in every])
    place = np.stack([room.position for room in every])
    seen = phasors_world(site.beacons[0], place) @ turn.as_matrix()
    result = {}
    for name, max_iterations in (("dipoles", 0), ("coils", SIZE_ITERATIONS)):
        wrong = Rotation.from_matrix(located(site, seen, max_iterations).sensor_from_beacon) * turn
        result[name] = rms([wrong.magnitude() / DEGREE])
    return result


def report(
    rows: list[Row], carriers: list[CarrierRow], noise: dict[str, float], size: dict[str, float]
) -> str:
    """Return the tables that a reader sees."""
    lines = [
        "pulsed direct current: RMS residual (dB re K/R^3), attitude RMS (deg)",
        f"{'slot':>7}{'mains':>7}" + "".join(f"{removal:>26}" for removal in REMOVALS),
    ]
    for key in dict.fromkeys((row.slot_ms, row.mains_hz) for row in rows):
        cells = ""
        for row in (r for r in rows if (r.slot_ms, r.mains_hz) == key):
            cells += f"{row.residual_db:9.1f}{row.attitude_deg:9.3f}{'':8}"
        lines.append(f"{key[0]:5g}ms{key[1]:7g}{cells}")
    lines.append("worst phase by the formula, slots 1/2/3, silent slot subtracted (dB):")
    for row in rows:
        if row.removal == "subtract" and row.formula_db is not None:
            slots = "/".join(f"{db:+.1f}" for db in row.formula_db)
            lines.append(f"{row.slot_ms:5g}ms{row.mains_hz:7g}  {slots}")
    lines.append("carriers, no silent slot, hum of 50 Hz: RMS residual (dB), attitude")
    for carrier in carriers:
        lines.append(
            f"{carrier.carrier_hz:7g} Hz{carrier.slot_ms:5g}ms {carrier.taper:>13}"
            f"{carrier.residual_db:9.1f}{'':9}{carrier.attitude_deg:9.5f} deg"
        )
    costs = ", ".join(f"{k} {v:.3f}" for k, v in noise.items())
    lines.append(f"price in noise of 60 dB, no hum, attitude RMS (deg): {costs}")
    lines.append(
        f"coils of {200.0 * COIL_RADIUS:g} cm, no hum, no noise: attitude wrong by"
        f" {size['dipoles']:.3f} deg taken for dipoles, {size['coils']:.1e} with their size"
    )
    return "\n".join(lines)


def draw(path: Path, config: Config, rows: list[Row]) -> None:
    """Write a PNG of the formula over the slot's length, and of the simulated attitude errors."""
    figure = blank_figure(9.0, 4.0)
    remaining, right = figure.subplots(1, 2)
    length = np.linspace(0.1e-3, 22e-3, 600)
    for k in range(3):
        gain = [decibel(subtraction_gain(50.0, tau, 3 - k)) for tau in length]
        remaining.plot(1e3 * length, np.maximum(gain, -40.0), label=f"slot {k + 1}, minus slot 4")
    none = [decibel(abs(np.sinc(50.0 * tau))) for tau in length]
    remaining.plot(1e3 * length, np.maximum(none, -40.0), "k--", label="nothing subtracted")
    remaining.set(xlabel="slot (ms)", ylabel="residual of 50 Hz, worst phase (dB)", ylim=(-40, 8))
    remaining.legend(fontsize="small")
    for removal in REMOVALS:
        own = [r for r in rows if r.removal == removal and r.mains_hz == config.mains_hz[-1]]
        error = [max(r.attitude_deg, 1e-4) for r in own]
        right.loglog([r.slot_ms for r in own], error, "o-", label=removal)
    right.set(xlabel="slot (ms)", ylabel="attitude RMS (deg)")
    right.set_title(f"hum of {1e6 * config.mains:g} uT at {config.mains_hz[-1]:g} Hz, 0.5 m")
    right.legend(fontsize="small")
    save_picture(figure, path)


def main() -> None:
    """Print the tables and one JSON line; draw them where a directory is given."""
    given = scenario_parser(__doc__, Config.seed, "a sixth of the poses").parse_args()
    config = Config(seed=given.seed, runs=10 if given.quick else Config.runs)
    rows, carriers = list(pulsed_rows(config)), list(carrier_rows(config))
    noise, size = noise_deg(config), taken_for_dipoles_deg(config)
    if given.output is not None:
        draw(given.output / "time_slots_and_mains.png", config, rows)
    figures = {"pulsed": rows, "carriers": carriers, "noise_deg": noise, "size_deg": size}
    conclude(report(rows, carriers, noise, size), figures)


if __name__ == "__main__":
    main()
