"""What can be fitted: functions, models over runs, and sections of them."""
