"""What is minimised, and its linearisation."""
