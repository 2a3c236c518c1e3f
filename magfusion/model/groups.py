"""Names of the calibration groups of `magfusion.model.parameters`, for who only names them."""

GROUPS = (
    "beacons",
    "moments",
    "phase",
    "magnetometer",
    "extrinsics",
    "time-offset",
    "ground",
    "earth",
)
