"""Settings of estimators, offline and online."""

from dataclasses import dataclass

from magfusion.estimation.graph.measurement import Measurement
from magfusion.estimation.graph.user_factors import UserFactors
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
    """Settings of measurements and estimated calibration.

    Parameters
    ----------
    estimate : tuple of str, optional
        Calibration groups; by default those whose sigma in the site is not negligible, () for none.
    lockin : LockinSettings, optional
        Window and step of the lock-in (s); by default chosen by the tones' spacing.
    earth : bool
        Measure the Earth field too (default: no); where no beacon is detected, it and gravity alone
        constrain the attitude.
    parameters : tuple of Parameter
        Available kinds of calibration parameters; all of the package by default.
    """

    estimate: tuple[str, ...] | None = None
    lockin: LockinSettings | None = None
    earth: bool = False
    parameters: tuple[Parameter, ...] = PARAMETERS

    def blocks(self, site: Site) -> tuple[tuple[Block, ...], tuple[Block, ...]]:
        """Return the calibration parameters that are estimated, and those only considered."""
        kinds = self.parameters if self.earth else of_phasors(self.parameters)
        estimated = choose_blocks(site, self.estimate, parameters=kinds)
        return estimated, considered_blocks(site, estimated, parameters=kinds)


@dataclass(frozen=True)
class SmootherSettings(EstimatorSettings):
    """Settings of the smoother; the Earth field requires tight coupling.

    Parameters
    ----------
    coupling : {'tight', 'loose'}
        Whether the phasors (default) or their fixes enter the graph.
    loss : {None, 'huber', 'cauchy'}
        Robust loss of the field measurements, against false beacons, which sums of squares do not
        model; Cauchy's by default.
    max_iterations : int
        Maximum number of waveform predictions; 10 by default.
    tune : bool
        Whether noise and model error are estimated from the residuals, with their declared values
        as a prior; with tight coupling. By default they are.
    measurements : tuple of (ndarray, Measurement)
        Further measurements, with the times (n,) of their rows (s), at which states are made.
    factors : UserFactors, optional
        A user's, with the times at which states are made.
    engine : {'bordered', 'gtsam'}
        Optimiser of each pass: our loop (default), or GTSAM's Levenberg-Marquardt, which is slower,
        to check it.
    """

    __repr__ = short_repr

    coupling: str = "tight"
    loss: str | None = "cauchy"
    max_iterations: int = 10
    tune: bool = True
    measurements: tuple[tuple[Array, Measurement], ...] = ()
    factors: UserFactors | None = None
    engine: str = "bordered"

    def __post_init__(self) -> None:
        if self.earth and self.coupling == "loose":
            raise ValueError("the Earth field requires tight coupling")
        if self.max_iterations < 1:
            raise ValueError(f"passes must be at least 1; got {self.max_iterations}")
