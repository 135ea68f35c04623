"""What runs have in common and what not."""
