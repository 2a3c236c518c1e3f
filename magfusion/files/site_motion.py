"""How a platform moves and what measures it, as a site's file has it."""

from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, Field

from magfusion.files.site_values import array, between, not_singular
from magfusion.files.yaml_files import StrictModel
from magfusion.model.imu_intrinsics import ImuIntrinsics
from magfusion.model.platform_motion import NO_IMU, ImuModel, MotionModel, MotionPrior
from magfusion.units import Array

_AboveZero = Annotated[float, Field(gt=0.0)]
_FromZero = Annotated[float, Field(ge=0.0)]
_Positive = Annotated[_AboveZero, between(1e-12, 1e6)]
_NotNegative = Annotated[_FromZero, between(0.0, 1e6)]
# Beyond scale and alignment, it may undo a wrong unit: degrees, g, or thousandths of it.
_Matrix = Annotated[Array, array(3, 3, largest=1e4), AfterValidator(not_singular)]
_MOTION, _PRIOR = MotionModel(), MotionPrior()
MILLION = 1e6  # ppm in one


class MotionEntry(StrictModel):
    """`magfusion.model.site.MotionModel`, field by field in its order."""

    rest_gyro_rad_s: _Positive = _MOTION.rest_gyro
    rest_accel_m_s2: _Positive = _MOTION.rest_accel
    rest_span_s: Annotated[float, Field(ge=0.2, le=60.0)] = _MOTION.rest_span
    rest_speed_sigma_m_s: _Positive = _MOTION.rest_speed_sigma
    rest_known_speed_m_s: _Positive = _MOTION.rest_known_speed
    speed_sigma_m_s: _Positive = _MOTION.speed_sigma
    accel_sigma_m_s2: _Positive = _MOTION.accel_sigma
    accel_span_s: _Positive = _MOTION.accel_span
    start_speed_sigma_m_s: _Positive = _MOTION.start_speed_sigma


_MILLISECONDS = 0.01  # s; what an undeclared time offset may be


class ImuEntry(StrictModel):
    """Inertial noise and the IMU's clock."""

    gyro_noise: _Positive
    accel_noise: _Positive
    gyro_bias_walk: _NotNegative
    accel_bias_walk: _NotNegative
    gyro_bias_sigma: Annotated[_FromZero, between(0.0, 100.0)]
    accel_bias_sigma: Annotated[_FromZero, between(0.0, 1e3)]
    time_offset_s: Annotated[float, between(-1e10, 1e10)] = 0.0
    time_offset_sigma_s: Annotated[_FromZero, between(0.0, 1e3)] = _MILLISECONDS
    clock_rate_ppm: Annotated[float, between(-1e4, 1e4)] = 0.0
    clock_rate_sigma_ppm: Annotated[_FromZero, between(0.0, 1e4)] = 50.0  # of quartz
    gyro_range_rad_s: Annotated[_AboveZero, between(1e-3, ImuModel.gyro_range)] = (
        ImuModel.gyro_range
    )
    accel_range_m_s2: Annotated[_AboveZero, between(1e-3, ImuModel.accel_range)] = (
        ImuModel.accel_range
    )


class ImuIntrinsicsEntry(StrictModel):
    """`magfusion.model.imu_intrinsics.ImuIntrinsics`, field by field in its order."""

    gyro_matrix: _Matrix = Field(default_factory=lambda: np.eye(3))
    accel_matrix: _Matrix = Field(default_factory=lambda: np.eye(3))
    gyro_g_sensitivity: Annotated[Array, array(3, 3, largest=1.0)] = Field(
        default_factory=lambda: np.zeros((3, 3))
    )

    def intrinsics(self) -> ImuIntrinsics:
        """Return the intrinsics of the entry."""
        return ImuIntrinsics(self.gyro_matrix, self.accel_matrix, self.gyro_g_sensitivity)


class MotionPriorEntry(StrictModel):
    """`magfusion.model.platform_motion.MotionPrior`, field by field in its order."""

    accel_density_m_s2_rthz: Annotated[_AboveZero, between(1e-6, 1e4)]
    angular_accel_density_rad_s2_rthz: Annotated[_AboveZero, between(1e-6, 1e5)]
    rate_sigma_rad_s: Annotated[_AboveZero, between(1e-6, 1e3)] = _PRIOR.rate_sigma

    def prior(self) -> MotionPrior:
        """Return the motion prior of the entry."""
        return MotionPrior(
            self.accel_density_m_s2_rthz,
            self.angular_accel_density_rad_s2_rthz,
            self.rate_sigma_rad_s,
        )


def imu_entry(imu: ImuModel) -> dict[str, Any]:
    """Return the entry of an IMU under its key; nothing where there is none."""
    if imu == NO_IMU:
        return {}
    usual = {
        "clock_rate_ppm": ImuModel.clock_rate,
        "clock_rate_sigma_ppm": ImuModel.clock_rate_sigma,
        "gyro_range_rad_s": ImuModel.gyro_range,
        "accel_range_m_s2": ImuModel.accel_range,
    }
    keys = zip(ImuEntry.model_fields, vars(imu).values(), strict=True)
    entry = {k: ppm(v) if k.endswith("_ppm") else float(v) for k, v in keys if usual.get(k) != v}
    return {"imu": entry}


def intrinsics_entry(intrinsics: ImuIntrinsics | None) -> dict[str, Any]:
    """Return the entry of an IMU's intrinsics under its key; nothing where it is ideal."""
    if intrinsics is None:
        return {}
    return {"imu_intrinsics": {key: value.tolist() for key, value in vars(intrinsics).items()}}


def prior_entry(prior: MotionPrior | None) -> dict[str, Any]:
    """Return the entry of a motion prior under its key; nothing where there is none."""
    if prior is None:
        return {}
    keys = zip(MotionPriorEntry.model_fields, vars(prior).values(), strict=True)
    return {"motion_prior": {key: float(value) for key, value in keys}}


def ppm(value: float) -> float:
    """Return the number that is read back as the same, where there is one."""
    near = value * MILLION
    around = (near, np.nextafter(near, np.inf), np.nextafter(near, -np.inf))
    return float(next((one for one in around if one / MILLION == value), near))
