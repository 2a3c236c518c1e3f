"""Which of several magnetometers what comes through a pipe is of."""

from dataclasses import replace

import numpy as np

from magfusion.errors import InputError
from magfusion.files.fields import on_log_clock, side_by_side
from magfusion.files.record_samples import field_samples
from magfusion.files.records import FieldsRecord, MagnetometerRecord, Record
from magfusion.model.bandpass import waveform_of_bands
from magfusion.model.detection_range import tones_of
from magfusion.model.samples import FieldSamples
from magfusion.model.site import Site


def magnetometer_number(site: Site, name: str | None, what: str) -> int:
    """Return which of the platform's magnetometers something is of.

    Raises InputError where the site has none of that name, or several and no name is given.
    """
    names = [sensor.name for sensor in site.platform.magnetometers]
    if name is None and len(names) == 1:
        return 0
    if name is None:
        raise InputError(
            f"the {what} do not specify which of the site's magnetometers took them"
            f" ({', '.join(names)}); add its name as magnetometer"
        )
    if name not in names:
        raise InputError(
            f"the {what} are of magnetometer {name}, which the site does not know (it has"
            f" {', '.join(names)}); give the site in which the log was recorded"
        )
    return names.index(name)


def with_waveform(record: Record, site: Site) -> Record:
    """Return a record with the waveform of the tones whose complex amplitudes it holds.

    Raises InputError where they are not the tones of the site, or its receiver is not of
    alternating fields.
    """
    bands = record.baseband
    if bands is None:
        return record
    tones_hz = np.sort(tones_of(site).frequencies_hz)
    if not np.array_equal(np.sort(bands.hz), tones_hz) or record.magnetometer is not None:
        listed = ", ".join(f"{tone:g}" for tone in tones_hz)
        raise InputError(f"baseband: give all tones of the site ({listed} Hz), and no magnetometer")
    if not site.platform.magnetometer.ac_coupled or site.platform.further:
        raise InputError("baseband: declare one platform.magnetometer with ac_coupled: true")
    field = waveform_of_bands(bands.time, bands.re + 1j * bands.im, bands.hz)
    samples = MagnetometerRecord(time=bands.time, field=field)
    return record.model_copy(update={"baseband": None, "magnetometer": samples})


def site_fields(entry: FieldsRecord, site: Site) -> FieldSamples:
    """Return the phasors of a record in the order of the site's channels, by the log's clock."""
    which = magnetometer_number(site, entry.magnetometer, "fields")
    sensors = site.platform.magnetometers
    if len(sensors) == 1:
        return field_samples(entry, site.channels)
    one = replace(site, platform=site.platform.with_magnetometers((sensors[which],)))
    own = on_log_clock(field_samples(entry, one.channels), one)
    none = FieldSamples.empty(one.channels)
    return side_by_side([own if k == which else none for k in range(len(sensors))], site)
