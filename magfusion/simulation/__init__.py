"""Motion, inertial sensors, field and waveform: a log in the same files a user has."""
