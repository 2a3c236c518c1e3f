"""As the data arrive: navigator, filter, fixed lag, and what a checkpoint holds."""
