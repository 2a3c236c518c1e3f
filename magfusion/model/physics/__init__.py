"""Physics as pure, batched functions on arrays."""
