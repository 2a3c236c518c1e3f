"""Results: errors, consistency, observability, figures, pictures, recordings."""
