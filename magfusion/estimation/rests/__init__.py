"""Magnetometer and inertial data of a platform that stands still."""
