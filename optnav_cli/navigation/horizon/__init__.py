"""Horizon navigation: the camera's position from the lit limb, with and without relief."""
