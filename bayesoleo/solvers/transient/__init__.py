"""Solutions from given states through a time."""
