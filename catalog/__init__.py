"""The world: what there is to see on a body, and how it would look."""

__version__ = "0.2.0"
