"""Raster terrain models: files opened, georeferenced, converted to metres, laid over each other."""
