"""The room of paper 004, and deviations of its field from that of known dipoles.

A `Scenario` specifies the disturbances of a world, `draw_world` draws one, and a `SimulatedWorld`
gives a sensor's measurements in it, anywhere and with a fingerprint survey.  The estimator's
knowledge is `SimulatedWorld.site`: dipoles, exactly surveyed.  The scenarios are noise alone (S0),
a smooth gain error (S1), two sets fitted to the errors that the paper prints (F1, F2), and physical
causes: coils of finite size (P0), with iron drawn from the whole range of its effect (P1, P2) or
close by (N1, N2).
"""

from dataclasses import dataclass, replace

import numpy as np

from magfusion.calibration.fieldmap import MapPoints, learn_field_map
from magfusion.files.survey import Survey
from magfusion.model.samples import FieldSamples
from magfusion.model.site import Beacon, BeaconSigma, Coil, MagnetometerSigma, Platform, Site
from magfusion.simulation.demo_site import demo_site
from magfusion.simulation.disturbance import (
    CLEARANCE,
    SmoothField,
    Spheres,
    draw_smooth,
    draw_spheres,
)
from magfusion.simulation.field import phasors_world
from magfusion.units import MU0_OVER_4PI, NANOTESLA, Array, ComplexArray

MOMENT = 65.0  # A m^2, peak: paper 004's lines where their amplitude is the root mean square
HEIGHT = 0.5  # m, of targets and fingerprints
IRON_PERMEABILITY = 1000.0


@dataclass(frozen=True, eq=False)
class SceneLayout:
    """Positions of beacons, targets and fingerprints, all level.

    Parameters
    ----------
    beacons_world : ndarray, shape (beacons, 3)
        (m)
    frequencies_hz : tuple of float
    targets_world : ndarray, shape (2, 3)
        Lower and upper corner (m) of the targets' range.
    fingerprints_world : ndarray, shape (2, 3)
        First and last point (m) of the survey's grid.
    spacing : float
        Of the grid (m).
    clearance : float
        Minimum distance of a target from a beacon (m).
    """

    beacons_world: Array
    frequencies_hz: tuple[float, ...]
    targets_world: Array
    fingerprints_world: Array
    spacing: float = 0.5
    clearance: float = 0.8

    def grid_world(self) -> Array:
        """Return the points of a fingerprint survey (m), shape (points, 3)."""
        first, last = self.fingerprints_world
        counts = np.round((last - first) / self.spacing).astype(int) + 1
        axes = [low + self.spacing * np.arange(n) for low, n in zip(first, counts, strict=True)]
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)

    def draw_targets(self, rng: np.random.Generator, count: int) -> Array:
        """Return random points, none within the clearance of a beacon (m), shape (count, 3)."""
        kept = np.zeros((0, 3))
        while len(kept) < count:
            drawn = rng.uniform(self.targets_world[0], self.targets_world[1], (count, 3))
            between = np.linalg.norm(drawn[:, None] - self.beacons_world, axis=-1)
            kept = np.concatenate([kept, drawn[(between > self.clearance).all(axis=1)]])
        return kept[:count]


ROOM = SceneLayout(
    beacons_world=np.array([[0.0, 0.0, 0.0], [6.20, 0.54, 0.0], [3.20, 4.28, 0.0]]),
    frequencies_hz=(25.0, 20.0, 30.0),
    targets_world=np.array([[0.6, 0.6, HEIGHT], [5.1, 3.9, HEIGHT]]),
    # The half metres of the floor that contain all targets.
    fingerprints_world=np.array([[0.5, 0.5, HEIGHT], [5.5, 4.0, HEIGHT]]),
)


def ring(beacons: int) -> SceneLayout:
    """Return beacons evenly on a ring of 3.6 m radius, and targets in the 2 m square within."""
    azimuth = 2.0 * np.pi * np.arange(beacons) / beacons
    circle = np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros(beacons)], axis=1)
    return SceneLayout(
        beacons_world=3.6 * circle,
        frequencies_hz=tuple(20.0 + 5.0 * i for i in range(beacons)),
        targets_world=np.array([[-1.0, -1.0, HEIGHT], [1.0, 1.0, HEIGHT]]),
        fingerprints_world=np.array([[-1.5, -1.5, HEIGHT], [1.5, 1.5, HEIGHT]]),
    )


@dataclass(frozen=True)
class SimulatedReceiver:
    """Receiver noise after averaging: white, one epoch from many samples.

    Parameters
    ----------
    sample_sigma : float
        White noise of each axis of a sample (T).
    samples : int
        In an epoch.
    quantisation : float
        Step of the instrument (T), far below the noise, so that its error is white as well.
    """

    sample_sigma: float = 3.0 * NANOTESLA
    samples: int = 200
    quantisation: float = 0.1 * NANOTESLA
    rate_hz: float = 200.0

    @property
    def sigma(self) -> float:
        """Of each component of a phasor's real, and imaginary, part (T)."""
        variance = self.sample_sigma**2 + self.quantisation**2 / 12.0
        return float(np.sqrt(2.0 * variance / self.samples))


