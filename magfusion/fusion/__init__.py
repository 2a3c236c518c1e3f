"""Fields and inertial data in one estimate."""
