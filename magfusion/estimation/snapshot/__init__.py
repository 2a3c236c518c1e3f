"""From one epoch to a pose, without a prior guess."""
