"""Landings on a small moon."""
