"""Navigation from magnetic beacons and inertial sensors.

Conventions, stated once for the whole package.

Frames
    ``world`` (local level, z up), ``body`` (the IMU's axes and origin), ``sensor`` (the
    magnetometer triad), ``beacon`` (the coil axes).  A rotation or pose is named
    ``a_from_b``; a vector carries the frame whose axes it is written in as a suffix
    (``field_body``).  ``position_world`` is the body's origin unless another point is named;
    an offset points from the beacon to the sensor.
Perturbations
    On the right (body side) and in GTSAM's order: rotation, then translation, both in body
    axes (``Pose3``); accelerometer, then gyroscope (``imuBias``).
Residuals
    Predicted minus measured.
Units
    SI in memory and in files: s, m, rad, T, A m^2.  Anything else says so in its name
    (``_deg``, ``_hz``, ``_ns``, ``_nt``).  Times are seconds since the log's epoch.
Phasors
    ``field(t) = Re(phasor * exp(+2j*pi*frequency_hz*(t - epoch)))`` in the magnetometer's own
    axes, as the instrument gave it: ``measured = matrix @ field_sensor + offset``.
Standard deviations end in ``_sigma``, covariances in ``_cov``.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from magfusion.errors import EstimationError as EstimationError
    from magfusion.errors import InputError as InputError
    from magfusion.estimation.batch.batch import SmootherSettings as SmootherSettings
    from magfusion.estimation.batch.batch import smooth as smooth
    from magfusion.estimation.integrity.judge import judged as judged
    from magfusion.estimation.online.navigator import Navigator as Navigator
    from magfusion.estimation.online.navigator import NavigatorSettings as NavigatorSettings
    from magfusion.estimation.snapshot.likelihood import fix_epochs as fix_epochs
    from magfusion.files.open import open_log as open_log
    from magfusion.files.site import load_site as load_site
    from magfusion.files.site import save_site as save_site
    from magfusion.model.samples import Log as Log
    from magfusion.model.site import Site as Site
    from magfusion.model.trajectory import Trajectory as Trajectory
    from magfusion.results.errors import trajectory_errors as trajectory_errors
    from magfusion.simulation.log import simulate_log as simulate_log

# What most users need, and where it is; the file is read when the name is first asked for.
_HOMES = {
    "EstimationError": "errors",
    "InputError": "errors",
    "Log": "model.samples",
    "Navigator": "estimation.online.navigator",
    "NavigatorSettings": "estimation.online.navigator",
    "Site": "model.site",
    "SmootherSettings": "estimation.batch.batch",
    "Trajectory": "model.trajectory",
    "fix_epochs": "estimation.snapshot.likelihood",
    "judged": "estimation.integrity.judge",
    "load_site": "files.site",
    "open_log": "files.open",
    "save_site": "files.site",
    "simulate_log": "simulation.log",
    "smooth": "estimation.batch.batch",
    "trajectory_errors": "results.errors",
}
__all__ = list(_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'magfusion' has no attribute {name!r}")
    found = getattr(import_module(f"magfusion.{_HOMES[name]}"), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOMES})
