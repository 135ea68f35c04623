"""Periodic solutions of implicit differential equations; this layer knows no model."""
