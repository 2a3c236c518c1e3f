"""Consistency of a log's components with the site's receiver and with a job."""

from collections.abc import Iterator
from pathlib import Path

from magfusion.errors import InputError
from magfusion.files.fields import refuse_unsigned
from magfusion.model.samples import Log
from magfusion.model.site import Site


def check_axes(
    declared_path: Path, log_path: Path, log: Log, site: Site, *, fewer: bool, amplitudes: bool
) -> None:
    """Reject components other than those of the site's receiver, or unsupported by a job."""
    sensor, fields, wave = site.platform.magnetometer, log.fields, log.waveform
    if fields is not None:
        frequencies = site.frequencies_of(fields.channels)
        refuse_unsigned(fields, frequencies, log_path)
    measured = {stream.axes for stream in (fields, wave) if stream is not None}
    amplitude = fields is not None and not fields.signed
    if measured <= {"xyz"} and sensor.axes == "xyz" and not amplitude:
        return
    key = f"{declared_path}: platform.magnetometer.axes:"
    if len(sensor.axes) < 3 and (sensor.temperature_model is not None or sensor.coil_kappa != 0.0):
        raise InputError(
            f"{key} for a receiver of fewer than three axes, warming and coil_kappa_m2 are not"
            " modelled; omit them"
        )
    for stream, has in _other_axes(log, sensor.axes):
        raise InputError(
            f"{key} is [{', '.join(sensor.axes)}], but the {stream} of {log_path} have {has};"
            " declare the axes of the receiver"
        )
    if not fewer:
        three_axes(site, declared_path)
    if amplitude and not amplitudes:
        raise InputError(
            f"{log_path}: unsigned amplitudes are supported by fix, smooth and navigate only; run"
            " one of these, or give phasors (re and im)"
        )


def _other_axes(log: Log, declared: str) -> Iterator[tuple[str, str]]:
    """Yield the streams of a log whose axes differ from the declared, and their axes."""
    if log.fields is not None and not log.fields.signed:  # amplitudes are of any one axis
        if len(declared) != 1:
            yield "fields", "one amplitude"
    elif log.fields is not None and log.fields.axes != declared:
        yield "fields", ", ".join(log.fields.axes)
    if log.waveform is not None and log.waveform.axes != declared:
        yield "magnetometer", ", ".join(log.waveform.axes)


def three_axes(site: Site, path: Path) -> Site:
    """Return a site whose receiver has all three axes.

    Raises InputError where it has fewer.
    """
    declared = site.platform.magnetometer.axes
    if len(declared) < len("xyz"):
        raise InputError(
            f"{path}: platform.magnetometer.axes: is [{', '.join(declared)}], but this job requires"
            " all three axes; with fewer, use check, demodulate, fix, navigate or smooth (of one"
            " log)"
        )
    return site
