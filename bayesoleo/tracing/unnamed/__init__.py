"""Look for a smooth function where no named effect explains what is left."""
