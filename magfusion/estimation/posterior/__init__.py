"""Results of a solved graph besides its states: marginals, redundancy, noise."""
