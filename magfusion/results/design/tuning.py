"""Distribution of a moment budget, and of frequencies, among placed beacons."""

from collections.abc import Callable
from itertools import permutations

import numpy as np

from magfusion.model.site import Beacon
from magfusion.results.design.exchange import LESS, Objective, value_of
from magfusion.results.design.layout_information import LayoutInformation
from magfusion.results.design.pattern import stronger, tuned
from magfusion.units import Array

STEPS = (0.2, 0.1, 0.05)  # of a beacon's even share, given from one to another
MIN_SHARE = 0.2  # of it, that a beacon keeps


def divided(
    information: LayoutInformation,
    beacons: tuple[Beacon, ...],
    objective: Objective,
    in_time: Callable[[], bool],
) -> tuple[tuple[Beacon, ...], Array]:
    """Move moment from one beacon to another as long as the objective improves.

    `beacons`: each with an equal share. Returns `beacons`: with the same sum of moments;
    `share` (beacons,): relative to the initial moments.
    """
    share = np.ones(len(beacons))

    def value(shares: Array) -> float:
        some = [stronger(b, s) for b, s in zip(beacons, shares.tolist(), strict=True)]
        return value_of(information, some, objective)[0]

    best = value(share)
    for step in STEPS:
        gained = True
        while gained and in_time():
            gained = False
            for donor, recipient in permutations(range(len(beacons)), 2):
                other = share.copy()
                other[donor] -= step
                other[recipient] += step
                if other[donor] < MIN_SHARE - 1e-9:
                    continue
                reached = value(other)
                if reached < best - LESS * abs(best):
                    share, best, gained = other, reached, True
    result = tuple(stronger(b, s) for b, s in zip(beacons, share.tolist(), strict=True))
    return result, share


def assigned(
    information: LayoutInformation,
    beacons: tuple[Beacon, ...],
    free_hz: Array,
    objective: Objective,
    in_time: Callable[[], bool],
) -> tuple[Beacon, ...]:
    """Exchange frequencies between beacons, and for free ones, as long as the objective improves.

    It improves only where the ground conducts or the magnetometer's response is not flat. `free_hz`
    (k,): unused frequencies.
    """
    tones = [b.tone_frequencies_hz for b in beacons]
    allowed = free_hz[: len(free_hz) // len(tones[0]) * len(tones[0])].reshape(-1, len(tones[0]))
    sets = [*tones, *allowed]
    order = list(range(len(beacons)))

    def built(numbers: list[int]) -> tuple[Beacon, ...]:
        return tuple(tuned(b, sets[k]) for b, k in zip(beacons, numbers, strict=True))

    best, gained = value_of(information, built(order), objective)[0], True
    while gained and in_time():
        gained = False
        for slot in range(len(order)):
            for number in range(len(sets)):
                other = [order[slot] if k == number else k for k in order]
                other[slot] = number
                if other == order:
                    continue
                reached = value_of(information, built(other), objective)[0]
                if reached < best - LESS * abs(best):
                    order, best, gained = other, reached, True
    return built(order)
