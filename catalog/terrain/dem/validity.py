"""Which pixels of a raster have a value.

GDAL's mask decides: an internal mask, a .msk file, a mask of the dataset or of a driver, an alpha
band. GDAL takes an alpha band for a mask only where it holds bytes or words; those of other types
are read here. The no-data value is left to the conversion of counts, which needs no second reading.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rasterio.enums import ColorInterp, MaskFlags
from rasterio.windows import Window

from catalog.arrays import BoolArray
from catalog.special_values import SpecialValues

# Their own masks are of the special values that read_map_label has; that of PDS4 takes those in
# hexadecimal for 0.
LABELLED = ("ISIS3", "ISIS2", "PDS4")


@dataclass(frozen=True)
class Validity:
    """The mask of a band's valid pixels, beside its no-data value.

    masked   GDAL has a mask of its own
    alpha    number of an alpha band that GDAL does not take for a mask; 0: none
    special  stored values that are no measurement
    """

    masked: bool = False
    alpha: int = 0
    special: SpecialValues | None = None

    @classmethod
    def read(cls, dataset: Any, band: int = 1, special: SpecialValues | None = None) -> "Validity":
        """Find the mask of a band of an open dataset."""
        flags = set(dataset.mask_flag_enums[band - 1])
        plain = {MaskFlags.all_valid}, {MaskFlags.nodata}
        has_mask = flags not in plain and not (not flags and dataset.driver in LABELLED)
        alpha = 0
        if MaskFlags.alpha not in flags and ColorInterp.alpha in dataset.colorinterp:
            alpha = dataset.colorinterp.index(ColorInterp.alpha) + 1
        return cls(has_mask, 0 if alpha == band else alpha, special)

    @property
    def is_plain(self) -> bool:
        """Whether all pixels but those of the no-data value count."""
        return not self.masked and not self.alpha and self.special is None

    def valid(
        self, dataset: Any, stored: NDArray[Any], band: int = 1, window: Window | None = None
    ) -> BoolArray:
        """Mark the pixels with a value: bool, of the shape of `stored`, which the window holds.

        Raises rasterio's errors for a damaged file.
        """
        marked: BoolArray = np.ones(stored.shape, dtype=np.bool_)
        if self.masked:
            marked &= dataset.read_masks(band, window=window) > 0
        if self.alpha:
            marked &= dataset.read(self.alpha, window=window) > 0
        if self.special is not None:
            marked &= ~(self.special.is_missing(stored) | self.special.is_saturated(stored))
        return marked

    def stored_type(self, dtype: str) -> str:
        """Type of what `mark_missing` returns: one with NaN for a file with a mask."""
        return dtype if self.is_plain else str(np.result_type(dtype, np.float32))

    def mark_missing(
        self, dataset: Any, stored: NDArray[Any], band: int, window: Window
    ) -> NDArray[Any]:
        """Stored values with NaN where there is none; unchanged for a file without a mask."""
        if self.is_plain:
            return stored
        out = stored.astype(self.stored_type(str(stored.dtype)))
        out[~self.valid(dataset, stored, band, window)] = np.nan
        return out


def list_unused_bands(dataset: Any, used: int, purpose: str) -> list[str]:
    """Name the bands after the first `used` that are neither read nor a mask, in one remark.

    purpose  of the bands that are read, in the plural
    """
    extra = [
        number
        for number, colour in enumerate(dataset.colorinterp, 1)
        if number > used and colour != ColorInterp.alpha
    ]
    if not extra:
        return []
    first = "first" if used == 1 else f"first {used}"
    which = f"band {extra[0]}" if len(extra) == 1 else f"bands {extra[0]}-{extra[-1]}"
    named = [f"'{text}'" for number in extra[:3] if (text := dataset.descriptions[number - 1])]
    shown = f" ({', '.join(named)})" if named else ""
    return [
        f"has {dataset.count} bands, the {first} taken as {purpose}; not used: {which}{shown}. "
        f"State a mask as one: gdal_edit.py -colorinterp_{extra[0]} alpha"
    ]
