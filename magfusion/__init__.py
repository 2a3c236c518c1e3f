"""Navigation from magnetic beacons and inertial sensors.

Conventions of the whole package.

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
    SI in memory and in files: s, m, rad, T, A m^2.  Other units are a suffix of the name
    (``_deg``, ``_hz``, ``_ns``, ``_nt``).  Times are seconds since the log's epoch.
Phasors
    ``field(t) = Re(phasor * exp(+2j*pi*frequency_hz*(t - epoch)))`` in the magnetometer's own
    axes, as measured by the instrument: ``measured = matrix @ field_sensor + offset``.
Standard deviations end in ``_sigma``, covariances in ``_cov``.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from magfusion.errors import EstimationError as EstimationError
    from magfusion.errors import InputError as InputError
    from magfusion.estimation.batch.settings import SmootherSettings as SmootherSettings
    from magfusion.estimation.integrity.judge import judge_result as judge_result
    from magfusion.estimation.measurements import gtsam as gtsam
    from magfusion.estimation.online.corrected import corrected as corrected
    from magfusion.estimation.online.navigator import Navigator as Navigator
    from magfusion.estimation.online.navigator_settings import (
        NavigatorSettings as NavigatorSettings,
    )
    from magfusion.estimation.snapshot.likelihood import fix_epochs as fix_epochs
    from magfusion.files.open import open_log as open_log
    from magfusion.files.site import load_site as load_site
    from magfusion.files.site import save_site as save_site
    from magfusion.model.aiding import AidingSamples as AidingSamples
    from magfusion.model.field import observe as observe
    from magfusion.model.parameters import initial_calibration as initial_calibration
    from magfusion.model.parameters.parameter import Calibration as Calibration
    from magfusion.model.physics.dipole import dipole_field as dipole_field
    from magfusion.model.samples import FieldSamples as FieldSamples
    from magfusion.model.samples import Log as Log
    from magfusion.model.site import Site as Site
    from magfusion.model.trajectory import Trajectory as Trajectory
    from magfusion.model.trust import Finding as Finding
    from magfusion.model.trust import Trust as Trust
    from magfusion.model.trust import Verdict as Verdict
    from magfusion.results.errors import trajectory_errors as trajectory_errors
    from magfusion.results.smoothed import SmoothedLog as SmoothedLog
    from magfusion.results.smoothed import smooth as smooth
    from magfusion.results.trajectory import ResultTrajectory as ResultTrajectory
    from magfusion.results.trajectory import collect_states as collect_states
    from magfusion.simulation.log import SimulationConfig as SimulationConfig
    from magfusion.simulation.log import simulate_log as simulate_log

    __version__: str

# What most users need, and where it is; the file is read when the name is first asked for.
_HOMES = {
    "Calibration": "model.parameters.parameter",
    "EstimationError": "errors",
    "AidingSamples": "model.aiding",
    "FieldSamples": "model.samples",
    "Finding": "model.trust",
    "InputError": "errors",
    "Log": "model.samples",
    "Navigator": "estimation.online.navigator",
    "NavigatorSettings": "estimation.online.navigator_settings",
    "ResultTrajectory": "results.trajectory",
    "SimulationConfig": "simulation.log",
    "Site": "model.site",
    "SmoothedLog": "results.smoothed",
    "SmootherSettings": "estimation.batch.settings",
    "Trajectory": "model.trajectory",
    "Trust": "model.trust",
    "Verdict": "model.trust",
    "collect_states": "results.trajectory",
    "corrected": "estimation.online.corrected",
    "dipole_field": "model.physics.dipole",
    "fix_epochs": "estimation.snapshot.likelihood",
    "initial_calibration": "model.parameters",
    "judge_result": "estimation.integrity.judge",
    "load_site": "files.site",
    "observe": "model.field",
    "open_log": "files.open",
    "save_site": "files.site",
    "simulate_log": "simulation.log",
    "smooth": "results.smoothed",
    "trajectory_errors": "results.errors",
}
__all__ = list(_HOMES)


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        result: Any = version("magfusion")
    elif name == "gtsam":  # a module: not in __all__, where it would hide GTSAM's own
        result = import_module("magfusion.estimation.measurements.gtsam")
    elif name in _HOMES:
        result = getattr(import_module(f"magfusion.{_HOMES[name]}"), name)
    else:
        raise AttributeError(f"module 'magfusion' has no attribute {name!r}")
    globals()[name] = result
    return result


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOMES, "gtsam", "__version__"})
