"""Horizon navigation: the camera's position from the lit limb, with and without relief."""

from optnav_cli.navigation.horizon.sight import HorizonFix
from optnav_cli.navigation.horizon.solve import navigate

__all__ = ["HorizonFix", "navigate"]
