"""What a fitted model leaves, on fitted and held-out runs, against the noise."""
