"""Description of an installation from which its site file is generated."""

from dataclasses import dataclass
from pathlib import Path

from magfusion.jobs.settings import TopicSettings, option


@dataclass(frozen=True, kw_only=True)
class InitSettings(TopicSettings):
    """Description of an installation; on a terminal, missing values are requested."""

    beacon: tuple[str, ...] = option(
        (),
        "A beacon, in the keys of a site; again for each",
        metavar="'NAME KEY=VALUE ...'",
        note="frequency_hz, and position_m, rpy_deg, moment_a_m2, axes, radius_m, synchronised"
        " (false if not given)",
    )
    log: Path | None = option(
        None, "Recording in which to find the tones of the beacons", note="default: none"
    )
    bag: Path | None = option(
        None,
        "Bag of ROS whose /tf_static mounts the magnetometer against the IMU",
        note="for --lever and --mounting that are not given",
    )
    imu: str | None = option(None, "Inertial sensor, from --list-imus")
    magnetometer: str | None = option(None, "Magnetometer, from --list-magnetometers")
    lever: str | None = option(None, "Magnetometer from the IMU, in its axes, m", metavar="X,Y,Z")
    mounting: str | None = option(
        None, "Magnetometer against the IMU, degrees", metavar="ROLL,PITCH,YAW"
    )
    location: str | None = option(
        None, "Place, for gravity and the Earth's field", metavar="LAT,LON,HEIGHT,DATE"
    )
    list_imus: bool = option(False, "List the inertial sensors that are known by name")
    list_magnetometers: bool = option(False, "List the magnetometers that are known by name")

    @property
    def described(self) -> bool:
        """Whether the installation itself is described."""
        findings = (self.imu, self.magnetometer, self.lever, self.mounting, self.location, self.bag)
        return bool(self.beacon) or any(one is not None for one in findings)
