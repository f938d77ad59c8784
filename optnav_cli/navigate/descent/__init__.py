"""Descent: windows of the model and landmarks along an inertial track."""
