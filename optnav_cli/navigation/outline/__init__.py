"""A position from a body's outline alone: its limb, or its disc where that is too small."""
