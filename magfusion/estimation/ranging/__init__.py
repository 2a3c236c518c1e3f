"""From one log of a well to the place of the other well."""
