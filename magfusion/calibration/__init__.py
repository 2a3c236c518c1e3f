"""Calibration of beacons, antennas and sensors from what they measured, each with a covariance."""
