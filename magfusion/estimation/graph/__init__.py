"""The factor graph: its states, its factors, and the inertial data between epochs."""
