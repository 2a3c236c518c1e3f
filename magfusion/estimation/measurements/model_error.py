"""How many epochs have the same model error: those that lie closer than iron's field changes.

Iron is constant in place, so that its error does not average over epochs at one place, nor over
visits to it.  An error of correlation exp(-d / length) leaves N epochs the information of N / A
independent ones, where A is the sum of an epoch's correlations with all; each is weighed so.
"""

import numpy as np

from magfusion.units import Array, IntArray

LONGEST_REST = 20.0  # s; online, longer ones are held together no more: the state has moved on
CELLS = 4.0  # a length, in which epochs are counted together
CHUNK = 1_000_000  # pairs at a time


def alike_in_batch(position_world: Array, length: float) -> Array:
    """Return how many epochs of a log have the model error of each, shape (n,).

    Parameters
    ----------
    position_world : ndarray, shape (n, 3)
        (m)
    length : float
        Of correlation (m).
    """
    count = len(position_world)
    if length <= 0.0:
        return np.ones(count)
    _, members, centre = cells(position_world, length)
    alike, step = np.empty(count), max(1, CHUNK // len(centre))
    for lo in range(0, count, step):
        apart = position_world[lo : lo + step, None] - centre
        alike[lo : lo + step] = np.exp(-np.linalg.norm(apart, axis=2) / length) @ members
    return np.maximum(alike, 1.0)


def cells(position_world: Array, length: float) -> tuple[IntArray, IntArray, Array]:
    """Return which cell of space each place is in, how many are there, and their centres.

    Parameters
    ----------
    position_world : ndarray, shape (n, 3)
        (m)
    length : float
        Of correlation (m).

    Returns
    -------
    owner : int ndarray, shape (n,)
    members : int ndarray, shape (cells,)
    centre : ndarray, shape (cells, 3)
    """
    cell = np.floor(position_world * (CELLS / length)).astype(np.int64)
    _, owner, members = np.unique(cell, axis=0, return_inverse=True, return_counts=True)
    owner = owner.ravel()
    total = np.stack([np.bincount(owner, weights=axis) for axis in position_world.T], axis=1)
    return owner, members, total / members[:, None]


def alike_online(speed: float, step: float, length: float) -> float:
    """Return about how many epochs have the model error of one, at a steady pace.

    Parameters
    ----------
    speed : float
        (m/s)
    step : float
        Time between epochs (s).
    length : float
        Of correlation (m).
    """
    if length <= 0.0:
        return 1.0
    moved = max(speed * step / length, 2.0 * step / LONGEST_REST)
    return float(1.0 / np.tanh(0.5 * moved))
