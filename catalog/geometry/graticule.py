"""Nodes on parallels and meridians, in places that are fixed for the whole sphere.

Any part of a graticule has the same nodes, whoever asks for it.
"""

from typing import NamedTuple

import numpy as np

from catalog.arrays import FloatArray, IntArray


class Graticule(NamedTuple):
    """Rows from the south pole on, columns eastward from -180°, nodes half a spacing within.

    row_angle  rad between rows
    columns    in a full turn
    """

    row_angle: float
    columns: int

    @property
    def column_angle(self) -> float:
        """Rad of longitude between columns."""
        return 2.0 * np.pi / self.columns

    def lat(self, row: IntArray) -> FloatArray:
        """Latitude (rad) of rows."""
        return np.asarray((row + 0.5) * self.row_angle - np.pi / 2.0)

    def lon(self, col: IntArray) -> FloatArray:
        """East longitude (rad, -180° to 180°) of columns of any turn: the same in every turn."""
        return np.asarray((np.mod(col, self.columns) + 0.5) * self.column_angle - np.pi)


class Part(NamedTuple):
    """A rectangle of a graticule's nodes: first row (southmost) and column, how many of each."""

    row: int
    col: int
    height: int
    width: int

    @property
    def rows(self) -> IntArray:
        """(height,) numbers of the rows."""
        return np.arange(self.row, self.row + self.height)

    @property
    def cols(self) -> IntArray:
        """(width,) numbers of the columns."""
        return np.arange(self.col, self.col + self.width)
