"""What an estimator, offline or online, is asked for."""

from dataclasses import dataclass

from magfusion.model.parameters import (
    PARAMETERS,
    Block,
    Parameter,
    choose_blocks,
    considered_blocks,
    of_phasors,
)
from magfusion.model.site import Site
from magfusion.receiver.windows import LockinSettings


@dataclass(frozen=True, kw_only=True)
class EstimatorSettings:
    """What is measured, and what is estimated of the calibration.

    Parameters
    ----------
    estimate : tuple of str, optional
        Calibration groups; None takes those whose sigma in the site is not negligible.
    lockin : LockinSettings, optional
        None chooses window and step from the tones' spacing.
    earth : bool
        Measure the Earth field too; where no beacon is detected, it and gravity alone hold the
        attitude.
    parameters : tuple of Parameter
        Kinds of calibration parameters there are.
    """

    estimate: tuple[str, ...] | None = None
    lockin: LockinSettings | None = None
    earth: bool = False
    parameters: tuple[Parameter, ...] = PARAMETERS

    def blocks(self, site: Site) -> tuple[tuple[Block, ...], tuple[Block, ...]]:
        """Return the calibration parameters that are estimated, and what else is uncertain."""
        kinds = self.parameters if self.earth else of_phasors(self.parameters)
        estimated = choose_blocks(site, self.estimate, parameters=kinds)
        return estimated, considered_blocks(site, estimated, parameters=kinds)
