"""Families of periodic solutions, their folds and doublings, and periods that are unknown."""
