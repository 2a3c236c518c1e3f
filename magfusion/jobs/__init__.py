"""One module per job: its settings, its run, its command."""

# Path of each command, in listing order: the module of its job, and a description.
JOBS = {
    "smooth": ("smooth", "Smooth a log: trajectory and calibration in one solution."),
    "fix": ("fix", "Fix the pose at every epoch on its own, with every remaining hypothesis."),
    "import": (
        "import_log",
        "Import tables of any names and units, a bag, a EuRoC folder or a flight log.",
    ),
    "check": ("check", "Check a log in seconds: consistency of streams, fields and first fixes."),
    "init": (
        "init",
        "Write a commented site file: from options, the tones of a recording, or questions.",
    ),
    "allan": (
        "allan",
        "Measure the instruments' noise at rest, in the keys of a site, by Allan deviations.",
    ),
    "navigate": (
        "navigate",
        "Navigate online: along a log, or live from standard input (-) or ROS 2 (ros2:).",
    ),
    "evaluate": (
        "evaluate",
        "Compare a trajectory with a truth: ATE, RPE and attitude, absolute and aligned.",
    ),
    "export": ("export", "Export a result as a ROS 2 bag (MCAP, db3), TUM, KITTI or CSV."),
    "view": ("view", "Open the recording of a result in the rerun viewer."),
    "demo": (
        "demo",
        "Simulate a two-minute walk among four beacons, smooth it, and show the result.",
    ),
    "demodulate": (
        "demodulate",
        "Demodulate a log's waveform to phasors: a log that every other command reads.",
    ),
    "survey": (
        "survey",
        "Make a fingerprint survey from a log: the fields at places with known poses.",
    ),
    "range": (
        "range_wells",
        "Range one well from another with a rotating magnet: distance, direction, along-hole.",
    ),
    "match": (
        "match",
        "Estimate roll, or roll and pitch, from the Earth's field, by a database or closed form.",
    ),
    "listen": (
        "listen",
        "Print the samples of a sound card, serial line or UDP as records for navigate -.",
    ),
    "replay": ("replay", "Print a log as records for magfusion navigate -."),
    "papers": (
        "papers",
        "Show where an equation, table, figure or claim of four papers is, and if it holds.",
    ),
    "simulate": ("simulate", "Simulate a log, with truth, in the usual file formats."),
    "coverage": (
        "coverage",
        "Show where an installation can navigate: bounds of position and attitude over a volume.",
    ),
    "design": (
        "design",
        "Design an installation: places, axes and frequencies of beacons for a hall.",
    ),
    "coil": (
        "coil",
        "Tabulate what a coil of wire gives: moment, volts, watts, warming, capacitor, fields.",
    ),
    "drive": ("drive", "Write a sound file that is played for the beacons of a site."),
    "sheet": (
        "sheet",
        "Write a setting-out sheet: plan, coordinates, axes, tolerances, check distances (PDF).",
    ),
    "accept": (
        "accept",
        "Accept an installation: fields at marks and check distances prove each beacon.",
    ),
    "drift": (
        "drift",
        "Test the long-term stability of the online estimators on days of simulated data.",
    ),
    "calibrate beacon": (
        "calibrate_beacon",
        "Estimate the magnetic centre, attitude and moments of beacons from a survey.",
    ),
    "calibrate fieldmap": (
        "calibrate_fieldmap",
        "Map the deviation of the beacons' fields from their model, for every later job.",
    ),
    "calibrate magnetometer": (
        "calibrate_magnetometer",
        "Calibrate the magnetometer from a log of slow rotation by hand, in the Earth's field.",
    ),
    "calibrate log": (
        "calibrate_log",
        "Refine the site with a log of ordinary motion, and report missing motion.",
    ),
    "calibrate antenna": (
        "calibrate_antenna",
        "Calibrate a tracker's antennas at known poses: moments, axes and centres of all six"
        " coils.",
    ),
    "calibrate response": (
        "calibrate_response",
        "Estimate gain and phase of a receiver's axes at each tone, by a coil on a bench.",
    ),
    "calibrate attitude-database": (
        "attitude_database",
        "Tabulate the measured field over the attitude, for magfusion match.",
    ),
}
GROUPS = {"calibrate": "Calibrate beacons, magnetometer and site."}
