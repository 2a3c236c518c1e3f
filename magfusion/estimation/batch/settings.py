"""What an estimator, offline or online, is asked for."""

from dataclasses import dataclass

from magfusion.estimation.graph.measurement import Measurement
from magfusion.model.parameters import (
    PARAMETERS,
    Block,
    Parameter,
    choose_blocks,
    considered_blocks,
    of_phasors,
)
from magfusion.model.short_repr import short_repr
from magfusion.model.site import Site
from magfusion.receiver.windows import LockinSettings
from magfusion.units import Array


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


@dataclass(frozen=True)
class SmootherSettings(EstimatorSettings):
    """How a log is smoothed; the Earth field is measured with tight coupling only.

    Parameters
    ----------
    coupling : {'tight', 'loose'}
        Whether the phasors or the fixes made of them enter the graph.
    loss : {None, 'huber', 'cauchy'}
        Robust loss of the field measurements: a false beacon is nothing that sums of squares
        expect, and where all are true it costs nothing.
    passes : int
        At most so many predictions of the waveform.
    tune : bool
        Whether noise and model error are found from the residuals, their declared values being a
        prior; with tight coupling.
    measurements : tuple of (ndarray, Measurement)
        Anything else that was measured, with the times of its rows (s), at which states are made.
    """

    __repr__ = short_repr

    coupling: str = "tight"
    loss: str | None = "cauchy"
    passes: int = 10
    tune: bool = True
    measurements: tuple[tuple[Array, Measurement], ...] = ()

    def __post_init__(self) -> None:
        if self.earth and self.coupling == "loose":
            raise ValueError("the Earth field is measured with tight coupling only")
        if self.passes < 1:
            raise ValueError(f"passes must be at least 1; got {self.passes}")
