"""A whole log at once: its graph, several logs, several magnetometers, a self survey."""
