"""A site's file for people: every key with its unit and what to do about it."""

from collections.abc import Iterator
from dataclasses import dataclass

from magfusion.files.instruments import UNNAMED, ImuSheet, MagnetometerSheet
from magfusion.files.site_draft import BeaconDraft, Numbers, Place
from magfusion.units import STANDARD_GRAVITY

# What a survey by hand is worth, one sigma.
POSITION_SIGMA = 0.05  # m, with a tape
ROTATION_SIGMA = 2.0  # degrees, with a level and by eye
MOMENT_SIGMA = 0.05  # relative, from turns, current and size
MOUNTING_SIGMA, LEVER_SIGMA = 2.0, 0.01  # degrees, m
MODEL_ERROR = 0.005  # of a room without much steel
# What is taken where nothing is said.
GUESSED_MOMENT, GUESSED_MOMENT_SIGMA = 100.0, 1.0  # A m^2, a factor of e
COMMENT_AT = 46  # column
TO_DO = "TO DO"
_MISSING = {"pose": "position_m and rpy_deg", "position": "position_m", "attitude": "rpy_deg"}
_UNIT = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


@dataclass(frozen=True)
class SiteDraft:
    """All that a site's file is made of.

    `gravity`: (m/s^2); None takes the standard one. `position_m`, `rpy_deg`: of the magnetometer in
    body axes; None takes zero.
    """

    beacons: tuple[BeaconDraft, ...]
    imu: ImuSheet
    magnetometer: MagnetometerSheet
    place: Place | None = None
    gravity: float | None = None
    position_m: Numbers | None = None
    rpy_deg: Numbers | None = None


def site_text(draft: SiteDraft) -> str:
    """Return the YAML of a site, which `load_site` reads."""
    lines = [
        "# Site of magfusion: what is installed, and how well it is known.",
        "# SI units, or as in the key's name. Each sigma is one standard deviation: rather too",
        f"# large than too small. Assumed values are marked {TO_DO}.",
        "magfusion_site: 1",
        *_world(draft),
        "beacons:" if draft.beacons else "beacons: []",
        *(line for beacon in draft.beacons for line in _beacon(beacon)),
        *_platform(draft),
    ]
    return "\n".join(lines) + "\n"


def to_do(draft: SiteDraft) -> list[str]:
    """Return, in words, what was assumed."""
    shared: dict[str, list[str]] = {}
    for beacon in draft.beacons:
        shared.setdefault("; ".join(_assumed(beacon)), []).append(beacon.name)
    result = [
        f"beacon{'s' if len(names) > 1 else ''} {', '.join(names)}: {words}"
        for words, names in shared.items()
        if words
    ]
    if not draft.beacons:
        result.append("no beacon is described: only the attitude can be found, by smooth --earth")
    if draft.place is None:
        result.append("standard gravity, and no Earth field: --location gives both")
    for what, name in (("imu", draft.imu.name), ("magnetometer", draft.magnetometer.name)):
        if name == UNNAMED:
            result.append(f"{what}: figures of no particular instrument: --{what} takes a name")
    if draft.position_m is None:
        result.append("magnetometer: in the IMU's origin: --lever gives its position")
    if draft.rpy_deg is None:
        result.append("magnetometer: parallel to the IMU is assumed: --mounting gives its attitude")
    return result


def _assumed(beacon: BeaconDraft) -> list[str]:
    out = []
    if beacon.unknown is not None:
        missing = _MISSING[beacon.unknown]
        out.append(
            f"its {beacon.unknown} is unknown, as {missing} is not given: only smooth and calibrate"
            " log estimate it, with two known beacons"
        )
    if beacon.moment_a_m2 is None:
        out.append(f"moment_a_m2 is not given; {GUESSED_MOMENT:g} A m^2 is assumed")
    if beacon.axes is None:
        out.append("axes are not given; two coils, along x and y, are assumed")
    return out


def _line(key: str, comment: str, guessed: bool = False) -> str:
    words = f"{TO_DO}: {comment}" if guessed else comment
    return f"{key:<{COMMENT_AT - 1}} # {words}"


def _number(value: float) -> str:
    return repr(float(value))


def _list(values: Numbers) -> str:
    return f"[{', '.join(map(_number, values))}]"


def _world(draft: SiteDraft) -> Iterator[str]:
    gravity = STANDARD_GRAVITY if draft.gravity is None else draft.gravity
    declared = "m/s^2, normal gravity at the location" if draft.place else "m/s^2, standard"
    yield "world:"
    yield _line(f"  gravity_m_s2: {_number(gravity)}", declared, draft.place is None)
    yield _line(f"  model_error: {_number(MODEL_ERROR)}", "relative, of the beacons' fields: iron.")
    yield _line("", "0.005 in a wooden house, 0.02 and more among steel")
    place = draft.place
    if place is None:
        yield _line(
            "  # location: {latitude_deg: 47.37, ...}", "for heading by the Earth's field", True
        )
        return
    yield _line("  location:", "for the IGRF: the world is east, north, up")
    yield _line(f"    latitude_deg: {_number(place.latitude_deg)}", "north positive")
    yield _line(f"    longitude_deg: {_number(place.longitude_deg)}", "east positive")
    yield _line(f"    height_m: {_number(place.height_m)}", "above the ellipsoid")
    yield _line(f"    date: {place.date}", "of the recording")


def _name(text: str) -> str:
    return "'" + text.replace("'", "''") + "'"


