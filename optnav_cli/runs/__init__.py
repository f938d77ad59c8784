"""Whole jobs over a folder: pictures in, a run folder out."""
