"""Symmetries of the dipole that relate the best pose of an epoch to its alternatives.

The field of a dipole is even in the offset, ``B(-r) = B(r)``.  That of a rotating one is repeated,
up to a rotation of the sensor, in the mirror image of its plane and half a turn about its axis.
Symmetries not resolved by other beacons, gravity and the drive phase are reported here.
"""

from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from magfusion.estimation.snapshot.fix import Fixes
from magfusion.model.site import Beacon, Site
from magfusion.units import Array, BoolArray

Words = NDArray[np.str_]

OPEN = 9.0  # chi square, three sigma: an alternative closer than this explains the epoch as well
NEAR = 0.25  # largest distance to the exact image of the best pose, relative to the offset
SAME_PLACE = 0.05  # of the distance from the nearest beacon
SAME_ATTITUDE_RAD = (
    0.35  # rad, within which two attitudes are equal; noise and survey move alternatives
)
FLAT, PARALLEL = 0.1, 0.1  # m, rad; tolerances for beacons in a common plane


class Kind(StrEnum):
    """Symmetry from the best pose to an alternative."""

    BEST = "best"
    NONE = ""  # no hypothesis
    MIRROR = "mirror"
    PLANE = "plane"
    HALF_TURN = "half_turn"
    HEADING = "heading"
    POLARITY = "polarity"
    AZIMUTH = "azimuth"
    ELSEWHERE = "elsewhere"


SYMMETRIES = tuple(k for k in Kind if k not in (Kind.BEST, Kind.NONE))

_POSE = {
    Kind.MIRROR: "the pose on the opposite side of {}",
    Kind.PLANE: "the pose mirrored in the plane of {}",
    Kind.HALF_TURN: "the pose half a turn about the axis of {}",
    Kind.HEADING: "the opposite heading at the same position",
    Kind.POLARITY: "the pose mirrored in the plane of {} with the opposite heading",
    Kind.AZIMUTH: "any azimuth about {}",
    Kind.ELSEWHERE: "another pose",
}
_REMEDY = {
    Kind.MIRROR: "another beacon in range, or motion,",
    Kind.PLANE: "gravity at rest, or a beacon off that plane,",
    Kind.HALF_TURN: "gravity at rest, or another beacon in range,",
    Kind.HEADING: "a synchronised beacon, or motion,",
    Kind.POLARITY: "a synchronised beacon, or one off that plane,",
    Kind.AZIMUTH: "another beacon in range",
    Kind.ELSEWHERE: "another beacon in range, or motion,",
}


class _Image(NamedTuple):
    """Image of the sensor under one symmetry."""

    kind: Kind
    owner: str
    position: Array  # (n, 3)


@dataclass(frozen=True, eq=False)
class Relations:
    """Relation of the hypotheses of every epoch to its best."""

    kind: Words  # (n, hypotheses), values of `Kind`
    # (n, hypotheses), the beacon of the symmetry; empty for the plane of several, and if there is
    # none
    owner: Words
    # (n, hypotheses), an alternative that explains the epoch as well, within three sigma
    is_open: BoolArray
    # (n, hypotheses), information that excluded an alternative, for messages; empty if none did or
    # it is open
    resolved: Words
    azimuth: Words  # (n,), the beacon about which the azimuth is open; empty if it is not

    @property
    def label(self) -> Words:
        """Kind and owner of each hypothesis as one word, e.g. ``mirror A``."""
        return np.char.strip(np.char.add(np.char.add(self.kind, " "), self.owner))


def _axis(beacon: Beacon) -> Array | None:
    """Return the symmetry axis (world) of a beacon's moments; None for three axes."""
    drive = beacon.moments_beacon.T @ beacon.excitation
    residual, size, _ = np.linalg.svd(np.concatenate([drive.real, drive.imag], axis=1))
    rank = int(np.sum(size > 1e-3 * size[0]))
    if rank == 3:
        return None
    return beacon.world_from_beacon @ residual[:, 0 if rank == 1 else 2]


def _common_plane(site: Site) -> Array | None:
    """Return the normal of the common plane of several parallel beacons; None without one."""
    axes = [_axis(beacon) for beacon in site.beacons]
    first = axes[0]
    if len(axes) < 2 or first is None:
        return None
    for beacon, axis in zip(site.beacons, axes, strict=True):
        off = (beacon.position_world - site.beacons[0].position_world) @ first
        if axis is None or abs(off) > FLAT or abs(axis @ first) < np.cos(PARALLEL):
            return None
    return first