def _beacon(beacon: BeaconDraft) -> Iterator[str]:
    assert beacon.frequency_hz is not None
    yield _line(f"  - name: {_name(beacon.name)}", "any; report and plots use it")
    if beacon.position_m is not None:
        yield _line(f"    position_m: {_list(beacon.position_m)}", "centre of its coils, world")
    if beacon.rpy_deg is not None:
        yield _line(f"    rpy_deg: {_list(beacon.rpy_deg)}", "roll, pitch, yaw of its axes:")
        yield _line("", "Rz(yaw) Ry(pitch) Rx(roll) = world_from_beacon")
    if beacon.unknown is not None:
        words = f"write {_MISSING[beacon.unknown]} in its place"
        yield _line(f"    unknown: {beacon.unknown}", words, True)
    first = beacon.frequency_hz[0]
    yield _line(f"    frequency_hz: {_number(first)}", "of the drive current")
    yield _line("    coils:", "peak turns x current x area, beacon axes;")
    yield _line("", "the current is cos(2 pi f t + phase_deg)")
    yield from _coils(beacon)
    known = str(bool(beacon.synchronised)).lower()
    yield _line(f"    synchronised: {known}", "true: its phase keeps to the log's clock;")
    yield _line("", "false: it is unknown, and drifts")
    yield from _beacon_sigma(beacon)


def _coils(beacon: BeaconDraft) -> Iterator[str]:
    assert beacon.frequency_hz is not None
    axes = beacon.axes or "xy"
    sizes = beacon.moment_a_m2 or (GUESSED_MOMENT,)
    for k, axis in enumerate(axes):
        size = sizes[k] if len(sizes) > 1 else sizes[0]
        moment = _list(tuple(size * part for part in _UNIT[axis]))
        phase = -90.0 if k == 1 and len(beacon.frequency_hz) == 1 else 0.0
        extra = "" if beacon.radius_m is None else f", radius_m: {_number(beacon.radius_m)}"
        if len(beacon.frequency_hz) > 1:
            extra += f", frequency_hz: {_number(beacon.frequency_hz[k])}"
        yield f"      - {{moment_a_m2: {moment}, phase_deg: {_number(phase)}{extra}}}"
    if beacon.moment_a_m2 is None or beacon.axes is None:
        yield _line("", "moments, and which coils there are", True)


def _beacon_sigma(beacon: BeaconDraft) -> Iterator[str]:
    moment = GUESSED_MOMENT_SIGMA if beacon.moment_a_m2 is None else MOMENT_SIGMA
    yield _line("    sigma:", "how well that is known, one sigma")
    yield _line(f"      position_m: {_number(POSITION_SIGMA)}", "m, with a tape")
    yield _line(f"      rotation_deg: {_number(ROTATION_SIGMA)}", "degrees, with a level, by eye")
    yield _line(f"      log_moment: {_number(moment)}", "relative: turns, current and size")


def _platform(draft: SiteDraft) -> Iterator[str]:
    imu, sheet = draft.imu.model, draft.magnetometer
    yield "platform:"
    unnamed = "name yours by --imu, or write its noise"
    if draft.imu.name == UNNAMED:
        yield _line("  imu:", unnamed, True)
    else:
        yield _line("  imu:", "its axes and origin are the body's")
    yield f"    # {_origin(draft.imu)}"
    yield "    # More where the platform shakes; measure yours at rest by magfusion allan LOG."
    gyro, accel = (
        "the sheet's stability in run" if declared else "by a rule: the sheet has none"
        for declared in draft.imu.turns
    )
    for key, value, words in (
        ("gyro_noise", imu.gyro_noise, "rad/s/sqrt(Hz), white noise"),
        ("accel_noise", imu.accel_noise, "m/s^2/sqrt(Hz), white noise"),
        ("gyro_bias_walk", imu.gyro_bias_walk, f"rad/s/sqrt(s), {gyro}"),
        ("accel_bias_walk", imu.accel_bias_walk, f"m/s^2/sqrt(s), {accel}"),
        ("gyro_bias_sigma", imu.gyro_bias_sigma, "rad/s, when switched on"),
        ("accel_bias_sigma", imu.accel_bias_sigma, "m/s^2, when switched on"),
    ):
        yield _line(f"    {key}: {_number(value)}", words)
    yield _line("    time_offset_sigma_s: 0.01", "s, of its clock against the magnetometer's")
    if sheet.name == UNNAMED:
        yield _line("  magnetometer:", "name yours by --magnetometer, or write its noise", True)
    else:
        yield "  magnetometer:"
    yield f"    # Typical figures of {sheet.name}: {sheet.source}."
    yield from _mounting(draft)
    density = _number(sheet.noise_density)
    yield _line(f"    noise_density_t_rthz: {density}", "T/sqrt(Hz), one-sided, at the tones")
    yield _line("    sigma:", "magfusion calibrate magnetometer finds these")
    yield _line(f"      matrix: {_number(sheet.scale)}", "relative: gains, axes, iron on the body")
    yield _line(f"      offset_t: {_number(sheet.offset)}", "T, of the sensor and of magnets on it")
    yield _line(f"      rotation_deg: {_number(MOUNTING_SIGMA)}", "degrees, against the IMU")
    yield _line(f"      position_m: {_number(LEVER_SIGMA)}", "m")


def _mounting(draft: SiteDraft) -> Iterator[str]:
    zero = (0.0, 0.0, 0.0)
    lever, rotated = draft.position_m, draft.rpy_deg
    yield "    body_from_sensor:"
    position = _list(zero if lever is None else lever)
    yield _line(f"      position_m: {position}", "m, from the IMU, in its axes", lever is None)
    rotation = _list(zero if rotated is None else rotated)
    yield _line(
        f"      rpy_deg: {rotation}", "its axes in the IMU's, as of a beacon", rotated is None
    )


def _origin(sheet: ImuSheet) -> str:
    compared = f"; {' and '.join(sheet.checked)} noise compared with it" if sheet.checked else ""
    return f"Typical figures of {sheet.name}: {sheet.source}{compared}."
