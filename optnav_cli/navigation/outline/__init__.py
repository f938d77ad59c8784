"""A position from a body's outline alone: its limb, or its disc where that is too small."""

from optnav_cli.navigation.outline.solve import BodyFix, detect_limb
from optnav_cli.navigation.outline.which_body import mask_neighbour, navigate

__all__ = ["BodyFix", "detect_limb", "mask_neighbour", "navigate"]
