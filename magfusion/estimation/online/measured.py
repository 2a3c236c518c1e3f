"""The measurements of one epoch of a running estimate."""

from dataclasses import dataclass

from magfusion.estimation.measurements.earth import EarthField
from magfusion.estimation.measurements.joint_phasors import JointPhasors
from magfusion.estimation.measurements.phasors import FieldPhasors
from magfusion.model.samples import FieldSamples, SteadyFields


@dataclass(frozen=True, eq=False)
class EpochMeasurements:
    """Measurements of one epoch.

    Parameters
    ----------
    samples : FieldSamples
        Without undetected beacons; as predicted where tones are only measured jointly.
    phasors : FieldPhasors or JointPhasors
        The phasors as a measurement.
    earth : EarthField, optional
        The static field as a measurement, if it is one.
    steady : SteadyFields, optional
        The measured static field, where there is a waveform.
    repeats : float
        Number of epochs that contain each sample of overlapping windows.
    """

    samples: FieldSamples
    phasors: FieldPhasors | JointPhasors
    earth: EarthField | None
    steady: SteadyFields | None
    repeats: float

    @property
    def is_sequential(self) -> bool:
        """Whether each phasor was measured separately."""
        return isinstance(self.phasors, FieldPhasors)

    @property
    def detected(self) -> tuple[str, ...]:
        """Detected beacons."""
        channels = zip(self.samples.channels, self.samples.valid[0], strict=True)
        return tuple(dict.fromkeys(name for (name, _), valid in channels if valid))
