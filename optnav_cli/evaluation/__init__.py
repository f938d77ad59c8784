"""Solutions against the truth."""
