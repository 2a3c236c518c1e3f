"""Orientation without beacons: from gyroscope, gravity and the Earth's field."""
