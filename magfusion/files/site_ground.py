"""The conductivity of the ground as a site's file has it, with a sigma in its own unit.

It is estimated by its logarithm: one sigma up is the conductivity and its sigma together.
"""

import math
from typing import Any

from magfusion.model.ground import conductivity_of
from magfusion.model.site import Site


def log_sigma(conductivity: float, sigma: float) -> float:
    """Return the standard deviation of the logarithm, of one in S/m."""
    return math.log1p(sigma / conductivity) if conductivity else 0.0


def ground_entry(site: Site) -> dict[str, Any]:
    """Return its entry of a site's file; empty where nothing conducts."""
    result = conductivity_of(site)
    if not result:
        return {}
    entry: dict[str, Any] = {"conductivity_s_m": float(result)}
    if site.log_conductivity_sigma:
        sigma = result * math.expm1(site.log_conductivity_sigma)
        entry["sigma"] = {"conductivity_s_m": float(sigma)}
    return entry
