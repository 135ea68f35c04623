"""Which parameters matter for what is predicted."""
