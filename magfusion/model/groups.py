"""Names of the calibration groups of `magfusion.model.parameters`, without their classes."""

GROUPS = (
    "beacons",
    "moments",
    "phase",
    "magnetometer",
    "extrinsics",
    "time-offset",
    "aiding",
    "ground",
    "earth",
)
