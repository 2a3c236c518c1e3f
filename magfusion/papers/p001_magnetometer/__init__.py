"""Paper 001: magnetometer calibration and attitude matching."""
