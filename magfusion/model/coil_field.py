"""Fields of a beacon's coils by their declared form: dipoles, loops, current sheets.

A coil without a size is a dipole.  A coil with a radius is a thin loop, with a length as well a
uniform current sheet, with a length alone a line of dipoles.  A length is represented by as many
loops, or dipoles, as the Gauss-Legendre rule has nodes.  The relative error is below 1e-9 from half
a length off the axis, and below 1e-6 from three tenths of it.

In conducting ground or water the effect of conduction on a dipole in its place is added to each of
these: to first order in size over distance, and of the effect itself.
"""

from dataclasses import replace
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np

from magfusion.model.field_map import FieldMap
from magfusion.model.physics.conduction import (
    by_log_conductivity,
    conducted_field,
    conducted_gradient,
    decay,
)
from magfusion.model.physics.dipole import (
    dipole_field,
    dipole_field_along,
    dipole_field_and_gradient,
)
from magfusion.model.physics.loop import loop_field, loop_field_and_gradient
from magfusion.model.site import Beacon, Coil, Site
from magfusion.model.steel_field import SteelField
from magfusion.units import AnyArray, Array, ComplexArray

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(12)


class Loops(NamedTuple):
    """Loops that represent the coils of a beacon, or of several with an axis of beacons."""

    centre: Array  # (..., loops, 3), beacon axes (m)
    moment: Array  # (..., loops, 3), beacon axes (A m^2)
    radius: Array | None  # (..., loops), zero for a dipole (m); None where all are
    first: tuple[int, ...]  # the first loop of each coil


class Sources(NamedTuple):
    """Beacon, or several of one form, as arrays that broadcast against points."""

    position_world: Array  # (3,) or (beacons, 1, 3) (m)
    world_from_beacon: Array  # (3, 3) or (beacons, 3, 3)
    # (coils, tones) or (beacons, 1, coils, tones), as of `magfusion.model.site.Beacon`
    excitation: ComplexArray
    loops: Loops
    concentric: bool  # all coils of a beacon are at one place
    field_map: FieldMap | None = None  # of one beacon
    steel: SteelField | None = None  # of one beacon
    # (loops,) or (beacons, 1, loops), of each loop's field in conducting ground (1/m); None without
    # conduction
    decay: ComplexArray | None = None

    @property
    def is_mapped(self) -> bool:
        """Whether it has a map of its field, or of steel."""
        return self.field_map is not None or self.steel is not None


# Cached as long as beacon and site live: an estimator creates others at every step.
_ALONE: WeakKeyDictionary[Beacon, Sources] = WeakKeyDictionary()
_GROUPS: WeakKeyDictionary[Site, "Groups"] = WeakKeyDictionary()
Groups = tuple[tuple[tuple[int, ...], Sources], ...]


def alone(beacon: Beacon) -> Sources:
    """Return the source of one beacon, cached."""
    known = _ALONE.get(beacon)
    if known is None:
        known = _ALONE[beacon] = _source(beacon)
    return known


def _source(beacon: Beacon) -> Sources:
    return Sources(
        position_world=beacon.position_world,
        world_from_beacon=beacon.world_from_beacon,
        excitation=beacon.excitation,
        loops=_loops(beacon),
        concentric=beacon.concentric,
        field_map=beacon.field_map,
        steel=beacon.steel,
        decay=None if beacon.conductivity == 0.0 else _decay(beacon),
    )


def _decay(beacon: Beacon) -> ComplexArray:
    """Return the decay of each loop's field, at the frequency of its coil."""
    tones = [coil.frequency_hz or beacon.frequency_hz for coil in beacon.coils]
    count = [1 if coil.length is None else len(_NODES) for coil in beacon.coils]
    return np.repeat(decay(np.array(tones), beacon.conductivity), count)


def side_by_side(site: Site) -> Groups:
    """Return a site's beacons in few sources: those of one form together, mapped ones alone.

    With few points, the field of several beacons costs as much as that of one. Returns indices of
    beacons, and their source.
    """
    known = _GROUPS.get(site)
    if known is None:
        known = _GROUPS[site] = _grouped([alone(beacon) for beacon in site.beacons])
    return known


