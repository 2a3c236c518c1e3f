"""The first state of an estimator, offline and online."""
