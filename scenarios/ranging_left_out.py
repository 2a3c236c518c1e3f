"""What rails and layers do to the field of a passing magnet, which ranging neglects.

Calculated over draws of ``rotating_magnet_ranging.py`` of other seeds, without any estimate: its
root mean square over all places of the magnet, and the length over which its correlation falls to
1/e.  Rounded they are declared there.
"""

from dataclasses import dataclass, replace

import numpy as np
from rotating_magnet_ranging import CROSSING, PAIR, Case, Config, draw_world

from magfusion.simulation.rotor import passing_phasor

LEFT_OUT_SEED, LEFT_OUT_DRAWS, LEFT_OUT_PLACES = 9001, 10, 121


@dataclass(frozen=True)
class LeftOut:
    """What rails and layers do to the field, without any estimate."""

    case: str
    share: float
    length_m: float


def left_out(case: Case) -> LeftOut:
    """Return it over draws of seeds that are ranged nowhere."""
    power, shared, step = 0.0, np.zeros(LEFT_OUT_PLACES), 0.0
    for seed in range(LEFT_OUT_SEED, LEFT_OUT_SEED + LEFT_OUT_DRAWS):
        own = draw_world(case, Config(), np.random.default_rng([seed, 19]))
        assert own.around.steel is not None
        casing = replace(own.around.steel, pipes=own.around.steel.pipes[:1])
        plain = replace(own.around, steel=casing, layers=None)
        for one in own.transits:
            depth = np.linspace(*one.depth, LEFT_OUT_PLACES)
            whole = passing_phasor(own.site, own.shaft, one, own.around, depth)
            known = passing_phasor(own.site, own.shaft, one, plain, depth)
            error = (whole - known) / np.linalg.norm(whole, axis=1)[:, None]
            power += float(np.mean(np.sum(np.abs(error) ** 2, axis=1)))
            for lag in range(LEFT_OUT_PLACES):
                product = np.sum(error[: len(depth) - lag] * error[lag:].conj(), axis=1)
                shared[lag] += float(np.mean(product.real))
            step = float(depth[1] - depth[0])
    separate = int(np.argmax(shared < shared[0] / np.e))
    return LeftOut(case.name, float(np.sqrt(power / (2 * LEFT_OUT_DRAWS))), separate * step)


def main() -> None:
    """Print what is neglected in both cases."""
    for one in (left_out(CROSSING), left_out(PAIR)):
        print(f"{one.case}: {100.0 * one.share:.3f} %, correlated over {one.length_m:.1f} m")


if __name__ == "__main__":
    main()
