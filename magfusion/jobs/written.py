"""Files that each job writes, by name; those of one job may block another."""

from magfusion.files.steel_map import STEEL_MAP
from magfusion.model.aiding import QUANTITIES
from magfusion.results.report import FAILED

SITE_FILES = "site.yaml", "site_field_map.parquet", "site_steel.parquet", "site_correlation.parquet"
_SITE = set(SITE_FILES)
_RESULT = {"trajectory.tum", "trajectory.parquet", *_SITE, "run.rrd", "report.json", FAILED}
_TABLES = {
    *("imu.parquet", "magnetometer.parquet", "fields.parquet", "truth.parquet"),
    *("reference.parquet", "gyro.parquet", "accel.parquet"),
    "marks.parquet",
    "depth.parquet",
    *(f"{kind}.parquet" for kind in QUANTITIES),
}
_TRUE_SITE = {f"true_{name}" for name in _SITE}
_LOG = {"log.yaml", *_SITE, *_TRUE_SITE, "report.json", *_TABLES}
UNFINISHED_DRIFT = "unfinished"
KEPT, LOGS, LOGS_TABLE = "kept", "logs", "logs.csv"  # of several logs
PLATFORMS, CALENDAR_TABLE = "platforms", "calendar.csv"
CHECKPOINT, ROWS = "checkpoint.bin", "checkpoint.rows"
# In the directory while these jobs run.
UNFINISHED = {
    "navigate": {CHECKPOINT, ROWS},
    "drift": {UNFINISHED_DRIFT},
    "smooth": {KEPT},
    "calibrate log": {KEPT},
}
WRITTEN = {
    "smooth": _RESULT | {"fixes.parquet", STEEL_MAP, KEPT, LOGS, LOGS_TABLE, PLATFORMS},
    "fix": _RESULT | {"fixes.parquet"},
    "navigate": _RESULT | {"lagged.parquet"} | UNFINISHED["navigate"],
    "drift": {"drift.png", "stability.png", "run.rrd", "report.json"} | UNFINISHED["drift"],
    "drive": {"beacons.wav", "report.json"},
    "import": {"log.yaml", *_TABLES, "report.json"},
    "simulate": _LOG | {"recording.wav"},
    "demodulate": _LOG,
    "survey": {"survey.parquet", "survey.png", "report.json"},
    "calibrate log": _SITE
    | {"calibration.png", "report.json", KEPT, LOGS_TABLE, PLATFORMS, CALENDAR_TABLE, STEEL_MAP},
    "calibrate beacon": _SITE | {"beacon.png", "report.json"},
    "calibrate antenna": _SITE | {"antenna.png", "report.json"},
    "calibrate response": _SITE | {"report.json"},
    "calibrate fieldmap": _SITE | {"field_map.png", "report.json"},
    "calibrate magnetometer": _SITE | {"magnetometer.png", "run.rrd", "report.json"},
    "calibrate attitude-database": {"attitudes.parquet", "attitudes.png", "report.json"},
    "allan": _SITE | {"allan.png", "report.json", FAILED},
    "check": {"check.png", "report.json", FAILED},
    "range": {"range.parquet", "run.rrd", "report.json", FAILED},
    "match": {"attitude.parquet", "attitude.png", "report.json"},
    "coverage": {"coverage.parquet", "coverage.png", "run.rrd", "report.json"},
    "design": _SITE
    | {"coverage.parquet", "design.png", "error_budget.png", "run.rrd", "report.json"}
    | {"motion.parquet", "motion.png"},
    "sheet": _SITE | {"distances.csv", "sheet.pdf", "report.json"},
    "accept": _SITE | {"report.json", FAILED},
}
