"""Embedding of a start from the detected beacons into the whole site."""

from dataclasses import replace

import numpy as np

from magfusion.estimation.batch.settings import EstimatorSettings
from magfusion.estimation.graph.state import MOTION, State
from magfusion.estimation.integrity.score import Score
from magfusion.model.parameters import (
    Block,
    Calibration,
    MagnetometerParameter,
    Parameter,
    channels_of,
    dimension,
    initial_calibration,
    placed,
)
from magfusion.model.prior import prior_sqrt_covariance
from magfusion.model.site import Site
from magfusion.units import IntArray

Key = tuple[Parameter, str]


def among_all(
    state: State, known: tuple[Block, ...], site: Site, settings: EstimatorSettings
) -> State:
    """Return a state in the tangent of a whole site; undetected beacons are as declared.

    A start may be of some beacons, of some magnetometers, or of some of both. `known`: of its
    tangent, in order.
    """
    estimated, considered = settings.blocks(site)
    blocks = (*estimated, *placed(considered, dimension(estimated)))
    root = np.zeros((dimension(blocks),) * 2)
    for some, start in ((estimated, 0), (considered, dimension(estimated))):
        if some:
            rows = slice(start, start + dimension(some))
            root[rows, rows] = prior_sqrt_covariance(site, some)
    cov = np.zeros((MOTION + len(root),) * 2)
    cov[MOTION:, MOTION:] = root @ root.T
    keys = [_key(block, state.calibration.site, site) for block in known]
    own = np.concatenate([np.arange(MOTION), MOTION + _columns(blocks, keys)])
    cov[own] = cov[:, own] = 0.0
    cov[np.ix_(own, own)] = state.cov
    return replace(state, calibration=_whole(state, site), cov=cov)


def score_among_all(
    score: Score, known: tuple[Block, ...], site: Site, settings: EstimatorSettings
) -> Score:
    """Return the score of a start of some beacons, with the calibration of the whole site.

    `known`: estimated part of its calibration; undetected beacons have no response.
    """
    estimated, _ = settings.blocks(site)
    whole = np.zeros((dimension(estimated), score.by_calibration.shape[1]))
    whole[_columns(estimated, [block.key for block in known])] = score.by_calibration
    return replace(score, by_calibration=whole)


def _key(block: Block, some: Site, site: Site) -> Key:
    """Return the key in the whole site of a block; that of a single magnetometer has no name."""
    sensors = some.platform
    alone = isinstance(block.parameter, MagnetometerParameter) and not sensors.further
    if alone and site.platform.further:
        return block.parameter, sensors.magnetometer.name
    return block.key


def _columns(blocks: tuple[Block, ...], known: list[Key]) -> IntArray:
    """Return the indices of known blocks' columns among all."""
    place = {block.key: block.columns for block in blocks}
    result = [np.arange(place[key].start, place[key].stop) for key in known]
    return np.concatenate([np.zeros(0, dtype=np.int64), *result])


def _whole(state: State, site: Site) -> Calibration:
    """Return the calibration with undetected beacons as the site declares them."""
    detected, part = _of_all_magnetometers(state.calibration, site), state.calibration.site
    every = initial_calibration(site, detected.reference_time, detected.imu_begin)
    names = {beacon.name: beacon for beacon in part.beacons}
    beacons = np.array([k for k, beacon in enumerate(site.beacons) if beacon.name in names])
    channels = channels_of(site, beacons)
    phase, drift, log_gain = every.phase.copy(), every.drift.copy(), every.log_gain.copy()
    phase[channels], log_gain[channels] = detected.phase, detected.log_gain
    drift[beacons] = detected.drift
    whole = replace(
        detected.site, beacons=tuple(names.get(b.name, b) for b in site.beacons), undetected=()
    )
    return replace(detected, site=whole, phase=phase, drift=drift, log_gain=log_gain)


def _of_all_magnetometers(calibration: Calibration, site: Site) -> Calibration:
    """Return the calibration with the missing magnetometers as the site declares them."""
    part, every = calibration.site, site.platform.magnetometers
    if len(part.platform.magnetometers) == len(every):
        return calibration
    known = {sensor.name: sensor for sensor in part.platform.magnetometers}
    sensors = tuple(known.get(sensor.name, sensor) for sensor in every)
    first = part.of_sensor(0)  # drives are the same for every magnetometer
    return replace(
        calibration,
        site=replace(part, platform=part.platform.with_magnetometers(sensors)),
        phase=np.tile(calibration.phase[first], len(every)),
        log_gain=np.tile(calibration.log_gain[first], len(every)),
    )
