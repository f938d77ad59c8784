"""Pixels of a picture file as stored, with what the file says about them."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from catalog.arrays import BoolArray


class StoredPixels(NamedTuple):
    """One band of a picture, its first row being the picture's uppermost.

    values   (h, w), scaled as the file states
    kind     name of the stored type, as numpy has it
    missing  (h, w) marks those without a value; None for none
    full     full scale as the file states it; None where it does not
    remarks  what people must know, a line each
    imported whether `import` wrote the file: its full scale is that of the camera file already
    """

    values: NDArray[np.generic]
    kind: str
    missing: BoolArray | None
    full: float | None = None
    remarks: tuple[str, ...] = ()
    imported: bool = False
