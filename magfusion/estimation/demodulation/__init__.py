"""Phasors of each beacon from samples, along a motion that is known or assumed."""
