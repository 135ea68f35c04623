"""Ensembles of walkers: moves, segments that survive a kill, and when to stop."""
