"""What an epoch of a running estimate holds."""

from dataclasses import dataclass

from magfusion.estimation.measurements.earth import EarthField
from magfusion.estimation.measurements.joint_phasors import JointPhasors
from magfusion.estimation.measurements.phasors import FieldPhasors
from magfusion.model.samples import FieldSamples, SteadyFields


@dataclass(frozen=True, eq=False)
class Measured:
    """What an epoch holds.

    Parameters
    ----------
    samples : FieldSamples
        Without the beacons that are not detected; where tones are told together alone, as they are
        foreseen.
    phasors : FieldPhasors or JointPhasors
        The phasors as a measurement.
    earth : EarthField, optional
        The steady field as a measurement, where it is one.
    steady : SteadyFields, optional
        It as it was measured, where there is a waveform.
    repeats : float
        How many epochs hold each sample of overlapping windows.
    """

    samples: FieldSamples
    phasors: FieldPhasors | JointPhasors
    earth: EarthField | None
    steady: SteadyFields | None
    repeats: float

    @property
    def apart(self) -> bool:
        """Whether each phasor was measured alone."""
        return isinstance(self.phasors, FieldPhasors)

    @property
    def heard(self) -> tuple[str, ...]:
        """The beacons that are detected."""
        channels = zip(self.samples.channels, self.samples.valid[0], strict=True)
        return tuple(dict.fromkeys(name for (name, _), valid in channels if valid))
