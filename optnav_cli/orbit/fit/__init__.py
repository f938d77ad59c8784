"""Orbits through fixes and zenith distances, prediction, OEM and SPK."""
