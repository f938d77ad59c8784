"""Radiance along rays over nested height grids of a body: what a camera anywhere would see.

The world knows no cameras: a picture is asked for by the rays of its pixels' corners.
"""
