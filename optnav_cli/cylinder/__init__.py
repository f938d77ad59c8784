"""A lit cylinder: distance and angle of the light."""
