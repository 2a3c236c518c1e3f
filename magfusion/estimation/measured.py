"""What a running estimator measures at one epoch."""

from dataclasses import dataclass

from magfusion.estimation.measurements.earth import EarthField
from magfusion.estimation.measurements.phasors import FieldPhasors
from magfusion.model.samples import FieldSamples, SteadyFields


@dataclass(frozen=True, eq=False)
class Measured:
    """What an epoch holds.

    Parameters
    ----------
    samples : FieldSamples
        Without the beacons that are not detected.
    earth : EarthField, optional
        The steady field as a measurement, where it is one.
    steady : SteadyFields, optional
        It as it was measured, where there is a waveform.
    repeats : float
        How many epochs hold each sample of overlapping windows.
    """

    samples: FieldSamples
    phasors: FieldPhasors
    earth: EarthField | None
    steady: SteadyFields | None
    repeats: float

    @property
    def heard(self) -> tuple[str, ...]:
        """The beacons that are detected."""
        channels = zip(self.samples.channels, self.samples.valid[0], strict=True)
        return tuple(dict.fromkeys(name for (name, _), valid in channels if valid))
