"""What the data said about the calibration, in words and as a site that can be fed back in."""

from dataclasses import dataclass, replace

import numpy as np

from magfusion.correlation import Correlation, joined
from magfusion.parameters import Block, Calibration, difference
from magfusion.prior import parameters_of
from magfusion.site import Beacon, Site
from magfusion.site_moves import MICROTESLA
from magfusion.units import DEGREE, NANOTESLA, Array

DETERMINED_RATIO = 0.5  # posterior over prior sigma below which the data, not the prior, spoke

_AXES = ("x", "y", "z")
_DISPLAY = {
    "rotation": ("deg", DEGREE),
    "phase": ("deg", DEGREE),
    "declination": ("deg", DEGREE),
    "drift": ("ppm", 1e-6),
    "offset": ("nt", NANOTESLA / MICROTESLA),
    "strength": ("nt", NANOTESLA / MICROTESLA),
}
_OF_THE_LOG = ("phase", "earth")  # groups whose priors no site declares
_UNITS = {"position": "m", "time_offset": "s"}


@dataclass(frozen=True)
class Finding:
    """One calibration parameter after the fit.

    Parameters
    ----------
    name : str
        E.g. ``A.position_x_m`` or ``magnetometer.matrix_yx``; carries the unit of the figures.
    change : float
        From the declared value.
    sigma, prior_sigma : float
        Posterior and prior standard deviation.
    """

    name: str
    change: float
    sigma: float
    prior_sigma: float

    @property
    def determined(self) -> bool:
        """Whether the data, rather than the prior, fixed the parameter."""
        return self.sigma < DETERMINED_RATIO * self.prior_sigma


def _component_names(block: Block) -> list[str]:
    count = len(block.sigma)
    unit = _DISPLAY[block.kind][0] if block.kind in _DISPLAY else _UNITS.get(block.kind, "")
    tail = f"_{unit}" if unit else ""
    if block.kind == "matrix":
        return [f"{block.name}_{row}{column}" for row in _AXES for column in _AXES]
    if block.kind in ("rotation", "position", "offset"):
        return [f"{block.name}_{axis}{tail}" for axis in _AXES]
    if count == 1:
        return [f"{block.name}{tail}"]
    return [f"{block.name}_{i}{tail}" for i in range(count)]


def findings(
    declared: Calibration, fitted: Calibration, blocks: tuple[Block, ...], cov: Array
) -> list[Finding]:
    """Return every estimated parameter with its change and its sigmas.

    Parameters
    ----------
    declared, fitted : Calibration
    blocks : tuple of Block
    cov : ndarray, shape (dimension, dimension)
        Posterior covariance.
    """
    change = difference(declared, fitted, blocks)
    sigma = np.sqrt(np.diagonal(cov))
    out = []
    for block in blocks:
        scale = _DISPLAY[block.kind][1] if block.kind in _DISPLAY else 1.0
        rows = range(block.columns.start, block.columns.stop)
        for name, row, prior in zip(_component_names(block), rows, block.sigma, strict=True):
            out.append(Finding(name, change[row] / scale, sigma[row] / scale, prior / scale))
    return out


def refined_site(
    fitted: Calibration, blocks: tuple[Block, ...], cov: Array, told: list[Finding], log_name: str
) -> Site:
    """Return the site with the fitted values and their posterior sigmas.

    Drive phase and drift of an unsynchronised beacon belong to the log, not to the site: they are
    told in the site's ``calibration`` record and nowhere else.  An Earth field that was estimated
    takes the place of the location's.
    """
    site, sigma = fitted.site, np.sqrt(np.diagonal(cov))
    for block in blocks:
        site = _with_sigma(site, block, sigma[block.columns])
    if any(block.group == "earth" for block in blocks):
        site = replace(site, location=None)
    imu = replace(site.platform.imu, time_offset=fitted.time_offset)
    for block in blocks:
        if block.kind == "time_offset":
            imu = replace(imu, time_offset_sigma=float(sigma[block.columns][0]))
    record = {
        "log": log_name,
        "determined": [f.name for f in told if f.determined],
        "undetermined": [f.name for f in told if not f.determined],
        "drive": {f.name: [float(f.change), float(f.sigma)] for f in told if _is_drive(f.name)},
    }
    return replace(
        site,
        platform=replace(site.platform, imu=imu),
        calibration=record,
        correlation=_correlation(site, blocks, cov),
    )


def _correlation(site: Site, blocks: tuple[Block, ...], cov: Array) -> Correlation | None:
    """Return how the errors go together now: those found anew, and those left as they were."""
    known = parameters_of(blocks)
    own = [i for i, parameter in enumerate(known) if parameter.group not in _OF_THE_LOG]
    fresh = None
    if own:
        part = cov[np.ix_(own, own)]
        sigma = np.sqrt(np.diagonal(part))
        fresh = Correlation(tuple(known[i] for i in own), part / sigma[:, None] / sigma)
    before = site.correlation
    return joined([fresh, before and before.kept(lambda p: p not in known)])


def _is_drive(name: str) -> bool:
    kind = name.rsplit(".", maxsplit=1)[-1]
    return kind.startswith(("phase", "drift"))


def _with_sigma(site: Site, block: Block, sigma: Array) -> Site:
    if block.group in ("beacons", "moments"):
        index = [b.name for b in site.beacons].index(block.owner)
        beacon = _beacon_with_sigma(site.beacons[index], block.kind, sigma)
        return replace(site, beacons=(*site.beacons[:index], beacon, *site.beacons[index + 1 :]))
    if block.group not in ("magnetometer", "extrinsics"):
        return site
    sensor = site.platform.magnetometer
    changed = {
        "matrix": {"matrix": sigma.reshape(3, 3)} if len(sigma) == 9 else {},
        "offset": {"offset": MICROTESLA * sigma},
        "rotation": {"rotation_sensor": sigma},
        "position": {"position_body": sigma},
    }[block.kind]
    sensor = replace(sensor, sigma=replace(sensor.sigma, **changed))
    return replace(site, platform=replace(site.platform, magnetometer=sensor))


def _beacon_with_sigma(beacon: Beacon, kind: str, sigma: Array) -> Beacon:
    name = {"rotation": "rotation_beacon", "position": "position_world"}.get(kind, kind)
    return replace(beacon, sigma=replace(beacon.sigma, **{name: sigma}))
