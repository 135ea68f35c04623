"""Periodic solutions on a mesh of their own."""