def keep_sources(site: Site, other: Site) -> None:
    """Reuse the sources of a site for one that differs in the size of moments only, if cached."""
    known = _GROUPS.get(site)
    # The loops of a long coil depend on the direction of its moment.
    if known is None or any(c.length is not None for b in other.beacons for c in b.coils):
        return
    _GROUPS[other] = tuple(
        (rows, _with_moments(source, [other.beacons[k].moments_beacon for k in rows]))
        for rows, source in known
    )


def _with_moments(source: Sources, moments_beacon: list[Array]) -> Sources:
    moment = np.array(moments_beacon)[:, None] if len(moments_beacon) > 1 else moments_beacon[0]
    return source._replace(loops=source.loops._replace(moment=moment))


def _grouped(sources: list[Sources]) -> Groups:
    of_form: dict[object, list[int]] = {}
    for k, source in enumerate(sources):
        loops, mapped = source.loops, k if source.is_mapped else None
        shape = source.excitation.shape, loops.first, loops.centre.shape, loops.radius is None
        shared = (*shape, source.concentric, mapped, source.decay is None)
        of_form.setdefault(shared, []).append(k)
    return tuple((tuple(rows), _stacked([sources[k] for k in rows])) for rows in of_form.values())


def _stacked(sources: list[Sources]) -> Sources:
    if len(sources) == 1:
        return sources[0]
    loops = [source.loops for source in sources]
    radius = [each.radius for each in loops if each.radius is not None]
    decays = [source.decay for source in sources if source.decay is not None]
    return Sources(
        position_world=np.stack([s.position_world for s in sources])[:, None],
        world_from_beacon=np.stack([s.world_from_beacon for s in sources]),
        excitation=np.stack([s.excitation for s in sources])[:, None],
        loops=Loops(
            centre=np.stack([each.centre for each in loops])[:, None],
            moment=np.stack([each.moment for each in loops])[:, None],
            radius=np.stack(radius)[:, None] if radius else None,
            first=loops[0].first,
        ),
        concentric=sources[0].concentric,
        decay=np.stack(decays)[:, None] if decays else None,
    )


def is_sized(beacon: Beacon) -> bool:
    """Return whether a coil of the beacon is declared with a size."""
    return any(coil.radius is not None or coil.length is not None for coil in beacon.coils)


def as_points(beacon: Beacon) -> Beacon:
    """Return the beacon with each coil replaced by a dipole."""
    points = tuple(replace(coil, radius=None, length=None) for coil in beacon.coils)
    return replace(beacon, coils=points)


def _loops(beacon: Beacon) -> Loops:
    coils = beacon.coils
    if not is_sized(beacon):
        whole = tuple(range(len(coils)))
        return Loops(beacon.centres_beacon, beacon.moments_beacon, None, whole)
    nodes, weights = zip(*(_slices(coil) for coil in coils), strict=True)
    count = [len(weight) for weight in weights]
    moment = np.repeat(beacon.moments_beacon, count, axis=0)
    axis = moment / np.linalg.norm(moment, axis=1, keepdims=True)
    centre = np.repeat(beacon.centres_beacon, count, axis=0)
    return Loops(
        centre=centre + np.concatenate(nodes)[:, None] * axis,
        moment=np.concatenate(weights)[:, None] * moment,
        radius=np.repeat([coil.radius or 0.0 for coil in coils], count),
        first=tuple(np.cumsum([0, *count[:-1]]).tolist()),
    )


def _slices(coil: Coil) -> tuple[Array, Array]:
    """Return positions along the axis (m) and weights that sum to one."""
    if coil.length is None:
        return np.zeros(1), np.ones(1)
    return 0.5 * coil.length * _NODES, 0.5 * _WEIGHTS


def coil_fields(source: Sources, offset_beacon: Array) -> AnyArray:
    """Return the field of each coil at its peak current.

    `offset_beacon` (..., 3) or (beacons, n, 3): from the beacon's origin, beacon axes (m). Returns
    (..., coils, 3): beacon axes (T); complex where the ground conducts.
    """
    loops = source.loops
    offset = offset_beacon[..., None, :] - loops.centre
    field: AnyArray
    if loops.radius is None:
        field = dipole_field(offset, loops.moment)
    else:
        field = loop_field(offset, loops.moment, loops.radius)
    if source.decay is not None:
        field = field + conducted_field(offset, loops.moment, source.decay)
    return field if loops.radius is None else np.add.reduceat(field, loops.first, axis=-2)


