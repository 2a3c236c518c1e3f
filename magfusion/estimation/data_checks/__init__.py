"""Checks of samples, spectra and stamps, before any estimate."""
