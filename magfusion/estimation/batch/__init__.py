"""One or several whole logs: preparation, start, graph, passes, self survey."""
