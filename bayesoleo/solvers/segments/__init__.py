"""Trajectories cut into short steps, continuous at the solution only: multiple shooting."""
