"""Mistakes in the site's file: the world is as it is, and declared otherwise."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from mistake_case import (
    Case,
    Change,
    Mistake,
    declared,
    of_beacons,
    with_imu,
    with_magnetometer,
    with_sigma,
)
from scipy.spatial.transform import Rotation

from magfusion.model.site import Beacon, BeaconSigma, Coil, Site
from magfusion.units import DEGREE, Array

REST = ("rest",)  # where what needs motion leaves no trace


def _coils(change: Callable[[Coil], Coil], *which: int) -> Callable[[Beacon], Beacon]:
    def changed(beacon: Beacon) -> Beacon:
        coils = tuple(
            change(coil) if not which or i in which else coil for i, coil in enumerate(beacon.coils)
        )
        return replace(beacon, coils=coils)

    return changed


def _moments(factor: float, *which: int) -> Callable[[Beacon], Beacon]:
    return _coils(lambda coil: replace(coil, moment_beacon=factor * coil.moment_beacon), *which)


def _phases(change: Callable[[float], float]) -> Callable[[Beacon], Beacon]:
    return _coils(lambda coil: replace(coil, phase=change(coil.phase)))


def _axes_swapped(beacon: Beacon) -> Beacon:
    first, second = beacon.coils
    moments = second.moment_beacon, first.moment_beacon
    coils = tuple(
        replace(coil, moment_beacon=moment)
        for coil, moment in zip(beacon.coils, moments, strict=True)
    )
    return replace(beacon, coils=coils)


def _rotated(rotvec_deg: tuple[float, float, float]) -> Callable[[Beacon], Beacon]:
    turn = Rotation.from_rotvec(rotvec_deg, degrees=True).as_matrix()
    return lambda b: replace(b, world_from_beacon=b.world_from_beacon @ turn)


def _moved(step: tuple[float, float, float]) -> Callable[[Beacon], Beacon]:
    return lambda b: replace(b, position_world=b.position_world + np.array(step))


def _placed(change: Callable[[Array], Array]) -> Callable[[Beacon], Beacon]:
    return lambda b: replace(b, position_world=change(b.position_world))


def _angles(change: Callable[[Array], Array]) -> Callable[[Beacon], Beacon]:
    """Return a mistake in the roll, pitch and yaw (degrees) of a beacon."""

    def changed(beacon: Beacon) -> Beacon:
        rpy = Rotation.from_matrix(beacon.world_from_beacon).as_euler("xyz", degrees=True)
        rotated = Rotation.from_euler("xyz", change(rpy), degrees=True).as_matrix()
        return replace(beacon, world_from_beacon=rotated)

    return changed


def _coil_advanced(beacon: Beacon) -> Beacon:
    first, second, *others = beacon.coils
    return replace(
        beacon, coils=(first, replace(second, phase=second.phase + 8.0 * DEGREE), *others)
    )


def _exchanged(*fields: str, count: int = 2) -> Change:
    """Return the mistake of taking the first beacons for each other, in turn, in some respects."""

    def changed(case: Case) -> Case:
        first, others = case.site.beacons[:count], case.site.beacons[count:]
        beacons = (
            replace(one, **{name: getattr(other, name) for name in fields})
            for one, other in zip(first, (*first[1:], first[0]), strict=True)
        )
        return declared(case, replace(case.site, beacons=(*beacons, *others)))

    return changed


def _site(change: Callable[[Site], Site]) -> Change:
    return lambda case: declared(case, change(case.site))


def _mounting(turn: Callable[[Array], Array]) -> Change:
    """Return a mistake in the declared mounting of the magnetometer."""

    def changed(site: Site) -> Site:
        was = site.platform.magnetometer.body_from_sensor
        return with_magnetometer(site, body_from_sensor=turn(was))

    return _site(changed)


def _mounted(rotvec_deg: tuple[float, float, float]) -> Change:
    turn = Rotation.from_rotvec(rotvec_deg, degrees=True).as_matrix()
    return _mounting(lambda was: was @ turn)


def _lever(change: Callable[[Array], Array]) -> Change:
    def changed(site: Site) -> Site:
        was = site.platform.magnetometer.position_body
        return with_magnetometer(site, position_body=change(was))

    return _site(changed)


def _inverse(beacon: Beacon) -> Beacon:
    return replace(beacon, world_from_beacon=beacon.world_from_beacon.T)


def _phase_late(beacon: Beacon) -> Beacon:
    return _phases(lambda phase: phase + 10.0 * DEGREE)(beacon)


def _densities(gyro: float, accel: float) -> Change:
    def changed(site: Site) -> Site:
        imu = site.platform.imu
        return with_imu(site, gyro_noise=gyro * imu.gyro_noise, accel_noise=accel * imu.accel_noise)

    return _site(changed)


def _field_noise(factor: float) -> Change:
    def changed(site: Site) -> Site:
        density = site.platform.magnetometer.noise_density
        return with_magnetometer(site, noise_density=factor * density)

    return _site(changed)


def _earth(change: Callable[[Array], Array]) -> Change:
    def changed(site: Site) -> Site:
        assert site.earth_field_world is not None
        return replace(site, earth_field_world=change(site.earth_field_world))

    return _site(changed)


def _other_room(case: Case) -> Case:
    """Return the site of a room with the same beacons elsewhere."""
    rng = case.rng
    beacons = tuple(
        replace(
            beacon,
            position_world=rng.uniform([-1.0, -1.0, 0.0], [8.0, 7.0, 3.0]),
            world_from_beacon=Rotation.random(rng=rng).as_matrix(),
        )
        for beacon in case.site.beacons
    )
    return declared(case, replace(case.site, beacons=beacons))


def _overconfident(case: Case) -> Case:
    """Return beacons declared to 1 cm that are 5 cm off."""
    rng = case.rng
    beacons = []
    for beacon in case.site.beacons:
        wrong = beacon.position_world + rng.normal(0.0, 0.05, 3)
        certain = with_sigma(beacon, position=0.01, rotation=0.4 * DEGREE, log_moment=0.006)
        beacons.append(replace(certain, position_world=wrong))
    return declared(case, replace(case.site, beacons=tuple(beacons)))


def _one_too_many(case: Case) -> Case:
    """Return a site with a fifth beacon that was never switched on."""
    known = case.site.beacons[0]
    sigma = BeaconSigma(
        known.sigma.position_world, known.sigma.rotation_beacon, known.sigma.log_moment
    )
    extra = replace(
        known, name="E", frequency_hz=40.0, position_world=np.array([3.0, 2.5, 2.6]), sigma=sigma
    )
    return declared(case, replace(case.site, beacons=(*case.site.beacons, extra)))


def _fewer(count: int) -> Change:
    return _site(lambda site: replace(site, beacons=site.beacons[:count]))


def _frequency(to_hz: float) -> Change:
    return of_beacons(lambda b: replace(b, frequency_hz=to_hz), "B")


def _mirrored(site: Site) -> Site:
    """Return a survey in axes of which y points the other way."""
    flip = np.diag([1.0, -1.0, 1.0])
    beacons = tuple(replace(b, position_world=flip @ b.position_world) for b in site.beacons)
    return replace(site, beacons=beacons)


_SIGN = ("phase_sign", "coil_reversed", "coils_swapped")
_PLACE = ("beacon_pose",)
_EARTH = ("earth_field",)

MISTAKES = (
    Mistake("phase_sign", "site", of_beacons(_phases(lambda p: -p)), _SIGN),
    Mistake("phase_sign_one", "site", of_beacons(_phases(lambda p: -p), "B"), _SIGN),
    Mistake(
        "phase_rad_for_deg",
        "site",
        of_beacons(_phases(lambda p: p * DEGREE)),
        ("phase_units", "phase", "phase_sign"),
    ),
    Mistake("coil_phase_8deg", "site", of_beacons(_coil_advanced, "B"), ("phase",)),
    Mistake("phase_10deg_one", "site", of_beacons(_phase_late, "C"), ("phase", "beacon_pose")),
    Mistake("coil_reversed", "site", of_beacons(_moments(-1.0, 0), "C"), _SIGN),
    Mistake("beacon_reversed", "site", of_beacons(_moments(-1.0), "D"), (*_SIGN, "beacon_pose")),
    Mistake("coils_swapped", "site", of_beacons(_axes_swapped, "A"), _SIGN),
    Mistake("coils_swapped_all", "site", of_beacons(_axes_swapped), _SIGN),
    Mistake(
        "beacons_swapped",
        "site",
        _exchanged("position_world", "world_from_beacon"),
        ("beacons_swapped",),
    ),
    Mistake("positions_swapped", "site", _exchanged("position_world"), ("beacons_swapped",)),
    Mistake(
        "frequencies_permuted", "site", _exchanged("frequency_hz", count=3), ("beacons_swapped",)
    ),
    Mistake("frequencies_swapped", "site", _exchanged("frequency_hz"), ("beacons_swapped",)),
    Mistake(
        "frequency_off",
        "site",
        _frequency(25.5),
        ("undeclared_line", "silent_beacon", "beacon_clock"),
    ),
    Mistake("frequency_10mhz", "site", _frequency(25.01), ("beacon_clock", "sample_rate")),
    Mistake("moments_rms", "site", of_beacons(_moments(np.sqrt(0.5))), ("moment_units",)),
    Mistake("moments_peak_to_peak", "site", of_beacons(_moments(2.0)), ("moment_units",)),
    Mistake("moments_one_turn", "site", of_beacons(_moments(0.01)), ("moment_units",)),
    Mistake("moments_A_3pct", "site", of_beacons(_moments(1.03), "A"), ("moments",)),
    Mistake("moments_A_ten_times", "site", of_beacons(_moments(10.0), "A"), ("moments",)),
    Mistake("moments_A_20pct", "site", of_beacons(_moments(1.2), "A"), ("moments",)),
    Mistake("one_coil_10pct", "site", of_beacons(_moments(1.1, 1), "D"), ("moments",)),
    Mistake("moved_5cm", "site", of_beacons(_moved((0.03, -0.04, 0.0)), "A"), _PLACE),
    Mistake(
        "position_sign",
        "site",
        of_beacons(_placed(lambda p: p * np.array([-1.0, 1.0, 1.0])), "C"),
        _PLACE,
    ),
    Mistake("moved_50cm", "site", of_beacons(_moved((0.3, 0.4, 0.0)), "C"), _PLACE),
    Mistake("beacon_turned_10deg", "site", of_beacons(_rotated((6.0, 6.0, 5.0)), "B"), _PLACE),
    Mistake("beacon_turned_90deg", "site", of_beacons(_rotated((90.0, 0.0, 0.0)), "D"), _PLACE),
    Mistake("beacon_inverse", "site", of_beacons(_inverse), ("angle_convention",)),
    Mistake(
        "beacon_rpy_radians",
        "site",
        of_beacons(_angles(lambda rpy: rpy * DEGREE)),
        ("angle_units",),
    ),
    Mistake("survey_mirrored", "site", _site(_mirrored), ("survey_axes",)),
    Mistake(
        "survey_xy_swapped", "site", of_beacons(_placed(lambda p: p[[1, 0, 2]])), ("survey_axes",)
    ),
    Mistake("survey_in_feet", "site", of_beacons(_placed(lambda p: p / 0.3048)), ("length_units",)),
    Mistake("survey_in_cm", "site", of_beacons(_placed(lambda p: 100.0 * p)), ("length_units",)),
    Mistake(
        "survey_overconfident",
        "site",
        _overconfident,
        ("survey_overconfident", "prior", "beacon_pose", "separation"),
    ),
    Mistake("other_room", "site", _other_room, ("other_site", "diverged")),
    Mistake(
        "mounting_2deg", "site", _mounted((1.2, 1.2, 1.1)), ("mounting",), REST, "sensor.rotation"
    ),
    Mistake("mounting_10deg", "site", _mounted((6.0, 6.0, 5.3)), ("mounting",)),
    Mistake(
        "mounting_z90", "site", _mounted((0.0, 0.0, 90.0)), ("mounting",), REST, "sensor.rotation"
    ),
    Mistake("mounting_x180", "site", _mounted((180.0, 0.0, 0.0)), ("mounting",)),
    Mistake("mounting_y-90", "site", _mounted((0.0, -90.0, 0.0)), ("mounting",)),
    Mistake(
        "mounting_inverse", "site", _mounting(lambda m: m.T), ("mounting",), REST, "sensor.rotation"
    ),
    Mistake(
        "mounting_forgotten",
        "site",
        _mounting(lambda _: np.eye(3)),
        ("mounting",),
        REST,
        "sensor.rotation",
    ),
    Mistake(
        "lever_3cm",
        "site",
        _lever(lambda p: p + np.array([0.03, 0.0, 0.0])),
        ("lever_arm",),
        REST,
        "sensor.position",
    ),
    Mistake(
        "lever_20cm",
        "site",
        _lever(lambda p: p + np.array([0.12, -0.16, 0.0])),
        ("lever_arm",),
        REST,
        "sensor.position",
    ),
    Mistake("lever_sign", "site", _lever(lambda p: -p), ("lever_arm",), REST, "sensor.position"),
    Mistake(
        "lever_in_cm",
        "site",
        _lever(lambda p: 100.0 * p),
        ("lever_arm", "length_units"),
        REST,
        "sensor.position",
    ),
    Mistake(
        "gravity_off_1pct",
        "site",
        _site(lambda s: replace(s, gravity=9.71)),
        ("gravity", "accel_scale"),
    ),
    Mistake(
        "matrix_scale_5pct",
        "site",
        _site(lambda s: with_magnetometer(s, matrix=1.05 * np.eye(3))),
        ("magnetometer_matrix", "field_scale", "moment_units"),
    ),
    Mistake(
        "earth_declination",
        "site",
        _earth(lambda e: Rotation.from_rotvec([0, 0, 45], degrees=True).apply(e)),
        _EARTH,
    ),
    Mistake("earth_hemisphere", "site", _earth(lambda e: e * [1.0, 1.0, -1.0]), _EARTH),
    Mistake("earth_in_gauss", "site", _earth(lambda e: 1e4 * e), _EARTH),
    Mistake("two_undeclared", "site", _fewer(2), ("undeclared_line", "fitted_line")),
    Mistake("one_never_on", "site", _one_too_many, ("silent_beacon",)),
    Mistake("imu_noise_10x_less", "site", _densities(0.1, 0.1), ("imu_noise", "noise_tuned")),
    Mistake("imu_noise_10x_more", "site", _densities(10.0, 10.0), ("noise_tuned",)),
    Mistake("field_noise_10x_less", "site", _field_noise(0.1), ("noise_tuned",)),
    Mistake("field_noise_10x_more", "site", _field_noise(10.0), ("noise_tuned",)),
    Mistake(
        "model_error_20pct",
        "site",
        _site(lambda s: replace(s, model_error=0.2)),
        ("noise_tuned",),
    ),
)
