"""Brightness laws: how much sunlight a bare surface sends towards the camera."""
