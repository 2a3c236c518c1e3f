"""Integration over the rests of a platform that does not move for a long time."""
