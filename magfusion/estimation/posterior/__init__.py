"""What a solved graph says beside its states: marginals, residuals, noise."""
