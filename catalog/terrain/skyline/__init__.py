"""Skylines: of the terrain around a patch, and of a whole body against the sky."""
