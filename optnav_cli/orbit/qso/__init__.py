"""Quasi-satellite orbits."""
