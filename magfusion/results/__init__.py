"""What became of it: errors, consistency, observability, figures, pictures, recordings."""
