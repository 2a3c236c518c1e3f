"""The factor graph: states, factors, and the inertial data between epochs."""
