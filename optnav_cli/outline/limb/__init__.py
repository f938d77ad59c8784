"""The limb: edge points, cone, skyline of the relief."""
