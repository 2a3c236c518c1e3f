"""Antennas declared by a site: predicted with the site's model, and written into it.

A site's coils are loops or current sheets, of which `magfusion.model.antenna` has the first term.
The site's own model is fitted and assessed here, so that the written model is the fitted one.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.calibration.antenna import AntennaFit, AntennaSurvey, Observe
from magfusion.model.antenna import (
    SENSITIVITIES,
    SENSOR_CENTRES,
    Antenna,
    Coupling,
    observe_antenna,
)
from magfusion.model.field import predict
from magfusion.model.physics.finite_size import coil_shape
from magfusion.model.site import Beacon, Coil, Magnetometer, Site
from magfusion.units import Array

MIN_KAPPA = 1e-9  # m^2; of coils of a tenth of a millimetre, which are points


@dataclass(frozen=True, eq=False)
class BodySurvey:
    """Couplings at known poses of the body."""

    world_from_body: Array  # (n, 3, 3)
    position_world: Array  # (n, 3) (m)
    coupling: Array  # (n, 3, 3), rows are receiving coils, columns transmitting ones (T)
    sigma: Array  # (n,), of each coupling of a pose (T)

    def rows(self, chosen: Array) -> "BodySurvey":
        """Return a subset of the poses."""
        return BodySurvey(*(getattr(self, name)[chosen] for name in self.__dataclass_fields__))

    def of_sensor(self, beacon: Beacon, sensor: Magnetometer) -> AntennaSurvey:
        """Return the survey at poses of the sensor in beacon axes."""
        place = self.position_world + self.world_from_body @ sensor.position_body
        return AntennaSurvey(
            beacon.world_from_beacon.T @ self.world_from_body @ sensor.body_from_sensor,
            (place - beacon.position_world) @ beacon.world_from_beacon,
            self.coupling,
            self.sigma,
        )


def of_site(beacon: Beacon, sensor: Magnetometer) -> Observe:
    """Return a model that puts antennas into a site's coils and magnetometer."""
    mounted = replace(sensor, position_body=np.zeros(3), body_from_sensor=np.eye(3))
    placed = replace(beacon, position_world=np.zeros(3), world_from_beacon=np.eye(3))
    reverted = np.exp(-1j * np.array([coil.phase for coil in beacon.coils]))

    def observed(antenna: Antenna, beacon_from_sensor: Array, position_beacon: Array) -> Coupling:
        seen = observe_antenna(antenna, beacon_from_sensor, position_beacon)
        if antenna.kappa_beacon is None:
            return seen
        vector = antenna.vector()
        alone = antenna.at((0,) * (vector.ndim - 1))
        phasor = predict(
            coils_of(placed, alone),
            receiver_of(mounted, alone),
            beacon_from_sensor,
            position_beacon,
        )
        return seen._replace(value=np.swapaxes((phasor * reverted[:, None]).real, -1, -2))

    return observed


def coils_of(beacon: Beacon, antenna: Antenna) -> Beacon:
    """Return the beacon with the moments, centres and sizes of an antenna."""
    coils = zip(beacon.coils, antenna.moments_beacon, antenna.centres_beacon, strict=True)
    moved = [replace(coil, moment_beacon=m, centre_beacon=c) for coil, m, c in coils]
    if antenna.kappa_beacon is None:
        return replace(beacon, coils=tuple(moved))
    sized = zip(moved, np.asarray(antenna.kappa_beacon).tolist(), strict=True)
    return replace(beacon, coils=tuple(_of_size(coil, kappa) for coil, kappa in sized))


def _of_size(coil: Coil, kappa: float) -> Coil:
    """Return the coil as a circular, or long, coil of this size."""
    if abs(kappa) < MIN_KAPPA and coil.length is None:
        return replace(coil, radius=None)
    radius, length = coil_shape(kappa, coil.length)
    return replace(coil, radius=radius, length=length)


