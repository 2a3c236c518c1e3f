"""One file a job: its settings, its run, its command."""

# Path of each command, in the order of the listing: the file of its job, and what it does.
JOBS = {
    "smooth": (
        "smooth",
        "Smooth a log into the best trajectory, with the calibration in the same solution.",
    ),
    "fix": (
        "fix",
        "Fix the pose at every epoch on its own, with every hypothesis that survives.",
    ),
    "import": (
        "import_log",
        "Import tables of any names and units, a bag or a EuRoC folder: a log, and its check.",
    ),
    "check": (
        "check",
        "Check a log in seconds: what its streams, fields and first fixes say against it.",
    ),
    "init": (
        "init",
        "Write a commented site file: from options, the tones of a recording, or questions.",
    ),
    "allan": (
        "allan",
        "Measure the noise of the instruments at rest, in the keys of a site, by Allan deviations.",
    ),
    "navigate": (
        "navigate",
        "Navigate online: along a log, or by records on standard input (-).",
    ),
    "evaluate": (
        "evaluate",
        "Compare a trajectory with a truth: ATE, RPE and attitude, absolute and aligned.",
    ),
    "export": (
        "export",
        "Hand a result on: as a ROS 2 bag (MCAP, db3), TUM, KITTI or CSV.",
    ),
    "view": ("view", "Open the recording of a result in the rerun viewer."),
    "demo": (
        "demo",
        "Simulate a two-minute walk among four beacons, smooth it, and show the result.",
    ),
    "demodulate": (
        "demodulate",
        "Turn a log's waveform into phasors: a log that every other command reads.",
    ),
    "survey": (
        "survey",
        "Make a fingerprint survey of a log: the fields at places with known poses.",
    ),
    "range": (
        "range_wells",
        "Range one well from another by a turning magnet: distance, direction, along the hole.",
    ),
    "match": (
        "match",
        "Find roll, or roll and pitch, from the Earth's field, by a database or in closed form.",
    ),
    "replay": ("replay", "Print a log as the records that magfusion navigate - reads."),
    "papers": (
        "papers",
        "Say of any equation, table, figure or claim of four papers where it is and if it holds.",
    ),
    "simulate": ("simulate", "Simulate a log, with truth, in the files a user has."),
    "coverage": (
        "coverage",
        "Show where an installation can navigate: bounds of position and attitude over a volume.",
    ),
    "design": (
        "design",
        "Design an installation: places, axes and frequencies of beacons for a hall.",
    ),
    "drift": (
        "drift",
        "Test that the online estimators do not drift, on days of simulated data.",
    ),
    "calibrate beacon": (
        "calibrate_beacon",
        "Find the magnetic centre, attitude and moments of beacons from a survey around them.",
    ),
    "calibrate fieldmap": (
        "calibrate_fieldmap",
        "Learn where the beacons' fields differ from their model, for every later job.",
    ),
    "calibrate magnetometer": (
        "calibrate_magnetometer",
        "Calibrate the magnetometer on a log of slow turning by hand, in the Earth's field.",
    ),
    "calibrate log": (
        "calibrate_log",
        "Refine the site by a log of ordinary motion, and report what motion is missing.",
    ),
    "calibrate antenna": (
        "calibrate_antenna",
        "Calibrate a tracker's antennas at known poses: moments, axes and centres of all six"
        " coils.",
    ),
    "calibrate attitude-database": (
        "attitude_database",
        "Tabulate the measured field over the attitude, for magfusion match.",
    ),
}
GROUPS = {"calibrate": "Calibrate beacons, magnetometer and site."}
