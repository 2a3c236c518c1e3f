"""The model: the site, its parameters, and what a magnetometer measures there."""
