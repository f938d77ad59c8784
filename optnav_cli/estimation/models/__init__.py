"""Measurement models: each says what one kind of measurement tells of a state."""
