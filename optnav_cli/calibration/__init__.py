"""Calibration of a camera in flight: its lens, mounting and clock by the frames of a route."""
