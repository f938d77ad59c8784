"""Radiance along rays over nested height grids of a body: what a camera anywhere would see.

Cameras are not known here: a picture is given by the rays of its pixels' corners.
"""
