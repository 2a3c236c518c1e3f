"""Integrity of a smoothed log: hypotheses, fault isolation, separation, verdict."""
