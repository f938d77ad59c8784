"""Picked points: position from places that a person marked in a picture."""
