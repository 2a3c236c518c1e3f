"""Pictures of results: the only subpackage that imports matplotlib."""
