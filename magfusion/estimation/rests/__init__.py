"""Integration over the rests of a platform that stands still for long."""
