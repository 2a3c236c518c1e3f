"""Navigation from magnetic beacons and inertial sensors.

Conventions, stated once for the whole package.

Frames
    ``world`` (local level, z up), ``body`` (the IMU's axes and origin), ``sensor`` (the
    magnetometer triad), ``beacon`` (the coil axes).  A rotation or pose is named
    ``a_from_b``; a vector carries the frame whose axes it is written in as a suffix
    (``field_body``).  ``position_world`` is the body's origin unless another point is named;
    an offset points from the beacon to the sensor.
Perturbations
    On the right (body side) and in GTSAM's order: rotation, then translation, both in body
    axes (``Pose3``); accelerometer, then gyroscope (``imuBias``).
Residuals
    Predicted minus measured.
Units
    SI in memory and in files: s, m, rad, T, A m^2.  Anything else says so in its name
    (``_deg``, ``_hz``, ``_ns``, ``_nt``).  Times are seconds since the log's epoch.
Phasors
    ``field(t) = Re(phasor * exp(+2j*pi*frequency_hz*(t - epoch)))`` in the magnetometer's own
    axes, as the instrument gave it: ``measured = matrix @ field_sensor + offset``.
Standard deviations end in ``_sigma``, covariances in ``_cov``.
"""
