"""Input of a navigator: samples that are not processed yet, and what they measure at an epoch."""
