"""Separate demodulation of the samples of several magnetometers."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import NamedTuple

from magfusion.errors import InputError
from magfusion.estimation.data_checks.data_cleaning import clean_log
from magfusion.estimation.data_checks.data_quality import passed_on
from magfusion.estimation.demodulation.demodulation import phasors
from magfusion.estimation.demodulation.drive_reference import referred
from magfusion.estimation.demodulation.temperature_compensation import refuse_warm
from magfusion.files.fields import side_by_side
from magfusion.model.samples import FieldSamples, Log, Waveform
from magfusion.model.site import Site
from magfusion.model.trust import Finding, Verdict
from magfusion.receiver.receivers import usual_lockin
from magfusion.receiver.slots import has_schedule
from magfusion.receiver.windows import LockinSettings


class SeparateDemodulation(NamedTuple):
    """Demodulated samples of several magnetometers."""

    # with phasors on the log's clock, in the site's order, instead of the samples or in addition to
    # the cleaned samples
    log: Log
    dropped: Mapping[str, int]  # reason, with the magnetometer's name, to number of windows
    # corrections to the samples of each, and how they were demodulated
    findings: tuple[Finding, ...]


def of_site(log: Log, site: Site) -> Log:
    """Return a log of several magnetometers with those of the site.

    Raises InputError where a name is not in the site, or the site does not declare which
    magnetometer it has.
    """
    if not log.waveforms:
        return log
    sensors = [sensor.name for sensor in site.platform.magnetometers]
    strange = [name for name in log.waveforms if name not in sensors]
    alone = len(sensors) == 1
    if strange and (not alone or (len(log.waveforms) > 1 and sensors[0] not in log.waveforms)):
        raise InputError(
            f"The samples are of magnetometer {', '.join(strange)}, which the site does not have"
            f" (it has {', '.join(sensors)}); give the site of the recording."
        )
    if not alone:
        return log
    own = log.waveforms.get(sensors[0], next(iter(log.waveforms.values())))
    return replace(log, waveform=own, waveforms={})


def each_alone(log: Log, site: Site) -> Iterator[tuple[str, Log, Site]]:
    """Yield each magnetometer with samples: its name, and the log and the site of it alone.

    Its samples are stamped by the log's clock, as far as that is known.
    """
    for sensor in site.platform.magnetometers:
        wave = log.waveforms.get(sensor.name)
        if wave is None or not len(wave):
            continue
        here = Waveform(
            wave.time + sensor.clock_offset, wave.measured_sensor, wave.marks, wave.axes
        )
        alone = site.platform.with_magnetometers((replace(sensor, clock_offset=0.0),))
        own = replace(log, waveform=here, waveforms={}, fields=None, findings=())
        yield sensor.name, own, replace(site, platform=alone)


def each_recorded(log: Log, site: Site | None) -> Iterator[tuple[str, Log, Site | None]]:
    """Yield each magnetometer as `each_alone`, cleaned; without a site, its samples alone.

    Magnetometers of the site without samples in the log are skipped.
    """
    if site is not None:
        for name, own, alone in each_alone(log, site):
            yield name, clean_log(replace(own, findings=log.findings), alone), alone
        return
    for name, wave in log.waveforms.items():
        yield name, replace(log, waveform=wave, waveforms={}), None


def demodulated_apart(
    log: Log, site: Site, lockin: LockinSettings | None = None, *, repeated: bool = False
) -> SeparateDemodulation:
    """Demodulate each magnetometer by its own mounting, matrix and response, at its own stamps.

    Windows are at the same times of the log's clock, and thus form one epoch. `repeated`: whether
    to keep the samples, to be demodulated again once the motion is known. Raises InputError where
    no window of a magnetometer is usable, or its temperature matters.
    """
    refuse_warm(site)
    if not has_schedule(site):
        lockin = replace(usual_lockin(site) if lockin is None else lockin, origin=0.0)
    parts: dict[str, FieldSamples] = {}
    dropped: dict[str, int] = {}
    by_sensor: dict[str, tuple[Finding, ...]] = {}
    imu, waves = log.imu, dict[str, Waveform]()
    late = {sensor.name: sensor.clock_offset for sensor in site.platform.magnetometers}
    for name, one, alone in each_alone(log, site):
        one = clean_log(one, alone)
        assert one.waveform is not None
        waves[name] = replace(one.waveform, time=one.waveform.time - late[name])
        imu, by_sensor[name] = one.imu, passed_on(one, alone).findings
        try:
            samples, lost_epochs = phasors(one, alone, lockin)
        except InputError as error:
            raise InputError(f"magnetometer {name}: {error}") from error
        parts[name] = referred(samples, alone)
        dropped |= {f"{name}: {reason}": count for reason, count in lost_epochs.items()}
    own = tuple(dict.fromkeys(site.channels))
    names = [sensor.name for sensor in site.platform.magnetometers]
    fields = side_by_side([parts.get(name, FieldSamples.empty(own)) for name in names], site)
    missing = [name for name in names if name not in parts]
    findings = (*by_name(by_sensor), *_how(list(parts), missing, repeated=repeated))
    log = replace(log, imu=imu, waveforms=waves if repeated else {}, fields=fields)
    return SeparateDemodulation(log, dropped, findings)


def by_name(demodulated: Mapping[str, tuple[Finding, ...]]) -> Iterator[Finding]:
    """Yield the findings of each magnetometer with its name, and those of all once."""
    shared = set.intersection(*map(set, demodulated.values()))
    yield from (finding for finding in next(iter(demodulated.values())) if finding in shared)
    for name, findings in demodulated.items():
        for finding in findings:
            if finding not in shared:
                yield replace(finding, text=f"Magnetometer {name}: {finding.text}")


def _how(names: list[str], missing: list[str], *, repeated: bool) -> Iterator[Finding]:
    text = "" if not missing else f"There are no samples of magnetometer {', '.join(missing)}."
    if not repeated:
        how = (
            f"The samples of {', '.join(names)} were demodulated separately, as magfusion"
            " demodulate does, before estimation. Only the IMU's rotation inside a window is"
            " compensated."
        )
        text = f"{how} {text}".rstrip()
    if text:
        yield Finding("demodulated_apart", text, Verdict.TRUSTWORTHY)
