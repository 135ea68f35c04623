"""Estimation from chaotic and other transient records by multiple shooting."""
