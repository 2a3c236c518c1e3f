"""What the samples alone say of themselves, before any estimator has them."""
