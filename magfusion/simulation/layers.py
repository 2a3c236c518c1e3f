"""Horizontal ground layers under air, which the model's full space neglects.

The fields are computed by empymod (D. Werthmueller, Geophysics 82(6), 2017), which includes the
reflections at the layers.  They are smooth in the platform's range, so they are evaluated on a grid
of Chebyshev points about it, and interpolated.
"""

from dataclasses import dataclass
from itertools import pairwise
from types import ModuleType

import numpy as np
from scipy.interpolate import BarycentricInterpolator

from magfusion.errors import InputError
from magfusion.model.physics.dipole import dipole_field
from magfusion.model.site import Beacon
from magfusion.units import MU0_OVER_4PI, Array, ComplexArray, IntArray

AIR = 1e-12  # S/m
EXACT = 1e-7  # of interpolation
MAX_NODES = 20  # along an axis
THINNEST = 1e-3  # m; of the box about the platform


@dataclass(frozen=True)
class Layers:
    """Ground by layers, air above."""

    top: tuple[float, ...]  # height of the upper side of each (m), from above
    conductivity: tuple[float, ...]  # of each (S/m)

    def of(self, height: Array | float) -> IntArray:
        """Return the index of the layer at each height, zero for air."""
        number = np.searchsorted(-np.array(self.top), -np.asarray(height), side="right")
        return np.asarray(number, dtype=np.int64)


def layers_option(text: str) -> Layers:
    """Parse ``height:conductivity`` of each layer, from above, separated by commas."""
    try:
        pairs = [tuple(float(number) for number in part.split(":")) for part in text.split(",")]
        top, conductivity = zip(*((height, value) for height, value in pairs), strict=True)
    except ValueError:
        top, conductivity = (), ()
    falls = all(above > below for above, below in pairwise(top))
    if not top or not falls or not all(0.0 < value < 1e3 for value in conductivity):
        raise InputError(
            f"--ground {text!r}: write height:conductivity of each layer in m and S/m, from above,"
            " e.g. 0:0.01,-20:0.05; above the first layer is air"
        )
    return Layers(top, conductivity)


def layered_effect(beacon: Beacon, point_world: Array, layers: Layers) -> ComplexArray:
    """Return the contribution of layered ground to the field of each coil at its peak current.

    The coil is approximated by a dipole. `point_world` (n, 3): all in one layer (m). Returns
    (n, coils, 3): world axes (T). Raises InputError where empymod is not installed, the platform
    passes from one layer to another, or comes too close to a beacon for a polynomial.
    """
    low, high = np.min(point_world, axis=0), np.max(point_world, axis=0)
    if layers.of(low[2]) != layers.of(high[2]):
        raise InputError(
            f"ground: the platform moves between {low[2]:g} and {high[2]:g} m, through the surface"
            " of a layer; give a box inside one layer"
        )
    effects = []
    for coil in beacon.coils:
        centre_world = beacon.position_world + beacon.world_from_beacon @ coil.centre_beacon
        nodes = _nodes(low, high, centre_world, layers, beacon.name)
        frequency_hz = coil.frequency_hz or beacon.frequency_hz
        moment_world = beacon.world_from_beacon @ coil.moment_beacon
        values = _on_grid(nodes, centre_world, moment_world, frequency_hz, layers)
        effects.append(_interpolated(nodes, values, point_world))
    return np.stack(effects, axis=1)


def _nodes(
    low: Array, high: Array, centre_world: Array, layers: Layers, name: str
) -> tuple[Array, ...]:
    """Return Chebyshev points on each axis, in a number set by the nearest singularity."""
    middle, half = 0.5 * (low + high), np.maximum(0.5 * (high - low), THINNEST)
    mirrored = [[*centre_world[:2], 2.0 * top - centre_world[2]] for top in layers.top]
    rate = np.full(3, np.inf)  # of convergence: by how much each node makes the error smaller
    for point in (centre_world, *np.array(mirrored)):
        gap = np.abs(point - np.clip(point, low, high))
        across = np.sqrt(np.maximum(np.sum(gap**2) - gap**2, 0.0))
        singular = (point - middle + 1j * across) / half
        root = np.sqrt(singular**2 - 1.0)
        ellipse = np.maximum(np.abs(singular + root), np.abs(singular - root))
        rate = np.minimum(rate, np.log(ellipse))
    count = np.ceil(-np.log(EXACT) / np.maximum(rate, 1e-9))
    if np.any(count > MAX_NODES):
        raise InputError(
            f"ground: the platform comes too close to beacon {name}, or to a surface, for its range"
            " of motion; give a smaller box, or omit --ground"
        )
    return tuple(
        m + h * np.cos(np.pi * (np.arange(n) + 0.5) / n)
        for m, h, n in zip(middle, half, np.maximum(count.astype(int), 3), strict=True)
    )


