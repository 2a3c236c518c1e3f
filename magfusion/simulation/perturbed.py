"""A true site with errors drawn from the declared sigmas, and with the field of its place."""

from collections.abc import Callable
from dataclasses import replace
from datetime import date

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.model.aiding import AidingSensor
from magfusion.model.correlation import Component, Correlation
from magfusion.model.physics.earth import earth_field_world
from magfusion.model.response import changed_axes
from magfusion.model.site import Beacon, Magnetometer, Site, rotor_coils
from magfusion.units import Array

Draw = Callable[[str, str, str, Array], Array]


def perturb_site(site: Site, rng: np.random.Generator) -> Site:
    """Return a site whose calibration is drawn from the declared priors.

    Rotations are perturbed on the right, in beacon and in sensor axes; positions in world axes
    (beacons) and in body axes (magnetometer); moments and the ground's conductivity by the
    exponential of their logarithm's.  Correlated parameters are drawn together.
    """
    draw = _draws(site.correlation, rng)
    beacons = tuple(_perturb_beacon(beacon, draw) for beacon in site.beacons)
    sensors = site.platform.magnetometers
    alone = len(sensors) == 1
    drawn = tuple(_perturb_magnetometer(s, draw, None if alone else s.name) for s in sensors)
    platform = site.platform.with_magnetometers(drawn)
    if site.log_conductivity_sigma:
        error = draw("ground", "ground", "conductivity", np.array([site.log_conductivity_sigma]))
        beacons = tuple(replace(b, conductivity=b.conductivity * np.exp(error[0])) for b in beacons)
    aiding = tuple(_perturb_aiding(sensor, draw) for sensor in site.aiding)
    return replace(site, beacons=beacons, platform=platform, aiding=aiding)


def _perturb_aiding(sensor: AidingSensor, draw: Draw) -> AidingSensor:
    name, sigmas = sensor.name, sensor.sigmas
    turn = Rotation.from_rotvec(draw("aiding", name, "rotation", sigmas.rotation_sensor))
    lever = draw("aiding", name, "position", sigmas.position_body)
    scale = draw("aiding", name, "scale", sigmas.scale[None])[0]
    offset = draw("aiding", name, "offset", sigmas.offset[None])[0]
    late = draw("aiding", name, "clock_offset", sigmas.time_offset[None])[0]
    if sensor.point_world is not None:
        moved = draw("aiding", name, "point", sigmas.point_world)
        sensor = replace(sensor, point_world=sensor.point_world + moved)
    return replace(
        sensor,
        position_body=sensor.position_body + lever,
        body_from_sensor=sensor.body_from_sensor @ turn.as_matrix(),
        scale=sensor.scale + scale,
        offset=sensor.offset + offset,
        time_offset=sensor.time_offset + late,
    )


def _draws(correlation: Correlation | None, rng: np.random.Generator) -> Draw:
    """Return a function that draws the error of a parameter, jointly with correlated ones."""
    own: dict[Component, float] = {}
    if correlation is not None:
        unit = rng.standard_normal(len(correlation.parameters))
        drawn = np.linalg.cholesky(correlation.coefficients) @ unit
        own = dict(zip(correlation.parameters, drawn.tolist(), strict=True))

    def draw(group: str, owner: str, kind: str, sigma: Array) -> Array:
        error = rng.normal(0.0, sigma)
        for i, at in enumerate(np.ndindex(sigma.shape)):
            known = own.get(Component(group, owner, kind, i))
            error[at] = error[at] if known is None else sigma[at] * known
        return error

    return draw


def _perturb_beacon(beacon: Beacon, draw: Draw) -> Beacon:
    name, sigma = beacon.name, beacon.sigma
    turn = Rotation.from_rotvec(draw("beacons", name, "rotation", sigma.rotation_beacon))
    factors = np.exp(draw("moments", name, "log_moment", sigma.log_moment))
    error = draw("beacons", name, "position", sigma.position_world)
    if beacon.rotor is not None:  # one magnet has one moment
        own = replace(beacon.rotor, moment=float(factors[0]) * beacon.rotor.moment)
        beacon = replace(beacon, rotor=own, coils=rotor_coils(own, beacon.frequency_hz))
        factors = np.concatenate([np.ones(2), factors[2:]])
    return replace(
        beacon,
        position_world=beacon.position_world + error,
        world_from_beacon=beacon.world_from_beacon @ turn.as_matrix(),
        coils=tuple(
            replace(coil, moment_beacon=factor * coil.moment_beacon)
            for coil, factor in zip(beacon.coils, factors, strict=True)
        ),
    )


def _perturb_magnetometer(magnetometer: Magnetometer, draw: Draw, name: str | None) -> Magnetometer:
    sigma, sensor, own = magnetometer.sigma, name or "sensor", name or "magnetometer"
    turn = Rotation.from_rotvec(draw("extrinsics", sensor, "rotation", sigma.rotation_sensor))
    matrix = draw("magnetometer", own, "matrix", sigma.matrix)
    offset = draw("magnetometer", own, "offset", sigma.offset)
    lever = draw("extrinsics", sensor, "position", sigma.position_body)
    if sigma.clock_offset:
        late = draw("time-offset", own, "clock_offset", np.array([sigma.clock_offset]))
        magnetometer = replace(magnetometer, clock_offset=magnetometer.clock_offset + late[0])
    prior = magnetometer.response_sigma
    if prior is not None:
        gain = draw("magnetometer", own, "response_gain", prior.gain)
        phase = draw("magnetometer", own, "response_phase", prior.phase)
        nodes_hz, change = prior.frequency_hz, gain + 1j * phase
        response = changed_axes(magnetometer.response, nodes_hz, change)
        magnetometer = replace(magnetometer, response=response)
    return replace(
        magnetometer,
        matrix=magnetometer.matrix + matrix,
        offset=magnetometer.offset + offset,
        body_from_sensor=magnetometer.body_from_sensor @ turn.as_matrix(),
        position_body=magnetometer.position_body + lever,
    )


def with_earth_field(site: Site) -> Site:
    """Return a site with the field of its place, where that is declared and the field is not."""
    place = site.location
    if site.earth_field_world is not None or place is None:
        return site
    day = date.fromisoformat(place.date)
    field_world = earth_field_world(place.latitude_deg, place.longitude_deg, place.height_m, day)
    return replace(site, earth_field_world=field_world)
