"""Recorded data: the log and its readers and writers."""
