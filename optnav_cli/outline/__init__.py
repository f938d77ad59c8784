"""Positions from a body's outline: limb, small disc, silhouette, neighbour."""
