"""What the raw streams of a log say against it, whatever is made of them."""

from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import replace

import numpy as np

from magfusion.estimation.data_checks.body_iron import IRON_SPAN, iron_on_body
from magfusion.estimation.data_checks.compasses import still_means, wrong_compasses
from magfusion.estimation.data_checks.inertial_noise import noisy_inertial
from magfusion.estimation.data_checks.samples import (
    clipped_samples,
    false_samples,
    frozen_samples,
    repeated_samples,
)
from magfusion.estimation.data_checks.signal import (
    Detected,
    Heard,
    heard_in,
    heard_with_motion,
    unheard,
)
from magfusion.estimation.data_checks.spectrum import undeclared_lines
from magfusion.estimation.data_checks.stamps import uneven_stamps
from magfusion.estimation.data_checks.turn_witness import turned_otherwise
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.model.trust import Finding, Trust, Verdict
from magfusion.receiver.joint import long_windows
from magfusion.receiver.windows import LockinSettings

Witness = Callable[[Log, Site | None], Iterable[Finding]]

WITNESSES: tuple[Witness, ...] = (
    uneven_stamps,
    frozen_samples,
    repeated_samples,
    clipped_samples,
    false_samples,
    noisy_inertial,
)
LONGEST = 1200.0  # s; of a longer log the compasses and the spectrum are judged by its beginning
# Of the gyroscope and the clocks: with them wrong, nothing is still in the axes it keeps.
UNSTEADY = frozenset(
    {"gyro_sign", "gyro_units", "gyro_scale", "imu_axes", "imu_clock", "stuck_axis"}
)
# What estimators bridge with an honest covariance is said, and no reason for doubt.
BRIDGED = frozenset({"gap", "samples_lost", "silent_beacon"})


def recorded(
    log: Log,
    site: Site | None,
    bridged: Collection[str] = frozenset(),
    poses: Trajectory | None = None,
    *,
    estimated: Trajectory | None = None,
    beacons: bool = False,
    hearing: Heard | None = None,
    lockin: LockinSettings | None = None,
    freed: Detected | None = None,
) -> tuple[Finding, ...]:
    """Return what is wrong with a recording; without a site, of the streams alone.

    Parameters
    ----------
    bridged : collection of str
        Codes of what the estimator copes with.
    poses : Trajectory, optional
        By the beacons: they tell whose compass is wrong.
    estimated : Trajectory, optional
        By an estimator that used gravity too: of a reversed vertical they tell whose it is.
    beacons : bool
        Whether the result hangs on the beacons: then it is said how each is heard, and what else
        transmits.
    hearing : Heard, optional
        How they are heard, where that is known already.
    lockin : LockinSettings, optional
        As it was asked for.
    freed : Detected, optional
        How they are heard by a solution, the motion inside the windows taken off.
    """
    found = [*log.noticed, *(one for witness in WITNESSES for one in witness(log, site))]
    log = beginning(log)
    found += turned_otherwise(log, site) if log.inertial else []
    if log.inertial and not any(finding.code in UNSTEADY for finding in found):
        found += wrong_compasses(log, site, poses, estimated)
        if site is not None and log.vectors is not None:
            found += iron_on_body(still_means(log, site, IRON_SPAN), site)
    if beacons and site is not None and site.beacons:
        found += _of_beacons(log, site, hearing, lockin, freed)
    return tuple(replace(f, verdict=Verdict.TRUSTWORTHY) if f.code in bridged else f for f in found)


def _of_beacons(
    log: Log,
    site: Site,
    hearing: Heard | None,
    lockin: LockinSettings | None,
    freed: Detected | None,
) -> Iterator[Finding]:
    """Yield how each beacon is heard, and what else transmits; parameters as of `recorded`."""
    yield from filter(_matters, undeclared_lines(log, site, lockin))
    if log.waveform is not None or log.waveforms:
        yield from long_windows(site, lockin)
    hearing = heard_in(log, site) if hearing is None else hearing
    if hearing is None:
        return
    yield from unheard(hearing if freed is None else heard_with_motion(hearing, freed), site)


def _matters(line: Finding) -> bool:
    return line.verdict is not Verdict.TRUSTWORTHY or line.code == "fitted_line"


def beginning(log: Log, span: float = LONGEST) -> Log:
    """Return the first part of a log, of this length (s)."""
    end = float(log.imu.time[0]) + span if len(log.imu) else span
    if len(log.imu) and log.imu.time[-1] > end:
        kept = slice(0, int(np.searchsorted(log.imu.time, end)))
        imu = replace(
            log.imu,
            time=log.imu.time[kept],
            gyro_body=log.imu.gyro_body[kept],
            accel_body=log.imu.accel_body[kept],
        )
        log = replace(log, imu=imu)
    wave = log.waveform
    if wave is not None and len(wave) and wave.time[-1] > end:
        kept = slice(0, int(np.searchsorted(wave.time, end)))
        short = wave.rows(kept)
        log = replace(log, waveform=short)
    return log


def beyond(recording: Log, used: Log, site: Site) -> tuple[Finding, ...]:
    """Return what a recording says against itself that is not seen in what was made of it."""
    known = recorded(used, site, BRIDGED)
    return tuple(f for f in recorded(recording, site, BRIDGED) if f not in known)


def passed_on(log: Log, site: Site) -> Trust:
    """Return what is to be said of a log whose fields are only put in another form.

    Whoever estimates by them judges them again; what would fail that is doubtful here.
    """
    found = recorded(log, site, BRIDGED)
    return Trust(
        tuple(
            replace(f, verdict=Verdict.DOUBTFUL) if f.verdict is Verdict.FAILED else f
            for f in found
        )
    )
