"""The correlation of a site's sigmas next to its file; valid only for unchanged entries."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from magfusion.files.correlation import read_correlation, write_correlation
from magfusion.model.correlation import Component, Correlation
from magfusion.model.parameters import candidates
from magfusion.model.site import Site

UNCHANGED = 1e-6  # relative difference of a sigma that is rounding


def sigma_of(site: Site, component: Component) -> float:
    """Return the sigma that a site declares of a parameter (SI); 0 where it has no such one."""
    surveyed = replace(site, beacons=tuple(b for b in site.beacons if b.unknown is None))
    for parameter, owner in candidates(surveyed):
        if parameter.declared and (parameter.group, owner, parameter.kind) == component[:3]:
            sigma = parameter.si * parameter.sigma(surveyed, owner)
            return (
                float(sigma[component.component]) if 0 <= component.component < len(sigma) else 0.0
            )
    return 0.0


def save_correlation(site: Site, path: Path) -> None:
    """Write a site's correlation, with the sigmas by which a reader sees what was changed since."""
    assert site.correlation is not None
    sigma = np.array([sigma_of(site, p) for p in site.correlation.parameters])
    write_correlation(site.correlation, sigma, path)


def load_correlation(site: Site, path: Path) -> Correlation | None:
    """Read the correlation that belongs to a site.

    A parameter whose sigma was changed since, or whose beacon is gone, is independent now. Raises
    InputError where the file is none of a correlation.
    """
    correlation, sigma = read_correlation(path)
    then = dict(zip(correlation.parameters, sigma, strict=True))
    return correlation.kept(
        lambda p: abs(sigma_of(site, p) - then[p]) <= UNCHANGED * abs(then[p]) and then[p] > 0.0
    )
