"""Test of the declared moments against gains estimated epoch by epoch."""

from collections.abc import Iterator

import numpy as np

from magfusion.estimation.data_checks.statistics import MAD_TO_SIGMA
from magfusion.estimation.snapshot.fix import Fixes
from magfusion.model.site import Site
from magfusion.model.trust import Finding, Verdict

BEYOND = 3.0  # declared sigmas
STEADY = 2.0  # times its own scatter, for a gain error that is equal everywhere


def gains_of(fixes: Fixes, site: Site, spread: float) -> Iterator[Finding]:
    """Yield a finding for estimated gains, and one for each wrong moment.

    `fixes`: with a gain of every beacon. `spread`: standard deviation of a log-gain.
    """
    yield Finding(
        "gain_spread",
        f"The fields differ from those of the site by a factor of each beacon that varies by"
        f" {100.0 * spread:.2g} % with position; it is estimated with the pose at each epoch."
        " Causes are iron near coils or path, or varying drives. A map of the field (magfusion"
        " calibrate fieldmap) gives smaller errors.",
        Verdict.TRUSTWORTHY,
    )
    owner = np.array([name for name, _ in site.channels])
    for beacon in site.beacons:
        own = fixes.log_gain[fixes.determined[:, 0], 0][:, owner == beacon.name][:, 0]
        if len(own) == 0:
            continue
        middle = float(np.median(own))
        declared = float(np.max(beacon.sigma.log_moment))
        scatter = MAD_TO_SIGMA * float(np.median(np.abs(own - middle)))
        if abs(middle) > max(BEYOND * declared, STEADY * scatter):
            yield Finding(
                "moments",
                f"The field of beacon {beacon.name} is {np.exp(middle):.3g} times that of its"
                " declared moments, wherever it is detected. Check its current and turns.",
                Verdict.DOUBTFUL,
                abs(middle) / max(declared, 1e-3),
            )
