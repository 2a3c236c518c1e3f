"""Tables of other people: names, units and formats of their own, mapped to the streams of a log."""
