"""Placement of beacons and of calibration stops, by the Cramér-Rao bound."""
