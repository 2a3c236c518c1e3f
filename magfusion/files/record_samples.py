"""Samples of the records of a pipe."""

import numpy as np

from magfusion.errors import InputError
from magfusion.files.drive_columns import beacon_of
from magfusion.files.records import AidingRecord, DriveRecord, FieldsRecord
from magfusion.model.aiding import AidingSamples, Quantity, components
from magfusion.model.drive import DriveSamples
from magfusion.model.samples import FieldSamples
from magfusion.units import Array


def field_samples(entry: FieldsRecord, channels: tuple[tuple[str, int], ...]) -> FieldSamples:
    """Return the phasors in the order of the site's channels; those not detected are NaN.

    Raises InputError where a beacon or a tone is unknown to the site.
    """
    phasor = np.full((len(channels), 3), np.nan, dtype=complex)
    cov = np.full((len(channels), 3, 3), np.nan)
    for name, tones in entry.measured.items():
        for tone, value in enumerate(tones):
            if (name, tone) not in channels:
                known = ", ".join(f"{b} tone {t}" for b, t in channels)
                raise InputError(f"holds beacon {name} tone {tone}; the site knows {known}")
            row = channels.index((name, tone))
            phasor[row] = value
            if np.any(np.isfinite(value)):
                cov[row] = _noise(entry, name, tone)
    return FieldSamples(
        time=np.array([entry.time]),
        window=np.array([entry.window]),
        channels=channels,
        phasor_sensor=phasor[None],
        phasor_cov=cov[None],
        axes="xyz" if entry.amplitudes is None else "x",
        signed=entry.amplitudes is None,
    )


def _noise(entry: FieldsRecord, name: str, tone: int) -> Array:
    if entry.covariance is not None:
        return np.asarray(entry.covariance[name][tone])
    assert entry.sigma is not None
    return entry.sigma**2 * np.eye(3)


def aiding_samples(entry: AidingRecord, quantity: Quantity) -> AidingSamples:
    """Return the samples of a record of a sensor of some quantity, without those that are missing.

    Raises InputError if they are of another.
    """
    if quantity == "mark" and entry.mark is not None:
        return AidingSamples(
            quantity, entry.time, np.zeros((len(entry.time), 0)), tuple(entry.mark)
        )
    columns = components(quantity)
    if quantity == "mark" or entry.value is None or entry.value.shape[1] != columns:
        wanted = "mark" if quantity == "mark" else f"value with {columns} numbers a sample"
        raise InputError(f"a sensor of {quantity} needs {wanted}")
    there = np.isfinite(entry.value)
    kept = there.any(axis=1) if quantity == "velocity" else there.all(axis=1)
    return AidingSamples(quantity, entry.time[kept], entry.value[kept])


def drive_samples(entry: DriveRecord) -> DriveSamples:
    """Return the currents of a record, without times at which one is missing."""
    kept = np.all([np.isfinite(values) for values in entry.current.values()], axis=0)
    own = {beacon_of(name): values[kept] for name, values in entry.current.items()}
    return DriveSamples(entry.time[kept], own)