def receiver_of(sensor: Magnetometer, antenna: Antenna) -> Magnetometer:
    """Return the magnetometer with the matrix, centres and size of an antenna's coils."""
    kappa = 0.0 if antenna.kappa_sensor is None else float(antenna.kappa_sensor)
    return replace(
        sensor,
        matrix=antenna.sensitivities_sensor,
        coil_centres_sensor=antenna.centres_sensor,
        coil_kappa=kappa,
    )


def with_fit(site: Site, beacon: Beacon, fit: AntennaFit) -> Site:
    """Return the site with the antennas of a fit, and their sigmas."""
    antenna, sensor = fit.antenna, site.platform.magnetometer
    sigma = np.sqrt(np.diagonal(fit.cov))
    size = np.linalg.norm(antenna.moments_beacon, axis=1)
    along = antenna.moments_beacon / size[:, None]
    blocks = [fit.cov[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] for k in range(3)]
    log_moment = np.sqrt([a @ c @ a for a, c in zip(along, blocks, strict=True)]) / size
    refined = replace(coils_of(beacon, antenna), sigma=replace(beacon.sigma, log_moment=log_moment))
    magnetometer = replace(
        receiver_of(sensor, antenna),
        sigma=replace(sensor.sigma, matrix=sigma[SENSITIVITIES].reshape(3, 3)),
    )
    known, owners = site.correlation, (beacon.name, "magnetometer")
    return replace(
        site,
        beacons=tuple(refined if b.name == beacon.name else b for b in site.beacons),
        platform=replace(site.platform, magnetometer=magnetometer),
        correlation=known and known.without(("moments", "magnetometer"), owners),
    )


def into_mounting(
    fit: AntennaFit, sensor: Magnetometer, declared: Array
) -> tuple[AntennaFit, Magnetometer]:
    """Return a fit whose receiver is rotated and shifted as little as possible, and the mounting.

    `sensor`: mounted as in the fit. `declared` (3, 3): matrix from which the fitted matrix is to
    differ least.
    """
    rows = fit.antenna.sensitivities_sensor
    turn, shift = _nearest_turn(rows, declared), np.mean(fit.antenna.centres_sensor, axis=0)
    step = 1e-6 * np.linalg.norm(rows)
    by_rows = np.zeros((3, 9))
    for k in range(9):
        moved = rows + step * np.eye(9)[k].reshape(3, 3)
        by_rows[:, k] = (
            Rotation.from_matrix(turn.T @ _nearest_turn(moved, declared)).as_rotvec() / step
        )
    of_rows = fit.cov[SENSITIVITIES, SENSITIVITIES]
    mean = np.tile(sensor.body_from_sensor / 3.0, 3)
    of_centres = fit.cov[SENSOR_CENTRES, SENSOR_CENTRES]
    antenna = replace(
        fit.antenna,
        sensitivities_sensor=rows @ turn,
        centres_sensor=(fit.antenna.centres_sensor - shift) @ turn,
    )
    whole = np.eye(len(fit.cov))
    for k in range(18, 36, 3):
        whole[k : k + 3, k : k + 3] = turn.T
    mounted = replace(
        sensor,
        body_from_sensor=sensor.body_from_sensor @ turn,
        position_body=sensor.position_body + sensor.body_from_sensor @ shift,
        sigma=replace(
            sensor.sigma,
            rotation_sensor=np.sqrt(np.diagonal(by_rows @ of_rows @ by_rows.T)),
            position_body=np.sqrt(np.diagonal(mean @ of_centres @ mean.T)),
        ),
    )
    return replace(fit, antenna=antenna, cov=whole @ fit.cov @ whole.T), mounted


def _nearest_turn(rows: Array, declared: Array) -> Array:
    """Return the rotation Q for which ``rows @ Q`` is nearest to the declared matrix."""
    residual, _, right = np.linalg.svd(rows.T @ declared)
    return np.asarray(residual @ np.diag([1.0, 1.0, np.linalg.det(residual @ right)]) @ right)
