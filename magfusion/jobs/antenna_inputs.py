"""Inputs of the antenna calibration: a tracker, poses with couplings, probe readings."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.calibration.antenna_site import BodySurvey
from magfusion.errors import EstimationError, InputError
from magfusion.files.probe import Side, read_probe
from magfusion.files.survey import Survey
from magfusion.model.antenna import CENTRES, KAPPAS, MOMENTS, SENSITIVITIES, SENSOR_CENTRES, Antenna
from magfusion.model.probe import ProbeReadings
from magfusion.model.site import Beacon, Site
from magfusion.papers.p000_tracker.equations import eq_09_whitened
from magfusion.papers.p000_tracker.pose import locate_by_svd
from magfusion.units import IntArray

MIN_POSES = 5  # four determine the antenna; with less than one to spare nothing is tested


def tracker(site: Site, name: str | None) -> Beacon:
    """Return the site's beacon that is a tracker's source.

    Raises InputError where there is none, or more than one.
    """
    names = ", ".join(b.name for b in site.beacons)
    trackers = [b for b in site.beacons if len(b.coils) == 3 and len(b.tones) == 3]
    if name is not None:
        result = [b for b in site.beacons if b.name == name]
        if not result:
            raise InputError(f"has no beacon {name} (it has {names}); choose one with --beacon")
    else:
        result = trackers
    if len(result) != 1:
        what = "no beacon" if not result else f"{len(result)} beacons"
        raise InputError(
            f"has {what} of three coils, each in a separate tone or slot; describe the tracker, or"
            " choose one with --beacon"
        )
    if not result[0].synchronised:
        raise InputError(
            f"beacon {result[0].name} is not synchronised: the sign of its couplings is unknown;"
            " survey it with synchronised: true"
        )
    if result[0].field_map is not None or result[0].steel is not None:
        raise InputError(
            f"beacon {result[0].name} has a map of its field or of steel with the old antennas;"
            " omit world.field_map and world.steel, calibrate the antennas, then map again"
        )
    return result[0]


def couplings(survey: Survey, beacon: Beacon) -> tuple[BodySurvey, int]:
    """Return a survey's couplings at poses of the body, and how many poses lack one.

    Raises InputError where it has no phasors of the tracker, or too few poses with all of them.
    """
    if survey.phasor_sensor is None:
        raise InputError("contains amplitudes, but antennas require phasors; survey again")
    wanted = [(beacon.name, tone) for tone in range(3)]
    missing = [str(tone) for name, tone in wanted if (name, tone) not in survey.channels]
    if missing:
        raise InputError(
            f"has no tone {', '.join(missing)} of beacon {beacon.name}; a tracker's survey contains"
            " the tones or slots 0, 1 and 2"
        )
    columns = [survey.channels.index(channel) for channel in wanted]
    phasor, sigma = survey.phasor_sensor[:, columns], survey.sigma[:, columns]
    whole = np.isfinite(phasor).all(axis=(1, 2))
    if np.sum(whole) < MIN_POSES:
        raise InputError(
            f"has {np.sum(whole)} poses with all three tones of beacon {beacon.name}; survey at"
            f" least {MIN_POSES}, at different positions and attitudes"
        )
    # Tones are in the order of the coils, one each.
    declared = np.array([coil.phase for coil in beacon.coils])
    real = (phasor[whole] * np.exp(-1j * declared)[:, None]).real
    return (
        BodySurvey(
            survey.world_from_body[whole],
            survey.position_world[whole],
            np.swapaxes(real, 1, 2),
            np.sqrt(np.mean(sigma[whole] ** 2, axis=1)),
        ),
        int(np.sum(~whole)),
    )


def refuse_swapped(survey: BodySurvey, antenna: Antenna) -> None:
    """Raise an error for couplings that match no pose of the declared antenna."""
    receiver = np.asarray(np.linalg.inv(antenna.sensitivities_sensor))
    try:
        locate_by_svd(eq_09_whitened(survey.coupling, receiver, antenna.moments_beacon.T))
    except EstimationError as error:
        raise InputError(f"{error}; correct the wiring or the site") from error


def mounted_by_fixes(survey: BodySurvey, site: Site, beacon: Beacon) -> Site:
    """Return the site with the magnetometer pose estimated from a tracker's fields.

    Its pose at each reading is the closed-form solution; on the body it is their mean.
    """
    sensor = site.platform.magnetometer
    receiver = np.asarray(np.linalg.inv(sensor.matrix))
    unit = eq_09_whitened(survey.coupling, receiver, beacon.moments_beacon.T)
    body_beacon = (survey.position_world - beacon.position_world) @ beacon.world_from_beacon
    fix = locate_by_svd(unit).nearest(body_beacon)
    back = np.swapaxes(survey.world_from_body, 1, 2)
    turn = back @ beacon.world_from_beacon @ np.swapaxes(fix.sensor_from_beacon, 1, 2)
    spot = beacon.position_world + fix.position_beacon[:, 0] @ beacon.world_from_beacon.T
    lever = np.einsum("nij,nj->ni", back, spot - survey.position_world)
    mounted = replace(
        sensor,
        body_from_sensor=Rotation.from_matrix(turn).mean().as_matrix(),
        position_body=np.median(lever, axis=0),
    )
    return replace(site, platform=replace(site.platform, magnetometer=mounted))


def probed(paths: tuple[Path, ...]) -> dict[Side, ProbeReadings]:
    """Return the readings of several files together."""
    result: dict[Side, ProbeReadings] = {}
    for path in paths:
        for side, readings in read_probe(path).items():
            before = result.get(side)
            parts = [readings] if before is None else [before, readings]
            columns = [[getattr(p, n) for p in parts] for n in readings.__dataclass_fields__]
            result[side] = ProbeReadings(*(np.concatenate(c) for c in columns))
    return result


def columns_of(side: Side, size: int) -> IntArray:
    """Return the columns of one antenna in `magfusion.model.antenna.Antenna.vector`."""
    if side == "transmitter":
        whole = np.r_[MOMENTS, CENTRES, KAPPAS.start : KAPPAS.stop - 1]
    else:
        whole = np.r_[SENSITIVITIES, SENSOR_CENTRES, KAPPAS.stop - 1]
    return whole[whole < size]