@dataclass(frozen=True)
class Scenario:
    """Disturbances of worlds; by default none.

    Parameters
    ----------
    gain_rms, gain_length : float
        Smooth random logarithm of each beacon's gain, and its correlation length (m).
    matrix_rms, matrix_length : float
        Smooth random 3 x 3 matrix added to unity, which rotates and distorts each beacon's field in
        world axes: its rms relative to the field (the nine entries are independent, each of this
        divided by the root of three), and its correlation length (m).
    white_rms : float
        Random relative gain, independent for each beacon in each epoch.
    line_bias_rms : float
        Of `World.line_bias`.
    coil_radius, coil_length : float, optional
        Of the true coils (m).
    spheres : int
        Permeable, non-conducting, around the survey, placed by `draw_spheres`.
    sphere_radius : tuple of float
        Minimum and maximum (m).
    iron_reach : float, optional
        Depth of the shell in which iron is drawn (m); `detection_reach` if None.
    """

    name: str
    gain_rms: float = 0.0
    gain_length: float = 1.0
    matrix_rms: float = 0.0
    matrix_length: float = 1.0
    white_rms: float = 0.0
    line_bias_rms: float = 0.0
    coil_radius: float | None = None
    coil_length: float | None = None
    spheres: int = 0
    sphere_radius: tuple[float, float] = (0.15, 0.25)
    iron_reach: float | None = None


S0 = Scenario("S0")
S1 = Scenario("S1", gain_rms=0.20, gain_length=2.0)
F1 = Scenario(
    "F1",
    gain_rms=0.1137,
    gain_length=1.513,
    matrix_rms=0.028,
    white_rms=0.0061,
    line_bias_rms=0.10,
)
F2 = Scenario(
    "F2",
    gain_rms=0.1974,
    gain_length=2.433,
    matrix_rms=0.0106,
    white_rms=0.0074,
    line_bias_rms=0.10,
)
P0 = Scenario("P0", coil_radius=0.23, coil_length=0.20)
P1 = replace(P0, name="P1", spheres=12, sphere_radius=(0.15, 0.25))
P2 = replace(P0, name="P2", spheres=12, sphere_radius=(0.25, 0.40))
# Selected: iron close enough to disturb strongly; rooms as near are rare.
N1, N2 = (replace(p, name=f"N{i}", iron_reach=0.25) for i, p in ((1, P1), (2, P2)))
SCENARIOS = {scenario.name: scenario for scenario in (S0, S1, F1, F2, P0, P1, P2, N1, N2)}


@dataclass(frozen=True, eq=False)
class SimulatedWorld:
    """One draw of a scenario.

    Parameters
    ----------
    site : Site
        Known to the estimator.
    true_beacons : tuple of Beacon
        With finite coil sizes.
    log_gain : SmoothField
        Of place (m); one function a beacon.
    matrix : SmoothField
        Of place (m); nine functions a beacon, the matrix's rows one after the other.
    line_bias : ndarray, shape (beacons,)
        Error of the intercept of each beacon's amplitude line (natural logarithm): the change since
        the campaign in which the lines were fitted.  It is in no measurement of this world; a
        method by lines adds it to its intercepts.
    """

    site: Site
    layout: SceneLayout
    scenario: Scenario
    receiver: SimulatedReceiver
    true_beacons: tuple[Beacon, ...]
    log_gain: SmoothField
    matrix: SmoothField
    line_bias: Array
    spheres: Spheres | None

    def phasors_world(self, position_world: Array) -> ComplexArray:
        """Return the true phasors without noise (T), world axes, shape (n, beacons, 3)."""
        n, count = len(position_world), len(self.true_beacons)
        fields = [phasors_world(b, position_world, self.spheres) for b in self.true_beacons]
        gain = np.exp(self.log_gain(position_world))
        matrix = np.eye(3) + self.matrix(position_world).reshape(n, count, 3, 3)
        undisturbed = np.concatenate(fields, axis=1)
        bent = (matrix @ undisturbed[..., None])[..., 0]
        return gain[..., None] * bent

    def measure(
        self, position_world: Array, world_from_body: Array, rng: np.random.Generator
    ) -> FieldSamples:
        """Return the measurements of the sensor, which is the body; one epoch per position.

        Parameters
        ----------
        position_world : ndarray, shape (n, 3)
            (m)
        world_from_body : ndarray, shape (n, 3, 3) or (3, 3)
        """
        n, count = len(position_world), len(self.true_beacons)
        turn = np.broadcast_to(world_from_body, (n, 3, 3))
        gain = 1.0 + self.scenario.white_rms * rng.standard_normal((n, count, 1))
        phasor = (gain * self.phasors_world(position_world)) @ turn
        sigma = self.receiver.sigma
        noise = rng.normal(0.0, sigma, (2, *phasor.shape))
        return FieldSamples(
            time=np.arange(float(n)),
            window=np.full(n, self.receiver.samples / self.receiver.rate_hz),
            channels=self.site.channels,
            phasor_sensor=phasor + noise[0] + 1j * noise[1],
            phasor_cov=np.broadcast_to(sigma**2 * np.eye(3), (n, count, 3, 3)).copy(),
        )

    def survey(self, rng: np.random.Generator, position_sigma: float = 0.0) -> Survey:
        """Return fingerprints on the layout's grid, measured by a level sensor.

        Parameters
        ----------
        position_sigma : float
            Standard deviation of the true positions about the grid points, each axis (m).
        """
        grid_world = self.layout.grid_world()
        true_world = grid_world + position_sigma * rng.standard_normal(grid_world.shape)
        level = np.tile(np.eye(3), (len(grid_world), 1, 1))
        samples = self.measure(true_world, level, rng)
        return Survey(
            point=np.arange(len(grid_world)),
            position_world=grid_world,
            world_from_body=level,
            channels=samples.channels,
            sigma=np.sqrt(samples.phasor_cov[..., 0, 0]),
            phasor_sensor=samples.phasor_sensor,
        )


