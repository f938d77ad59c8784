"""The world: what there is to see on a body, and how it would look."""
