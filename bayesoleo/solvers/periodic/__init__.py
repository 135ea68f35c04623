"""Periodic solutions on a given mesh: Newton's method on all steps at once."""
