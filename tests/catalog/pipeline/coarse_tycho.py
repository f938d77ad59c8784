"""A build of eleven cells of the real Tycho model, for tests that build many times."""

# coarse and small, so that a build takes a second or two
CONFIG = """
[body]
name = "moon"
[relief]
dem = {path = "bundled:moon_gld100_4ppd.tif"}
[[dem]]
path = "bundled:tycho_gld100_256ppd.tif"
[pyramid]
levels = 3
posting_m = 474.0
size = 64
[render]
candidates = 2
window_nodes = 32
sun_elevations = 2
sun_azimuths = 2
"""
BBOX = (-14.0, -45.0, -9.0, -42.0)
