"""Whether a log has the components that its site declares of the receiver, and a job needs."""

from pathlib import Path

from magfusion.errors import InputError
from magfusion.model.samples import Log
from magfusion.model.site import Site


def check_axes(
    declared_path: Path, log_path: Path, log: Log, site: Site, *, fewer: bool, amplitudes: bool
) -> None:
    """Refuse components that are not those of the site's receiver, or that a job cannot take."""
    sensor, fields, wave = site.platform.magnetometer, log.fields, log.waveform
    declared = sensor.axes
    key = f"{declared_path}: platform.magnetometer.axes:"
    whole = fields is None or (fields.axes == "xyz" and fields.signed)
    if declared == "xyz" and whole and (wave is None or wave.axes == "xyz"):
        return
    if len(declared) < 3 and (sensor.warming is not None or sensor.coil_kappa != 0.0):
        raise InputError(
            f"{key} of a receiver of fewer than three axes neither warming nor coil_kappa_m2 is"
            " taken into account; leave them out"
        )
    for stream, found in (
        ("fields", None if fields is None else fields.axes if fields.signed else declared),
        ("magnetometer", None if wave is None else wave.axes),
    ):
        one = fields is not None and not fields.signed and stream == "fields"
        if found is not None and (found != declared or (one and len(declared) != 1)):
            has = "one amplitude" if one else ", ".join(found)
            raise InputError(
                f"{key} is [{', '.join(declared)}], and the {stream} of {log_path} have {has};"
                " declare the axes that the receiver has"
            )
    if not fewer:
        three_axes(site, declared_path)
    if fields is not None and not fields.signed and not amplitudes:
        raise InputError(
            f"{log_path}: amplitudes without sign are taken by fix, smooth and navigate alone;"
            " run one of these, or give phasors (re and im)"
        )


def three_axes(site: Site, path: Path) -> Site:
    """Return a site whose receiver has all three axes.

    Raises
    ------
    InputError
        Where it has fewer.
    """
    declared = site.platform.magnetometer.axes
    if len(declared) < len("xyz"):
        raise InputError(
            f"{path}: platform.magnetometer.axes: is [{', '.join(declared)}], and this job needs"
            " all three axes; of a receiver of fewer check, demodulate, fix, navigate and smooth"
            " (of one log) make what can be known"
        )
    return site
