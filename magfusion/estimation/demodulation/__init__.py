"""Phasors of each beacon from samples, along a known or assumed motion."""
