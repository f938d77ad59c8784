"""The coarse relief of a whole body."""
