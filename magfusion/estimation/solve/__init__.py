"""The optimisation loops: many small problems at once, and poses with a dense border."""
