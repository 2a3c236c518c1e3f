"""The ground: pure functions of physics on arrays, batched."""
