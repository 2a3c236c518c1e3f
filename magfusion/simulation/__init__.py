"""Simulation of motion, inertial sensors, field and waveform, with logs in the usual formats."""
