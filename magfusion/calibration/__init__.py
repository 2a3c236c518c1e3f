"""Calibration of beacons, antennas and sensors from measurements, each with a covariance."""
