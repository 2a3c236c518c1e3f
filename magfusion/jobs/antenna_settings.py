"""Settings of the calibration of a tracker's antennas."""

from dataclasses import dataclass
from pathlib import Path

from magfusion.errors import InputError
from magfusion.jobs.settings import Settings, argument, option, required


@dataclass(frozen=True, kw_only=True)
class AntennaSettings(Settings):
    """Readings of the bench, and calibration options."""

    survey: Path | None = argument(
        "Survey: phasors of a three-coil beacon at known poses; not needed with --probe", None
    )
    site: Path = required("Site file")
    poses: Path | None = option(
        None, "Table of a turntable's or robot's poses by point, if the survey has none"
    )
    probe: tuple[Path, ...] = option((), "Readings of a probe about the antennas; repeatable")
    beacon: str | None = option(None, "Beacon", note="default: the only one of three coils")
    pose_rotation_deg: float = option(
        0.1, "Error of the survey's attitudes, one sigma an axis", least=0.0, note="0: exact"
    )
    pose_position_m: float = option(
        0.0005, "Error of the survey's positions, one sigma an axis", least=0.0, note="0: exact"
    )
    probe_position_m: float = option(
        50e-6, "Error of the probe's positions, one sigma an axis", least=0.0
    )
    probe_tilt_deg: float = option(0.02, "Error of the probe's axes, one sigma", least=0.0)
    sizes: bool = option(False, "Estimate the coils' size too")
    boresight: bool = option(
        False, "Estimate the receiver's pose on the body, ignoring the site's value"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.pose_rotation_deg == 0.0) != (self.pose_position_m == 0.0):
            raise InputError(
                "--pose-rotation-deg and --pose-position-m must both be 0 (poses exact) or both"
                " above"
            )
        if self.survey is None and not self.probe:
            raise InputError("give a survey of known poses, or a probe's readings with --probe")
        if self.survey is None and (self.boresight or self.poses is not None):
            name = "--boresight" if self.boresight else "--poses"
            raise InputError(f"{name} requires a survey of known poses; give one")

    @property
    def name(self) -> str:
        """Path of the readings, for the report."""
        return (self.survey or self.probe[0]).stem

    @property
    def exact(self) -> bool:
        """Whether the survey's poses are taken as exact."""
        return self.pose_rotation_deg == 0.0
