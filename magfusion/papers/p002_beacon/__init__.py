"""Paper 002: calibration of the magnetic centre and attitude of a rotating beacon."""
