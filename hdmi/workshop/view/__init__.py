"""Looking at reference motions."""
