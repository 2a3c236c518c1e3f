"""Field of coils along a densely sampled path, interpolated between nodes.

Between two nodes the field follows the cubic of its values and slopes, and off the line between
them its gradient.  A node costs as much as a sample, and there are a tenth as many.
"""

import numpy as np

from magfusion.model.coil_field import Driven, Sources, coil_fields_and_gradients
from magfusion.model.field import driven_field
from magfusion.units import AnyArray, Array

# Relative to the distance to a coil: at this node spacing the cubic errs by some millionths of the
# field, as does the gradient where the path bends away from the line by as much.
NODE_SPACING, LATERAL_SPACING = 0.04, 1e-3
MIN_NODE_SAMPLES, MAX_NODE_SAMPLES = 4, 32  # samples between nodes; with fewer nothing is gained
MIN_POINTS = 64
AT_ONCE = 1 << 11  # samples with one node spacing, that of their nearest coil


def field_along_path(
    source: Sources, position_world: Array, current: AnyArray, along_world: Array | None = None
) -> Driven:
    """Return the field of a source at points of a path, as `driven_field`.

    With a map of field or steel, or where points are too far apart, they are evaluated one by one.
    `position_world` (n, 3): in the order of the path (m).
    """
    if source.is_mapped or len(position_world) < MIN_POINTS:
        return driven_field(source, position_world, current, along_world)
    result = []
    for begin in range(0, len(position_world), AT_ONCE):
        rows = slice(begin, begin + AT_ONCE)
        place, own = position_world[rows], current[..., rows, :]
        along = None if along_world is None else along_world[rows]
        offset = (place - source.position_world) @ source.world_from_beacon
        samples = _from_node_to_node(source, offset)
        if samples < MIN_NODE_SAMPLES:
            result.append(driven_field(source, place, own, along))
        else:
            result.append(_between_nodes(source, offset, own, along, samples))
    if len(result) == 1:
        return result[0]
    by = [part.along for part in result if part.along is not None]
    return Driven(
        np.concatenate([part.field for part in result], axis=-2),
        np.concatenate(by, axis=-2) if by else None,
    )


def _from_node_to_node(source: Sources, offset_beacon: Array) -> int:
    """Return how many samples may separate two nodes, at most `MAX_NODE_SAMPLES`."""
    loops = source.loops
    reach = np.linalg.norm(loops.centre, axis=-1)
    if loops.radius is not None:
        reach = reach + loops.radius
    distance = (
        np.linalg.norm(offset_beacon, axis=-1) - np.max(reach, axis=-1, keepdims=True)[..., 0]
    )
    near, path = float(np.min(distance)), offset_beacon.reshape(-1, *offset_beacon.shape[-2:])[0]
    step = np.diff(path, axis=0)
    if near <= 0.0 or len(step) < MIN_POINTS - 1:
        return 0
    longest = float(np.max(np.linalg.norm(step, axis=1)))
    bent = float(np.max(np.linalg.norm(np.diff(step, axis=0), axis=1)))
    by_step = NODE_SPACING * near / max(longest, 1e-12)
    by_bend = float(np.sqrt(8.0 * LATERAL_SPACING * near / max(bent, 1e-12)))
    return int(min(by_step, by_bend, MAX_NODE_SAMPLES))


def _between_nodes(
    source: Sources,
    offset_beacon: Array,
    current: AnyArray,
    along_world: Array | None,
    samples: int,
) -> Driven:
    count = offset_beacon.shape[-2]
    number = -(-count // samples)  # of intervals between nodes; the last may be shorter
    node = np.minimum(np.arange(number + 1) * samples, count - 1)
    row = np.minimum(np.arange(number * samples), count - 1).reshape(number, samples)
    length = np.maximum(node[1:] - node[:-1], 1)
    share = ((row - node[:-1, None]) / length[:, None])[..., None]
    back = 1.0 - share
    coils, gradients = coil_fields_and_gradients(source, offset_beacon[..., node, :])
    value, slope = _in_world(source, coils), _in_world(source, np.moveaxis(gradients, -1, -3))
    begin = offset_beacon[..., node[:-1], None, :]
    chord = offset_beacon[..., node[1:], None, :] - begin
    lateral = offset_beacon[..., row, :] - begin - share * chord
    weight = np.empty((*lateral.shape[:-1], 8))
    weight[..., :1] = back**2 * (1.0 + 2.0 * share)
    weight[..., 1:2] = share**2 * (3.0 - 2.0 * share)
    weight[..., 2:5] = (share * back**2) * chord + back * lateral
    weight[..., 5:] = share * lateral - (share**2 * back) * chord
    ends = slope[..., :-1, :, :], slope[..., 1:, :, :]
    values = value[..., :-1, None, :], value[..., 1:, None, :]

    def driven(of_coils: AnyArray) -> Array:
        """Return the sum over coils of currents and fields, shape (..., n, 3)."""
        flat = of_coils.reshape(*of_coils.shape[:-3], number * samples, of_coils.shape[-1])
        flat, parts = flat[..., :count, :], range(coils.shape[-2])
        each = [current[..., k, None] * flat[..., 3 * k : 3 * k + 3] for k in parts]
        return np.asarray(np.real(sum(each[1:], each[0])))

    field = driven(weight @ np.concatenate([*values, *ends], axis=-2))
    if along_world is None:
        return Driven(field, None)
    along = (along_world @ source.world_from_beacon)[..., row, :]
    both = np.concatenate([back * along, share * along], axis=-1)
    return Driven(field, driven(both @ np.concatenate(ends, axis=-2)))


def _in_world(source: Sources, of_coils: AnyArray) -> AnyArray:
    """Return vectors of each coil, shape (..., coils, 3), as (..., 3 * coils), world axes."""
    rotated = of_coils.reshape(*source.world_from_beacon.shape[:-2], -1, 3)
    rotated = rotated @ np.swapaxes(source.world_from_beacon, -1, -2)
    return np.asarray(rotated.reshape(*of_coils.shape[:-2], -1))
