"""How a period is cut into steps, and the linear algebra of steps."""