def coil_fields_by_log_conductivity(source: Sources, offset_beacon: Array) -> ComplexArray | None:
    """Return the derivative of `coil_fields` by the logarithm of the ground's conductivity.

    Returns (..., coils, 3): beacon axes (T); None without conduction.
    """
    if source.decay is None:
        return None
    loops = source.loops
    offset = offset_beacon[..., None, :] - loops.centre
    change = by_log_conductivity(offset, loops.moment, source.decay)
    if loops.radius is None:
        return change
    return np.asarray(np.add.reduceat(change, loops.first, axis=-2))


def coil_fields_and_gradients(source: Sources, offset_beacon: Array) -> tuple[AnyArray, AnyArray]:
    """Return the field of each coil at its peak current, with its gradient.

    `offset_beacon` (..., 3) or (beacons, n, 3): from the beacon's origin, beacon axes (m). Returns
    `field` (..., coils, 3): beacon axes (T); `gradient` (..., coils, 3, 3): ``[i, j] = d field_i /
    d offset_j`` (T/m).
    """
    loops = source.loops
    offset = offset_beacon[..., None, :] - loops.centre
    field: AnyArray
    gradient: AnyArray
    if loops.radius is None:
        field, gradient = dipole_field_and_gradient(offset, loops.moment)
    else:
        field, gradient = loop_field_and_gradient(offset, loops.moment, loops.radius)
    if source.decay is not None:
        field = field + conducted_field(offset, loops.moment, source.decay)
        gradient = gradient + conducted_gradient(offset, loops.moment, source.decay)
    if loops.radius is None:
        return field, gradient
    return (
        np.asarray(np.add.reduceat(field, loops.first, axis=-2)),
        np.asarray(np.add.reduceat(gradient, loops.first, axis=-3)),
    )


def steel_fields(source: Sources, offset_beacon: Array) -> Array:
    """Return what steel adds to `coil_fields`."""
    assert source.steel is not None
    return source.steel.fields(_in_room(source, offset_beacon)) @ source.world_from_beacon


def steel_fields_and_gradients(source: Sources, offset_beacon: Array) -> tuple[Array, Array]:
    """Return what steel adds to `coil_fields_and_gradients`."""
    assert source.steel is not None
    turn = source.world_from_beacon
    field, gradient = source.steel.fields_and_gradients(_in_room(source, offset_beacon))
    return field @ turn, turn.T @ gradient @ turn


def _in_room(source: Sources, offset_beacon: Array) -> Array:
    return np.asarray(source.position_world + offset_beacon @ source.world_from_beacon.T)


class Driven(NamedTuple):
    """Field of coils with known currents."""

    field: Array  # (n, 3) (T)
    along: Array | None  # (n, 3), its derivative along a displacement (T per unit of it)


def driven_dipoles(
    source: Sources, offset_beacon: Array, current: Array, along_beacon: Array | None
) -> Driven:
    """Return the field of coils without a size; concentric ones are summed to one moment.

    `offset_beacon` (..., n, 3): from the beacon's origin, beacon axes (m).
    `current` (..., n, coils): of each coil, as a share of its peak. `along_beacon` (..., n, 3): a
    displacement of the points. Returned in beacon axes.
    """
    centre, moments = source.loops.centre, source.loops.moment
    if source.concentric:
        of_beacon = moments[..., 0, :, :] if moments.ndim > 2 else moments  # without points' axis
        moment, offset = current @ of_beacon, offset_beacon - centre[..., 0, :]
        by = None if along_beacon is None else dipole_field_along(offset, moment, along_beacon)
        return Driven(dipole_field(offset, moment), by)
    moment, offset = current[..., None] * moments, offset_beacon[..., None, :] - centre
    field = np.sum(dipole_field(offset, moment), axis=-2)
    if along_beacon is None:
        return Driven(field, None)
    along = dipole_field_along(offset, moment, along_beacon[..., None, :])
    return Driven(field, np.sum(along, axis=-2))
