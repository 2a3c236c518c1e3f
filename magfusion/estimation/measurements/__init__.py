"""Measurements of the estimators: one file for each kind."""
