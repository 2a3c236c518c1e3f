"""The correlation of a site's sigmas beside its file; it holds only for what was left as it was."""

from pathlib import Path

import numpy as np

from magfusion.correlation import Correlation, Parameter
from magfusion.correlation_file import read_correlation, write_correlation
from magfusion.site import Site
from magfusion.units import Array

UNCHANGED = 1e-6  # relative difference of a sigma that is rounding


def sigma_of(site: Site, parameter: Parameter) -> float:
    """Return the sigma that a site declares of a parameter (SI); 0 where it has no such one."""
    group, owner, kind, component = parameter
    sensor = site.platform.magnetometer.sigma
    own: dict[tuple[str, str], Array] = {
        ("magnetometer", "matrix"): sensor.matrix.ravel(),
        ("magnetometer", "offset"): sensor.offset,
        ("extrinsics", "rotation"): sensor.rotation_sensor,
        ("extrinsics", "position"): sensor.position_body,
        ("time-offset", "time_offset"): np.array([site.platform.imu.time_offset_sigma]),
    }
    if group in ("beacons", "moments"):
        beacon = next((b for b in site.beacons if b.name == owner and b.unknown is None), None)
        if beacon is None:
            return 0.0
        own = {
            ("beacons", "rotation"): beacon.sigma.rotation_beacon,
            ("beacons", "position"): beacon.sigma.position_world,
            ("moments", "log_moment"): beacon.sigma.log_moment,
        }
    found = own.get((group, kind), np.zeros(0))
    return float(found[component]) if 0 <= component < len(found) else 0.0


def save_correlation(site: Site, path: Path) -> None:
    """Write a site's correlation, with the sigmas by which a reader sees what was changed since."""
    assert site.correlation is not None
    sigma = np.array([sigma_of(site, p) for p in site.correlation.parameters])
    write_correlation(site.correlation, sigma, path)


def load_correlation(site: Site, path: Path) -> Correlation | None:
    """Read the correlation that belongs to a site.

    A parameter whose sigma was changed since, or whose beacon is gone, is independent now.

    Parameters
    ----------
    site : Site
    path : Path

    Raises
    ------
    InputError
        Where the file is none of a correlation.
    """
    correlation, sigma = read_correlation(path)
    then = dict(zip(correlation.parameters, sigma, strict=True))
    return correlation.kept(
        lambda p: abs(sigma_of(site, p) - then[p]) <= UNCHANGED * abs(then[p]) and then[p] > 0.0
    )
