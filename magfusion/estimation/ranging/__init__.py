"""Distance and direction from one well to another."""
