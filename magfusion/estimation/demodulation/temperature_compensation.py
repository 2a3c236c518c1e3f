"""Temperature compensation of logs and streams, as far as a site declares coefficients.

The magnetometer's samples are converted to the temperature of its declared matrix and offset; the
temperature dependence of the beacons' moments is a part of the model.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from magfusion.errors import InputError
from magfusion.model.samples import FieldSamples, Log
from magfusion.model.site import Magnetometer, Site
from magfusion.model.temperature import MAGNETOMETER, Temperatures
from magfusion.model.trust import Finding, Verdict
from magfusion.units import Array

AT_ONCE = 1 << 14  # samples whose matrix is made at a time


def at_reference(log: Log, site: Site) -> tuple[Log, Site]:
    """Return a log at its magnetometer's reference temperature, and the site with the remainder.

    If a site declares temperature coefficients and the log has no temperature, a finding is added
    and the reference temperature is assumed. Raises InputError as `refuse_warm`.
    """
    refuse_warm(site)
    known = Temperatures() if log.temperatures is None else log.temperatures
    log = replace(log, findings=(*log.findings, *_missing(known, site)))
    site = replace(site, temperatures=known)
    if MAGNETOMETER not in known.readings or site.platform.magnetometer.temperature_model is None:
        return log, site
    wave, fields, sensor = log.waveform, log.fields, site.platform.magnetometer
    if wave is not None:
        samples = at_reference_temperature(known, sensor, wave.time, wave.measured_sensor)
        wave = replace(wave, measured_sensor=samples)
    if fields is not None:
        fields = fields_at_reference_temperature(known, sensor, fields)
    beacons = known.without(MAGNETOMETER)
    log = replace(log, waveform=wave, fields=fields, temperatures=beacons)
    return log, replace(site, temperatures=beacons)


def refuse_warm(site: Site) -> None:
    """Raise an error for coefficients of several magnetometers, as records do not name them."""
    several = site.platform.magnetometers if site.platform.further else ()
    warm = [sensor.name for sensor in several if sensor.temperature_model is not None]
    if warm:
        raise InputError(
            f"platform.magnetometers: {', '.join(warm)}: warming of several magnetometers is not"
            " supported yet; omit it from the site"
        )


def _missing(known: Temperatures, site: Site) -> Iterator[Finding]:
    declared = {b.name: f"beacon {b.name}" for b in site.beacons if b.temperature_model is not None}
    if site.platform.magnetometer.temperature_model is not None:
        declared[MAGNETOMETER] = "the magnetometer"
    parts = [what for name, what in declared.items() if name not in known.readings]
    if parts:
        yield Finding(
            "temperature_missing",
            f"The site declares how {', '.join(parts)} changes with temperature, but no temperature"
            " was recorded: the reference is assumed. Record it in temperature.parquet.",
            Verdict.TRUSTWORTHY,
        )


def at_reference_temperature(
    known: Temperatures | None, magnetometer: Magnetometer, time: Array, measured: Array
) -> Array:
    """Return samples of a stream as of `samples_at_reference`, where its temperature is known.

    `time` (n,) (s), `measured` (n, 3) (T).
    """
    if magnetometer.temperature_model is None or known is None:
        return measured
    degc = known.at(MAGNETOMETER, time)
    return measured if degc is None else samples_at_reference(measured, degc, magnetometer)


def fields_at_reference_temperature(
    known: Temperatures | None, magnetometer: Magnetometer, fields: FieldSamples
) -> FieldSamples:
    """Return phasors of a stream as of `phasors_at_reference`, as `at_reference_temperature`."""
    if magnetometer.temperature_model is None or known is None:
        return fields
    degc = known.at(MAGNETOMETER, fields.time)
    return fields if degc is None else phasors_at_reference(fields, degc, magnetometer)


def samples_at_reference(measured: Array, degc: Array, magnetometer: Magnetometer) -> Array:
    """Return samples converted to the magnetometer's reference temperature.

    `measured` (n, 3) (T), `degc` (n,).
    """
    assert magnetometer.temperature_model is not None
    out = np.empty_like(measured)
    for begin in range(0, len(measured), AT_ONCE):
        rows = slice(begin, begin + AT_ONCE)
        back, more = magnetometer.temperature_model.to_reference(magnetometer.matrix, degc[rows])
        beyond = measured[rows] - magnetometer.offset - more
        out[rows] = (back @ beyond[..., None])[..., 0] + magnetometer.offset
    return out


def phasors_at_reference(
    fields: FieldSamples, degc: Array, magnetometer: Magnetometer
) -> FieldSamples:
    """Return phasors converted to the magnetometer's reference temperature.

    `degc` (n,).
    """
    assert magnetometer.temperature_model is not None
    back = magnetometer.temperature_model.to_reference(magnetometer.matrix, degc)[0][:, None]
    return replace(
        fields,
        phasor_sensor=(back @ fields.phasor_sensor[..., None])[..., 0],
        phasor_cov=back @ fields.phasor_cov @ np.swapaxes(back, -1, -2),
    )
