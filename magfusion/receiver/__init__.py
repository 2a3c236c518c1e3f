"""From the raw waveform to phasors with covariance."""
