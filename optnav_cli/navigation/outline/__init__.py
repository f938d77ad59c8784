"""A position from a body's outline alone: its limb, or its disc where that is too small."""

from optnav_cli.navigation.outline.solve import Outline, limb_of
from optnav_cli.navigation.outline.which_body import navigate, without_other

__all__ = ["Outline", "limb_of", "navigate", "without_other"]
