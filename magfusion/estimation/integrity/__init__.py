"""Whether measurements and state agree: innovation gate, detection, recovery."""
