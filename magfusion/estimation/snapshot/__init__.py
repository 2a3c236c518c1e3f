"""Single-epoch pose estimation without an initial guess."""
