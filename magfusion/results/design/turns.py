"""Beacons whose coils are driven in turn: each new one has its own slots in a longer cycle."""

from dataclasses import replace

from magfusion.model.site import Beacon, Slots


def is_in_turn(beacon: Beacon) -> bool:
    """Return whether a beacon's coils are driven in time slots."""
    return any(slot is not None for _, slot in beacon.tones)


def in_turn(template: Beacon, number: int, count: int) -> Beacon:
    """Return one of several copies of a beacon, in its own slots of the common cycle.

    Silent slots come first, so that no share of a window is overestimated. `number`: index of the
    copy, from zero. `count`: number of copies.
    """
    own = sorted({coil.slot for coil in template.coils if coil.slot is not None})
    slots = template.slots
    silent = slots.count - len(own) if isinstance(slots, Slots) else 0
    first = silent + number * len(own)
    coils = tuple(
        coil if coil.slot is None else replace(coil, slot=first + own.index(coil.slot))
        for coil in template.coils
    )
    if isinstance(slots, Slots):
        slots = replace(slots, count=silent + count * len(own))
    return replace(template, coils=coils, slots=slots)


def all_in_turn(template: Beacon, placed: list[Beacon]) -> tuple[Beacon, ...]:
    """Return copies at the positions of some beacons, each in its own slots."""
    return tuple(
        replace(
            in_turn(template, number, len(placed)),
            position_world=beacon.position_world,
            world_from_beacon=beacon.world_from_beacon,
        )
        for number, beacon in enumerate(placed)
    )


def cycle_of(template: Beacon, count: int) -> float | None:
    """Return the length (s) of a cycle of several copies; None where a host decides."""
    slots = in_turn(template, 0, count).slots
    return slots.cycle if isinstance(slots, Slots) else None
