"""The gate, recovery, the bank and the levels of an estimator that runs."""
