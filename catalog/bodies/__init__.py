"""A body as a whole: size, mass, rotation, and the direction of its Sun."""