def _images(site: Site, sensor_world: Array) -> list[_Image]:
    common = _common_plane(site)
    images = []
    for beacon in site.beacons:
        offset, axis = sensor_world - beacon.position_world, _axis(beacon)
        images.append(_Image(Kind.MIRROR, beacon.name, beacon.position_world - offset))
        if axis is None:
            continue
        along = (offset @ axis)[:, None] * axis
        images.append(_Image(Kind.HALF_TURN, beacon.name, sensor_world - 2.0 * (offset - along)))
        if common is None:
            images.append(_Image(Kind.PLANE, beacon.name, sensor_world - 2.0 * along))
    if common is not None:
        height = (sensor_world - site.beacons[0].position_world) @ common
        images.append(_Image(Kind.PLANE, "", sensor_world - 2.0 * height[:, None] * common))
    return images


def _open_azimuth(fixes: Fixes, site: Site) -> Words:
    """Return the name of the beacon about which the best pose of each epoch may rotate."""
    names = np.full(len(fixes), "", dtype=f"<U{max(len(b.name) for b in site.beacons)}")
    rotation, position = fixes.world_from_body[:, 0], fixes.position_world[:, 0]
    body_from_world = np.swapaxes(rotation, 1, 2)
    widest = np.linalg.eigh(fixes.pose_cov[:, 0])[1][..., -1]
    for beacon in site.beacons:
        axis = _axis(beacon)
        if axis is None:
            continue
        travel = np.cross(axis, position - beacon.position_world)
        turning = np.concatenate(
            [body_from_world @ axis, (body_from_world @ travel[..., None])[..., 0]], axis=1
        )
        turning /= np.linalg.norm(turning, axis=1, keepdims=True)
        along = np.abs(np.sum(turning * widest, axis=1)) > 0.99
        names[along & ~fixes.determined[:, 0]] = beacon.name
    return names


def relations(fixes: Fixes, site: Site) -> Relations:
    """Return how the hypotheses of each epoch are related to its best."""
    lever = site.platform.magnetometer.position_body
    sensor = fixes.position_world + fixes.world_from_body @ lever
    images = _images(site, sensor[:, 0])
    azimuth = _open_azimuth(fixes, site)
    width = max(len(b.name) for b in site.beacons)
    kind = np.full(fixes.cost.shape, str(Kind.ELSEWHERE), dtype="<U16")
    owner = np.full(fixes.cost.shape, "", dtype=f"<U{width}")
    for h in range(1, fixes.cost.shape[1]):
        kind[:, h], owner[:, h] = _related(fixes, site, sensor, images, h)
        _about_azimuth(kind[:, h], owner[:, h], azimuth, site, sensor[:, 0], sensor[:, h])
    rival = np.isfinite(fixes.cost)
    kind[~rival] = str(Kind.NONE)
    owner[~rival] = ""
    kind[:, 0] = str(Kind.BEST)
    rival[:, 0] = False
    added = np.where(rival, fixes.cost - fixes.cost[:, :1], 0.0)
    parts = [part - part[:, :1] for part in (fixes.gravity_cost, fixes.prior_cost)]
    others = "the other beacons" if len(site.beacons) > 1 else "the field itself"
    by = np.array(["gravity", "the prior", others])
    converged = by[np.argmax(np.stack([*parts, added - parts[0] - parts[1]]), axis=0)]
    converged[added <= OPEN] = ""
    return Relations(kind, owner, rival & (added <= OPEN), converged, azimuth)


def _related(
    fixes: Fixes, site: Site, sensor: Array, images: list[_Image], h: int
) -> tuple[Words, Words]:
    """Return kind and owner of one hypothesis of each epoch."""
    separate = np.stack([np.linalg.norm(sensor[:, h] - i.position, axis=1) for i in images], axis=1)
    nearest = np.argmin(separate, axis=1)
    way = np.linalg.norm(sensor[:, h] - sensor[:, 0], axis=1)
    result = np.min(separate, axis=1) < NEAR * way
    kind = np.array([str(i.kind) for i in images], dtype="<U16")[nearest]
    owner = np.array([i.owner for i in images])[nearest]
    turn = fixes.world_from_body[:, h] @ np.swapaxes(fixes.world_from_body[:, 0], 1, 2)
    # The rotation sense of the drives is unknown: the field may be reversed, with the heading.
    normal = _common_plane(site)
    if normal is not None and not any(b.synchronised for b in site.beacons):
        reversed_heading = _is_half_turn(turn, normal)
        kind[(kind == Kind.PLANE) & reversed_heading] = str(Kind.POLARITY)
    kind[~result], owner[~result] = str(Kind.ELSEWHERE), ""
    centres = np.stack([b.position_world for b in site.beacons])
    reach = np.min(np.linalg.norm(sensor[:, :1] - centres, axis=2), axis=1)
    heading = (way < SAME_PLACE * reach) & _is_half_turn(turn, np.array([0.0, 0.0, 1.0]))
    kind[heading], owner[heading] = str(Kind.HEADING), ""
    return kind, owner


