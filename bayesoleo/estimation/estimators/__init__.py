"""How it is minimised, and the point estimate that results."""
