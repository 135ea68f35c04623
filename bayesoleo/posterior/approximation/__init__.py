"""Modes, mixtures around them, and weighted draws: where sampling starts, or all that is needed."""
