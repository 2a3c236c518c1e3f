"""Paper 000: the three-axis electromagnetic tracker and its antenna calibration."""
