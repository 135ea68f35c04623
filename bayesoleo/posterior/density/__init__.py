"""The log posterior density: errors, unknowns and priors over coordinates without bounds."""
