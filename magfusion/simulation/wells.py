"""Two wells: a sensor at rest in one, at successive places, and a magnet passing in the other."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.model.physics.casing import Casing
from magfusion.simulation.pipe import Pipe
from magfusion.simulation.rotor import Pass
from magfusion.units import Array

LATERAL = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0]])  # right and up of x down the hole, z up


@dataclass(frozen=True)
class TwoWells:
    """Geometry of two wells.

    The sensor's well leads east, its depth counted from the world's origin.
    """

    distance: float  # approximate distance between them (m)
    # of the magnet's well, from the high side, clockwise looking down the hole (rad)
    direction: float
    dip: float  # of the sensor's well below the horizontal (rad)
    # of the magnet's well relative to the sensor's: rotation about the left, and about the high
    # side (rad)
    lean: tuple[float, float]
    turn: float  # of the magnet's angle zero about its shaft (rad)
    ahead: float  # of the magnet's position at ``depth`` (m)
    well_distance: float  # between the sensor's two places along its well (m)
    reach: float  # of the magnet's path on either side of the sensor (m)
    speed: float  # of the magnet along its well (m/s)
    depth: float = 0.0  # measured in both wells, in the middle (m)

    @property
    def side_world(self) -> Array:
        """World from the frame of the sensor's high side, (3, 3): x down the hole, z up."""
        return np.asarray(Rotation.from_euler("y", self.dip).as_matrix())

    @property
    def along_world(self) -> Array:
        """Unit vector down the magnet's well."""
        side = self.side_world
        lean = Rotation.from_rotvec(side @ np.array([0.0, *self.lean]))
        return np.asarray(lean.apply(side[:, 0]))

    def transits_of(
        self, rolls: Array, lever_body: Array | None = None, axis_beacon: Array | None = None
    ) -> tuple[Pass, ...]:
        """Return a pass for each of two places of the sensor.

        `rolls` (2,): of the sensor about its hole (rad). `axis_beacon` (3,): of the shaft, down its
        hole; the first. `lever_body` (3,): of the sensor in its body, which is on the axis of its
        hole (m).
        """
        side = self.side_world
        across = side @ np.array([0.0, -np.sin(self.direction), np.cos(self.direction)])
        lean = Rotation.from_rotvec(side @ np.array([0.0, *self.lean]))
        turn = Rotation.from_rotvec(side[:, 0] * self.turn)
        rotor_world = (lean * turn).as_matrix() @ side
        along = rotor_world[:, 0]
        if axis_beacon is not None:
            rotor_world = rotor_world @ _first_from(axis_beacon)
        middle = self.distance * across + self.ahead * along
        out = []
        for place, roll in zip(
            (-0.5 * self.well_distance, 0.5 * self.well_distance), rolls, strict=True
        ):
            body = place * side[:, 0]
            simultaneous = float((body - middle) @ along)
            low, high = simultaneous - self.reach, simultaneous + self.reach
            world_from_body = side @ Rotation.from_euler("x", roll).as_matrix()
            sensor = body if lever_body is None else body + world_from_body @ lever_body
            one = Pass(
                self.depth + place,
                sensor,
                world_from_body,
                middle + low * along,
                rotor_world,
                (self.depth + low, self.depth + high),
                self.speed,
            )
            out.append(one)
        return tuple(out)

    def casing(
        self, half: float, radius: float, steel: tuple[float, float, float], segment: float
    ) -> Pipe:
        """Return the casing around the sensor.

        `half`: half length from the middle between its places (m). `radius`: outside (m). `steel`:
        its wall (m), permeability and conductivity (S/m). `segment` (m).
        """
        down = self.side_world[:, 0]
        return Pipe(-half * down, half * down, radius, *steel, segment)

    def truth_of(self, own: Pass) -> tuple[float, float, float]:
        """Return the true values of a pass.

        Its distance (m), direction from the high side (rad), and the magnet's depth at the closest
        approach (m).
        """
        along = self.along_world
        body_world = (own.sensor_depth - self.depth) * self.side_world[:, 0]
        offset = own.start_world - body_world
        travel = -float(offset @ along)
        nearest = offset + travel * along
        right, up = LATERAL @ (self.side_world.T @ nearest)
        distance = float(np.linalg.norm(nearest))
        return distance, float(np.arctan2(right, up)), own.depth[0] + travel

    def leads(self) -> tuple[float, float]:
        """Return the magnet's well direction to the right and up, from the sensor's (rad)."""
        along = self.side_world.T @ self.along_world
        right, up = LATERAL @ along
        return float(np.arctan2(right, along[0])), float(np.arctan2(up, along[0]))


def _first_from(axis: Array) -> Array:
    """Return a rotation that takes a unit vector to the first axis, (3, 3)."""
    first = np.array([1.0, 0.0, 0.0])
    if axis[0] < -1.0 + 1e-12:
        return np.diag([-1.0, -1.0, 1.0])
    cross = np.cross(axis, first)
    angle = np.arctan2(np.linalg.norm(cross), axis[0])
    size = max(float(np.linalg.norm(cross)), 1e-300)
    return np.asarray(Rotation.from_rotvec(angle * cross / size).as_matrix())


def lean_of(right: float, up: float) -> tuple[float, float]:
    """Return the lean of a well of this direction relative to the sensor's (rad)."""
    along = np.array([1.0, -np.tan(right), np.tan(up)])
    along = along / np.linalg.norm(along)
    angle, across = np.arccos(min(along[0], 1.0)), float(np.hypot(along[1], along[2]))
    factor = angle / across if across else 1.0
    return float(-factor * along[2]), float(factor * along[1])


def drawn_steel(casing: Casing, rng: np.random.Generator) -> Casing:
    """Return a casing whose steel errs by as much as declared."""
    wall, permeability, conductivity = np.exp(casing.steel_sigma * rng.standard_normal(3)) * [
        casing.wall,
        casing.permeability,
        casing.conductivity,
    ]
    return replace(
        casing, wall=float(wall), permeability=float(permeability), conductivity=float(conductivity)
    )
