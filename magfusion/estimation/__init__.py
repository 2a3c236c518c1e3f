"""From phasors and inertial data to poses: one epoch, a whole log, or as the data arrive."""
