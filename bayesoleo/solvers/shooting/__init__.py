"""Periodic solutions by integrating from a start and closing the period."""
