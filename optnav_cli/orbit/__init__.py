"""Orbits through fixes, about small moons, to the ground and to targets: settings, fits, files."""