def _is_half_turn(turn_world: Array, axis_world: Array) -> BoolArray:
    half = Rotation.from_rotvec(np.pi * axis_world).as_matrix()
    return Rotation.from_matrix(half.T @ turn_world).magnitude() < SAME_ATTITUDE_RAD


def _about_azimuth(
    kind: Words, owner: Words, azimuth: Words, site: Site, best: Array, rival: Array
) -> None:
    """Distinguish alternatives of epochs with an open azimuth by azimuth-invariant quantities."""
    for beacon in site.beacons:
        rows, axis = azimuth == beacon.name, _axis(beacon)
        if axis is None or not np.any(rows):
            continue
        ours, others = (s[rows] - beacon.position_world for s in (best, rival))
        heights, distances = (ours @ axis, others @ axis), np.linalg.norm(ours, axis=1)
        near = np.abs(np.linalg.norm(others, axis=1) - distances) < NEAR * distances
        shared = near & (np.abs(heights[0] - heights[1]) < NEAR * distances)
        across = near & ~shared & (np.abs(heights[0] + heights[1]) < NEAR * distances)
        across_kind = np.where(across, str(Kind.MIRROR), kind[rows])
        kind[rows] = np.where(shared, str(Kind.AZIMUTH), across_kind)
        owner[rows] = np.where(shared | across, beacon.name, owner[rows])


def _counted(relation: Relations, chosen: BoolArray) -> dict[tuple[Kind, str], int]:
    """Return in how many epochs each symmetry has a chosen hypothesis."""
    result: dict[tuple[Kind, str], int] = {}
    for kind in SYMMETRIES:
        mine = chosen & (relation.kind == kind)
        for owner in np.unique(relation.owner[mine]):
            result[kind, str(owner)] = int(np.sum(np.any(mine & (relation.owner == owner), axis=1)))
    return result


def _pose(kind: Kind, owner: str) -> str:
    return _POSE[kind].format(f"beacon {owner}" if owner else "the beacons")


class Ambiguities(NamedTuple):
    """Symmetries that a log leaves open, and alternatives that it excludes."""

    epochs: dict[Kind, int]  # number of epochs that each symmetry leaves open; only those with any
    # open, resolved: sentences
    open: list[str]
    resolved: list[str]


def ambiguities(related: Relations) -> Ambiguities:
    """Return how many epochs each symmetry leaves open, and messages."""
    count = len(related.azimuth)
    by_kind: dict[Kind, int] = {}
    sentences: list[str] = []
    continuum = related.azimuth != ""
    rivals = related.is_open & ~((related.kind == Kind.AZIMUTH) & continuum[:, None])
    result = _counted(related, rivals)
    for owner in np.unique(related.azimuth[continuum]):
        result[Kind.AZIMUTH, str(owner)] = int(np.sum(related.azimuth == owner))
    for (kind, owner), epochs in result.items():
        by_kind[kind] = epochs + by_kind.get(kind, 0)
        sentences.append(
            f"In {epochs} of {count} epochs {_pose(kind, owner)} explains the measurements as well;"
            f" {_REMEDY[kind]} would resolve this."
        )
    converged = []
    for decided in np.unique(related.resolved[related.resolved != ""]):
        chosen = (related.resolved == decided) & (related.kind != Kind.ELSEWHERE)
        poses = ", ".join(_pose(*key) for key in _counted(related, chosen))
        epochs = int(np.sum(np.any(chosen, axis=1)))
        if epochs:
            converged.append(f"In {epochs} of {count} epochs {decided} ruled out {poses}.")
    return Ambiguities(by_kind, sentences, converged)
