"""Heights at points and map nodes: means over footprints of pyramid levels."""
