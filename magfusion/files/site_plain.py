"""Values of a site's file as they are written, and models as they are read."""

from collections.abc import Mapping
from dataclasses import MISSING, fields
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.files.site_motion import MILLION
from magfusion.files.yaml_files import StrictModel
from magfusion.units import DEGREE, Array

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Model = TypeVar("Model", bound="DataclassInstance")


def rotation_of(rpy_deg: Array) -> Array:
    """Return the matrix of roll, pitch and yaw (degrees)."""
    roll, pitch, yaw = Rotation.from_rotvec(np.diag(rpy_deg) * DEGREE).as_matrix()
    return np.asarray(yaw @ pitch @ roll)


def model_of(model: type[Model], entry: StrictModel) -> Model:
    """Return a model from its entry, whose keys are the model's fields in order, with units."""
    given = {
        field.name: _si(key, value) if key != field.name else value
        for field, (key, value) in zip(fields(model), entry, strict=True)
        if key in entry.model_fields_set or field.default is MISSING
    }
    return model(**given)


def _si(key: str, value: float) -> float:
    """Return a value in the model's unit: the key's name ends with its own."""
    if key.endswith("_ppm"):
        return value / MILLION
    return value * DEGREE if key.endswith("_deg") else value


def plain(value: Any) -> Any:
    """Return plain values of mappings, lists and arrays."""
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    return value


def degrees(angle: Array | float) -> Any:
    """Return angles (rad) in degrees."""
    # 1e-12 deg is what arithmetic leaves of an angle: 2.0000000000000004 is written as 2.0.
    return plain(np.round(np.asarray(angle) / DEGREE, 12) + 0.0)


def rpy_deg(matrix: Array) -> Any:
    """Return roll, pitch, yaw; Rotation.as_euler loses 1e-7 rad where the pitch is near 90 deg."""
    yaw = np.arctan2(matrix[1, 0], matrix[0, 0])
    pitch = np.arctan2(-matrix[2, 0], np.hypot(matrix[0, 0], matrix[1, 0]))
    rotated, raised = Rotation.from_rotvec(
        np.array([[0.0, 0.0, yaw], [0.0, pitch, 0.0]])
    ).as_matrix()
    return degrees(
        np.array([Rotation.from_matrix((rotated @ raised).T @ matrix).as_rotvec()[0], pitch, yaw])
    )


def sigma_entry(sigma: Array) -> Any:
    """Return standard deviations, one number where all are equal."""
    return plain(sigma.flat[0] if np.all(sigma == sigma.flat[0]) else sigma)


def degree_sigma_entry(sigma: Array) -> Any:
    """Return those of angles (rad) in degrees."""
    # Relative here, where degrees rounds absolutely: a sigma may be small.
    return sigma_entry(np.vectorize(lambda s: float(f"{s / DEGREE:.15g}"))(sigma))