def mapped(site: Site, survey: Survey) -> Site:
    """Return the site with the field map of a survey."""
    assert survey.phasor_sensor is not None
    points = MapPoints(
        survey.world_from_body, survey.position_world, survey.phasor_sensor, survey.sigma
    )
    return learn_field_map(site, points).site


def detection_reach(radius: float, layout: SceneLayout, receiver: SimulatedReceiver) -> float:
    """Return the distance of iron at which its effect in a room's middle equals the noise (m).

    A sphere of radius a adds ``2 (a / d)^3`` of the field that it disturbs at distance d from its
    centre; the limit is the receiver's noise.  Iron is drawn uniformly from this range: in an
    unknown room, its iron is only as close as chance has it.
    """
    middle_world = np.mean(layout.targets_world, axis=0)
    away = float(np.mean(np.linalg.norm(layout.beacons_world - middle_world, axis=1)))
    field = MU0_OVER_4PI * MOMENT / away**3
    return radius * ((2.0 * field / receiver.sigma) ** (1.0 / 3.0) - 1.0)


def draw_world(
    scenario: Scenario,
    rng: np.random.Generator,
    layout: SceneLayout = ROOM,
    receiver: SimulatedReceiver | None = None,
    model_error: float = 0.02,
) -> SimulatedWorld:
    """Draw a world.

    Parameters
    ----------
    rng : Generator
            Gain, matrix, line bias and spheres have separate generators, spawned from it.
        model_error : float
            Declared in the site.
    """
    gain_rng, matrix_rng, line_rng, sphere_rng = rng.spawn(4)
    receiver = receiver or SimulatedReceiver()
    entry_rms = scenario.matrix_rms / np.sqrt(3.0)
    count = len(layout.beacons_world)
    spheres = None
    if scenario.spheres:
        spheres = draw_spheres(
            sphere_rng,
            scenario.spheres,
            layout.fingerprints_world,
            layout.beacons_world,
            scenario.sphere_radius,
            permeability=IRON_PERMEABILITY,
            conductivity=0.0,
            reach=_iron_reach(scenario, layout, receiver),
        )
    site = _declared_site(layout, model_error)
    return SimulatedWorld(
        site=site,
        layout=layout,
        scenario=scenario,
        receiver=receiver,
        true_beacons=tuple(_with_size(beacon, scenario) for beacon in site.beacons),
        log_gain=draw_smooth(gain_rng, scenario.gain_rms, scenario.gain_length, count),
        matrix=draw_smooth(matrix_rng, entry_rms, scenario.matrix_length, 9 * count),
        line_bias=line_rng.normal(0.0, scenario.line_bias_rms, count),
        spheres=spheres,
    )


def _iron_reach(scenario: Scenario, layout: SceneLayout, receiver: SimulatedReceiver) -> float:
    if scenario.iron_reach is not None:
        return scenario.iron_reach
    return detection_reach(scenario.sphere_radius[1], layout, receiver) - CLEARANCE


def _with_size(beacon: Beacon, scenario: Scenario) -> Beacon:
    radius, length = scenario.coil_radius, scenario.coil_length
    coils = (replace(coil, radius=radius, length=length) for coil in beacon.coils)
    return replace(beacon, coils=tuple(coils))


def _declared_site(layout: SceneLayout, model_error: float) -> Site:
    """Return level beacons as dipoles, and a bare sensor, all known exactly."""
    plain = demo_site()
    coils = (Coil(np.array([MOMENT, 0.0, 0.0])), Coil(np.array([0.0, MOMENT, 0.0]), -np.pi / 2.0))
    known = BeaconSigma(np.zeros(3), np.zeros(3), np.zeros(2))
    beacons = tuple(
        Beacon(f"M{i + 1}", place, np.eye(3), layout.frequencies_hz[i], coils, True, known)
        for i, place in enumerate(layout.beacons_world)
    )
    magnetometer = replace(
        plain.platform.magnetometer,
        body_from_sensor=np.eye(3),
        position_body=np.zeros(3),
        sigma=MagnetometerSigma(np.zeros((3, 3)), np.zeros(3), np.zeros(3), np.zeros(3)),
    )
    platform = Platform(plain.platform.imu, magnetometer)
    return Site(plain.gravity, model_error, beacons, platform)
