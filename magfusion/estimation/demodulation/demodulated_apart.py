"""The samples of several magnetometers, each demodulated as if it were alone."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import NamedTuple

from magfusion.errors import InputError
from magfusion.estimation.data_checks.mending import mended
from magfusion.estimation.data_checks.recording import passed_on
from magfusion.estimation.demodulation.demodulation import phasors
from magfusion.estimation.demodulation.drive_reference import referred
from magfusion.estimation.demodulation.warming import refuse_warm
from magfusion.files.fields import side_by_side
from magfusion.model.samples import FieldSamples, Log, Waveform
from magfusion.model.site import Site
from magfusion.model.trust import Finding, Verdict
from magfusion.receiver.receivers import usual_lockin
from magfusion.receiver.slots import has_schedule
from magfusion.receiver.windows import LockinSettings


class Apart(NamedTuple):
    """What several magnetometers recorded, demodulated.

    Parameters
    ----------
    log : Log
        With phasors by the log's clock, in the site's order, in place of the samples, or beside
        them as they were mended.
    dropped : mapping
        Reason, with the magnetometer's name, to number of windows.
    noticed : tuple of Finding
        What was mended in the samples of each, and how they were demodulated.
    """

    log: Log
    dropped: Mapping[str, int]
    noticed: tuple[Finding, ...]


def of_site(log: Log, site: Site) -> Log:
    """Return a log of several magnetometers as a site of one, or of some, knows it.

    Raises
    ------
    InputError
        Where the site knows none of a name, or does not say which it has.
    """
    if not log.waveforms:
        return log
    sensors = [sensor.name for sensor in site.platform.magnetometers]
    strange = [name for name in log.waveforms if name not in sensors]
    alone = len(sensors) == 1
    if strange and (not alone or (len(log.waveforms) > 1 and sensors[0] not in log.waveforms)):
        raise InputError(
            f"The samples are of magnetometer {', '.join(strange)}, which the site does not know"
            f" (it has {', '.join(sensors)}); give the site in which the log was recorded."
        )
    if not alone:
        return log
    own = log.waveforms.get(sensors[0], next(iter(log.waveforms.values())))
    return replace(log, waveform=own, waveforms={})


def each_alone(log: Log, site: Site) -> Iterator[tuple[str, Log, Site]]:
    """Yield the name of each magnetometer that has samples, and the log and the site of it alone.

    Its samples are stamped by the log's clock, as far as that is known.
    """
    for sensor in site.platform.magnetometers:
        wave = log.waveforms.get(sensor.name)
        if wave is None or not len(wave):
            continue
        here = Waveform(
            wave.time + sensor.clock_offset, wave.measured_sensor, wave.marks, wave.axes
        )
        alone = site.platform.carrying((replace(sensor, clock_offset=0.0),))
        own = replace(log, waveform=here, waveforms={}, fields=None, noticed=())
        yield sensor.name, own, replace(site, platform=alone)


def each_recorded(log: Log, site: Site | None) -> Iterator[tuple[str, Log, Site | None]]:
    """Yield each magnetometer as `each_alone`, mended; without a site, its samples alone.

    Of which the site has and the log has no samples, nothing is yielded.
    """
    if site is not None:
        for name, own, alone in each_alone(log, site):
            yield name, mended(replace(own, noticed=log.noticed), alone), alone
        return
    for name, wave in log.waveforms.items():
        yield name, replace(log, waveform=wave, waveforms={}), None


def demodulated_apart(
    log: Log, site: Site, lockin: LockinSettings | None = None, *, anew: bool = False
) -> Apart:
    """Demodulate each magnetometer by its own mounting, matrix and response, at its own stamps.

    Windows are at the same times of the log's clock, so that they are one epoch.

    Parameters
    ----------
    anew : bool
        Whether the samples are kept, to be demodulated again once the motion is known.

    Raises
    ------
    InputError
        Where no window of one is usable, or its temperature matters.
    """
    refuse_warm(site)
    if not has_schedule(site):
        lockin = replace(usual_lockin(site) if lockin is None else lockin, origin=0.0)
    parts: dict[str, FieldSamples] = {}
    dropped: dict[str, int] = {}
    said: dict[str, tuple[Finding, ...]] = {}
    imu, waves = log.imu, dict[str, Waveform]()
    late = {sensor.name: sensor.clock_offset for sensor in site.platform.magnetometers}
    for name, one, alone in each_alone(log, site):
        one = mended(one, alone)
        assert one.waveform is not None
        waves[name] = replace(one.waveform, time=one.waveform.time - late[name])
        imu, said[name] = one.imu, passed_on(one, alone).findings
        try:
            samples, lost = phasors(one, alone, lockin)
        except InputError as error:
            raise InputError(f"magnetometer {name}: {error}") from error
        parts[name] = referred(samples, alone)
        dropped |= {f"{name}: {reason}": count for reason, count in lost.items()}
    own = tuple(dict.fromkeys(site.channels))
    names = [sensor.name for sensor in site.platform.magnetometers]
    fields = side_by_side([parts.get(name, FieldSamples.empty(own)) for name in names], site)
    missing = [name for name in names if name not in parts]
    noticed = (*by_name(said), *_how(list(parts), missing, anew=anew))
    log = replace(log, imu=imu, waveforms=waves if anew else {}, fields=fields)
    return Apart(log, dropped, noticed)


def by_name(said: Mapping[str, tuple[Finding, ...]]) -> Iterator[Finding]:
    """Yield what is said of each magnetometer with its name; what is said of all, once."""
    alike = set.intersection(*map(set, said.values()))
    yield from (finding for finding in next(iter(said.values())) if finding in alike)
    for name, findings in said.items():
        for finding in findings:
            if finding not in alike:
                yield replace(finding, text=f"Of {name}: {finding.text}")


def _how(names: list[str], missing: list[str], *, anew: bool) -> Iterator[Finding]:
    text = "" if not missing else f"Of {', '.join(missing)} there are no samples."
    if not anew:
        how = (
            f"The samples of {', '.join(names)} were demodulated each by itself, as magfusion"
            " demodulate does, before anything else: of the motion inside a window only the turns"
            " that the IMU tells are taken off."
        )
        text = f"{how} {text}".rstrip()
    if text:
        yield Finding("demodulated_apart", text, Verdict.TRUSTWORTHY)
