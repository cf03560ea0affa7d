"""CSV files as logs."""
