"""What the estimators iterate over: one file for each kind of measurement."""
