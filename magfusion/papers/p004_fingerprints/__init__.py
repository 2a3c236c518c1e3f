"""Paper 004: position and attitude among two-axis rotating beacons by fingerprints."""
