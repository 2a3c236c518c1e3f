"""What a solved graph gives beside its states: marginals, redundancy, noise."""
