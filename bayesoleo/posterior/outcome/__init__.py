"""What samples say: trees, predictions, the point estimate beside them, calibration."""