def _on_grid(
    nodes: tuple[Array, ...],
    centre_world: Array,
    moment_world: Array,
    frequency_hz: float,
    layers: Layers,
) -> ComplexArray:
    """Return the contribution of the ground, shape (x, y, z, 3)."""
    x, y = np.meshgrid(nodes[0], nodes[1], indexing="ij")
    planes = [
        _in_plane(x.ravel(), y.ravel(), float(z), centre_world, moment_world, frequency_hz, layers)
        for z in nodes[2]
    ]
    out = np.stack([plane.reshape(*x.shape, 3) for plane in planes], axis=2)
    grid = np.stack(np.meshgrid(*nodes, indexing="ij"), axis=-1)
    return out - dipole_field(grid - centre_world, moment_world)


def layered_effect_at(
    centre_world: Array,
    moment_world: Array,
    frequency_hz: float,
    point_world: Array,
    layers: Layers,
) -> ComplexArray:
    """Return the ground's contribution to a dipole's field at one height, shape (n, 3).

    `point_world` (n, 3) (m); the height is that of the first.
    """
    x, y = point_world[:, 0], point_world[:, 1]
    height = float(point_world[0, 2])
    point_world = np.column_stack([x, y, np.full(len(x), height)])
    whole = _in_plane(x, y, height, centre_world, moment_world, frequency_hz, layers)
    return whole - dipole_field(point_world - centre_world, moment_world)


def _in_plane(
    x: Array,
    y: Array,
    height: float,
    centre_world: Array,
    moment_world: Array,
    frequency_hz: float,
    layers: Layers,
) -> ComplexArray:
    """Return the field of a dipole in layers at points of one height, shape (n, 3) (T)."""
    empymod = _empymod()
    size = float(np.linalg.norm(moment_world))
    azimuth = np.degrees(np.arctan2(moment_world[1], moment_world[0]))
    dip = np.degrees(np.arcsin(moment_world[2] / size))
    to_tesla = 2j * np.pi * frequency_hz * (4.0 * np.pi * MU0_OVER_4PI) ** 2 * size
    out = np.empty((len(x), 3), dtype=np.complex128)
    for axis, angles in enumerate(((0.0, 0.0), (90.0, 0.0), (0.0, 90.0))):
        out[:, axis] = to_tesla * empymod.bipole(
            [*centre_world, azimuth, dip],
            [x, y, height, *angles],
            depth=[*layers.top, -np.inf],  # axes with z up
            res=[1.0 / AIR, *(1.0 / c for c in layers.conductivity)],
            freqtime=frequency_hz,
            epermH=[0.0] * (1 + len(layers.top)),  # no displacement currents
            msrc=True,
            mrec=True,
            verb=0,
        )
    return out


def _interpolated(nodes: tuple[Array, ...], values: ComplexArray, point: Array) -> ComplexArray:
    """Return the interpolated values at points (n, 3), by polynomials on each axis."""
    weight = [
        np.asarray(BarycentricInterpolator(own, np.eye(len(own)))(point[:, axis]))
        for axis, own in enumerate(nodes)
    ]
    return np.asarray(np.einsum("na,nb,nc,abcx->nx", *weight, values, optimize=True))


def _empymod() -> ModuleType:
    try:
        import empymod
    except ImportError:
        raise InputError(
            "ground: layers require empymod; install it with pip install magfusion[ground]"
        ) from None
    return empymod
