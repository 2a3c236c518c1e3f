"""Self survey: unsurveyed beacons are placed by the log itself.

The known beacons give the trajectory first; along it `magfusion.estimation.batch.beacon_placement`
finds candidate poses of an unknown one.  Where several explain its field nearly as well, the whole
log is smoothed with each, and the motion decides.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from magfusion.errors import InputError
from magfusion.estimation.batch.batch import Smoothed, SmootherSettings, smooth
from magfusion.estimation.batch.beacon_placement import detected_along, places
from magfusion.estimation.batch.log_graph import overlap
from magfusion.estimation.demodulation.demodulation import phasors
from magfusion.model.parameters import Calibration
from magfusion.model.progress import Report
from magfusion.model.samples import FieldSamples, Log
from magfusion.model.site import Beacon, Site
from magfusion.model.trajectory import Trajectory

if TYPE_CHECKING:
    from magfusion.estimation.batch.beacon_placement import DetectedFields
    from magfusion.estimation.batch.outer_iterations import PassFile

MIN_KNOWN = 2  # beacons; with a single one the trajectory has mirrors
WIDE_POSITION = 1.0  # m; prior about an estimated place
WIDE_ROTATION = 0.5  # rad
RIVAL = 100.0  # chi square above the best, along the first trajectory, that excludes a hypothesis
MAX_SMOOTHED = 3


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """Candidate pose of an unknown beacon."""

    beacon: Beacon  # placed, with a wide prior
    # above that of the best: along the known beacons' trajectory, or of the whole log where it was
    # smoothed with this place
    chi_square: float
    smoothed: bool = False  # whether it is that of the whole log


class Placement(NamedTuple):
    """Candidate poses of one unknown beacon."""

    name: str
    hypotheses: tuple[Hypothesis, ...]  # best first


def smooth_and_place(
    log: Log,
    site: Site,
    settings: SmootherSettings,
    report: Report,
    iterations_file: PassFile | None = None,
) -> tuple[Smoothed, tuple[Placement, ...]]:
    """Smooth a log and place the beacons that the site declares unknown.

    `site`: without unknown beacons this is `magfusion.estimation.batch.batch.smooth`.
    `iterations_file`: of a log whose beacons are all known. Raises InputError where too few beacons
    are known; EstimationError where an unknown beacon was not detected, or the graph cannot be
    solved.
    """
    unknown = [beacon for beacon in site.beacons if beacon.unknown is not None]
    if not unknown:
        return smooth(log, site, settings, report, iterations_file), ()
    _refuse(site, unknown, settings)
    samples, _ = phasors(log, site, settings.lockin)
    states, calibration = _by_the_known(log, site, samples, settings, report)
    result = [
        _hypotheses(detected_along(beacon, calibration, samples, states, overlap(samples)))
        for beacon in unknown
    ]
    return decide(log, site, settings, report, result)


def _refuse(site: Site, unknown: list[Beacon], settings: SmootherSettings) -> None:
    known = len(site.beacons) - len(unknown)
    if known < MIN_KNOWN:
        raise InputError(
            f"the site has {known} beacons of known position, but {MIN_KNOWN} are needed to"
            f" place beacon {unknown[0].name}; survey another one"
        )
    groups = settings.estimate
    if settings.coupling == "loose" or (groups is not None and "beacons" not in groups):
        raise InputError(
            f"placing beacon {unknown[0].name} by the log needs tight coupling and estimated"
            " beacons; change --coupling or --estimate"
        )


def _by_the_known(
    log: Log, site: Site, samples: FieldSamples, settings: SmootherSettings, report: Report
) -> tuple[Trajectory, Calibration]:
    """Return the trajectory and the calibration that the known beacons determine.

    From phasors in a window for all beacons, which prevents leakage between them.
    """
    known = replace(site, beacons=tuple(b for b in site.beacons if b.unknown is None))
    kept = np.array([channel in known.channels for channel in samples.channels], dtype=bool)
    fields = replace(
        samples,
        channels=known.channels,
        phasor_sensor=samples.phasor_sensor[:, kept],
        phasor_cov=samples.phasor_cov[:, kept],
    )
    fields = fields.rows(np.asarray(fields.valid.any(axis=1)))
    partial = replace(log, waveform=None, fields=fields)
    result = smooth(partial, known, settings, report)
    return result.states, result.calibration


def _hypotheses(detected: DetectedFields) -> Placement:
    result = places(detected)
    best, beacon = result[0][0], detected.beacon
    return Placement(
        beacon.name,
        tuple(
            Hypothesis(_with_prior(placed, beacon), chi_square - best)
            for chi_square, placed in result
            if chi_square <= best + RIVAL
        ),
    )


def _with_prior(placed: Beacon, declared: Beacon) -> Beacon:
    """Return a placed beacon with wide sigmas, so that the graph estimates its pose again."""
    sigma = declared.sigma
    if declared.unknown in ("pose", "position"):
        sigma = replace(sigma, position_world=np.full(3, WIDE_POSITION))
    if declared.unknown in ("pose", "attitude"):
        sigma = replace(sigma, rotation_beacon=np.full(3, WIDE_ROTATION))
    return replace(placed, sigma=sigma, coils=declared.coils)


def decide(
    log: Log, site: Site, settings: SmootherSettings, report: Report, result: list[Placement]
) -> tuple[Smoothed, tuple[Placement, ...]]:
    """Smooth the log with the most probable places; the whole graph decides between them.

    `result`: one for each unknown beacon of the site. The best first.
    """
    choices = list(product(*(range(len(placement.hypotheses)) for placement in result)))

    def misfit(choice: tuple[int, ...]) -> float:
        return sum(p.hypotheses[i].chi_square for p, i in zip(result, choice, strict=True))

    choices = sorted(choices, key=misfit)[:MAX_SMOOTHED]
    results = []
    for choice in choices:
        chosen = [p.hypotheses[i].beacon for p, i in zip(result, choice, strict=True)]
        by_name = {beacon.name: beacon for beacon in chosen}
        placed = tuple(by_name.get(beacon.name, beacon) for beacon in site.beacons)
        results.append(smooth(log, replace(site, beacons=placed), settings, report))
    order = np.argsort([result.cost for result in results])
    best = int(order[0])
    reported = []
    for k, placement in enumerate(result):
        rows: dict[int, Hypothesis] = dict(enumerate(placement.hypotheses))
        for j in order[::-1]:
            excess = 2.0 * (results[j].cost - results[best].cost)
            index = choices[j][k]
            rows[index] = replace(rows[index], chi_square=excess, smoothed=True)
        ranked = sorted(rows.values(), key=lambda row: (not row.smoothed, row.chi_square))
        reported.append(Placement(placement.name, tuple(ranked)))
    return results[best], tuple(reported)
