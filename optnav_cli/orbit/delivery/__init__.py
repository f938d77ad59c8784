"""Accuracy of a delivery to a body."""
