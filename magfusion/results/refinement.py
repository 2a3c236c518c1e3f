"""Estimates of the calibration parameters, and the site that they refine."""

from dataclasses import replace

import numpy as np

from magfusion.estimation.batch.batch import Smoothed
from magfusion.model.correlation import Correlation, joined
from magfusion.model.parameters import BeaconParameter, Block, Calibration, difference
from magfusion.model.prior import parameters_of
from magfusion.model.site import Site
from magfusion.results.figures import ParameterEstimate, calibration_record
from magfusion.units import Array


def parameter_estimates(
    declared: Calibration, fitted: Calibration, blocks: tuple[Block, ...], cov: Array
) -> list[ParameterEstimate]:
    """Return every estimated parameter with its change and its sigmas.

    `cov` (dimension, dimension): posterior covariance.
    """
    change = difference(declared, fitted, blocks)
    sigma = np.sqrt(np.diagonal(cov))
    return [
        ParameterEstimate(
            name,
            float(change[row] / block.parameter.unit.size),
            {"nt": "nT"}.get(block.parameter.unit.text, block.parameter.unit.text),
            block.owner if _is_of_beacon(block) else None,
            label=block.name,
            sigma=float(sigma[row] / block.parameter.unit.size),
            prior_sigma=float(prior / block.parameter.unit.size),
            declared=None if before is None else float(before / block.parameter.unit.size),
        )
        for block in blocks
        for name, row, prior, before in zip(
            _component_names(block),
            range(block.columns.start, block.columns.stop),
            block.sigma,
            _values(declared, block),
            strict=True,
        )
    ]


def _values(declared: Calibration, block: Block) -> list[float | None]:
    value = block.parameter.value(declared, block.owner)
    return [None] * len(block.sigma) if value is None else [*value.tolist()]


def _is_of_beacon(block: Block) -> bool:
    return isinstance(block.parameter, BeaconParameter)


def _component_names(block: Block) -> list[str]:
    count, parameter = len(block.sigma), block.parameter
    numbered = [str(i) for i in range(count)] if count > 1 else [""]
    name = f"{{beacon}}.{block.kind}" if _is_of_beacon(block) else block.name
    parts = [(name, part, parameter.unit.text) for part in parameter.components or numbered]
    return ["_".join(filter(None, words)) for words in parts]


def refined_site(
    fitted: Calibration,
    blocks: tuple[Block, ...],
    cov: Array,
    estimates: list[ParameterEstimate],
    log_name: str,
) -> Site:
    """Return the site with the fitted values and their posterior sigmas.

    Drive phase and drift of an unsynchronised beacon belong to the log, not to the site: they are
    given in the site's ``calibration`` record and nowhere else.  An estimated Earth field replaces
    the location's.
    """
    site, sigma = fitted.site, np.sqrt(np.diagonal(cov))
    for block in blocks:
        site = block.parameter.refined(site, fitted, block.owner, sigma[block.columns])
    drive = [e for b in blocks if b.parameter.of_log for e in estimates[b.columns]]
    record = calibration_record(log_name, estimates)
    record["drive"] = {e.key: [e.change, e.sigma] for e in drive}
    return replace(site, calibration=record, correlation=_correlation(site, blocks, cov))


def result_site(result: Smoothed, log_name: str) -> Site:
    """Return the site that a smoothed log refined."""
    parts = result.calibration, result.blocks, result.calibration_cov
    return refined_site(*parts, parameter_estimates(result.declared, *parts), log_name)


def _correlation(site: Site, blocks: tuple[Block, ...], cov: Array) -> Correlation | None:
    """Return the correlation of the errors: of the new estimates, and of unchanged parameters."""
    known = parameters_of(blocks)
    own = [i for b in blocks if b.parameter.declared for i in range(*b.columns.indices(len(cov)))]
    fresh = None
    if own:
        part = cov[np.ix_(own, own)]
        sigma = np.sqrt(np.diagonal(part))
        fresh = Correlation(tuple(known[i] for i in own), part / sigma[:, None] / sigma)
    before = site.correlation
    return joined([fresh, before and before.kept(lambda p: p not in known)])
