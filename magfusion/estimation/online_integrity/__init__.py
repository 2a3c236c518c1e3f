"""Integrity of a running estimate: gate, recovery, separation, levels."""
