"""Which pixels of a raster have a value.

GDAL's mask decides: an internal mask, a .msk file, a mask of the dataset or of a driver, an alpha
band. GDAL takes an alpha band for a mask only where it holds bytes or words; those of other types
are read here. The no-data value is left to the conversion of counts, which needs no second reading.

A sample of a terrain model's heights, and a value in it that stands for no data without a tag.

Such a value is the lowest or the highest, many pixels share it exactly, and a gap parts it from all
ground: -9999 below heights about 0, or 0 above heights about -3000. Ground is continuous: flat
floors, lakes and clipped models share an extreme, too, but heights next to it follow.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rasterio.enums import ColorInterp, MaskFlags
from rasterio.windows import Window

from catalog.arrays import BoolArray, Float32Array
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


SAMPLE_PIXELS = 4_000_000  # of a model; of a larger one every second, third ... of a row and column
MIN_SHARED = 8  # pixels: real heights that stand alone are never equal so often
MIN_OTHERS = 64  # pixels
MIN_LEVELS = 16  # heights that differ: fewer are no ground but a drawing of steps
# Pixels between the value and the ground that are passed: resampling mixes both along borders.
MIXED_OF_SHARED, MIXED_OF_OTHERS = 0.1, 0.01
MIN_GAP_SPREAD = 0.1  # gap over the spread of all other heights
MIN_GAP_STEPS = 4.0  # gap over the usual step from one height to the next: coarse counts have such
# One of three: gap over the posting (56 deg) along all of a border; gap over the spread; or the gap
# to the very next height over the mean step between the TAIL heights that follow it.
MIN_GAP_SLOPE, MIN_GAP_ALL, MIN_GAP_TAIL, TAIL = 1.5, 1.0, 10.0, 32


class SharedEnd(NamedTuple):
    """One lowest or highest height that stands off from the others, m.

    share  of the sampled pixels that have it
    gap    to the others
    """

    height: float
    share: float
    gap: float
    lowest: bool


class HeightSample:
    """Heights, m, of every so many pixels of a model of rows x cols pixels."""

    def __init__(self, shape: tuple[int, int]) -> None:
        self.step = int(np.ceil(np.sqrt(max(1.0, shape[0] * shape[1] / SAMPLE_PIXELS))))
        self._parts: list[Float32Array] = []

    def add(self, heights: Float32Array) -> None:
        """Add some of a window (rows, cols) of heights, NaN for none."""
        self.add_thinned(heights[:: self.step, :: self.step])

    def add_thinned(self, heights: Float32Array) -> None:
        """Add all heights of a window that has every `step`-th row and column."""
        self._parts.append(heights[np.isfinite(heights)])

    @property
    def heights(self) -> Float32Array:
        """All that was added, in one row."""
        return np.concatenate(self._parts) if self._parts else np.empty(0, np.float32)


def find_shared_end(heights: Float32Array, posting_m: float) -> SharedEnd | None:
    """Find a value that stands for no data among heights (n,), m; None without one."""
    if heights.size < MIN_SHARED + MIN_OTHERS:
        return None
    for sign in (1.0, -1.0):
        signed = heights * np.float32(sign)
        end = float(signed.min())
        others = signed[signed > end]
        shared = signed.size - others.size
        if shared < MIN_SHARED or others.size < MIN_OTHERS:
            continue
        gap = _measure_gap(end, others, shared, posting_m)
        if gap is not None:
            return SharedEnd(sign * end, shared / signed.size, gap, sign > 0.0)
    return None


def _measure_gap(end: float, others: Float32Array, shared: int, posting_m: float) -> float | None:
    """Gap between an extreme and all others above it, m; None for one that ground may have."""
    mixed = int(min(MIXED_OF_SHARED * shared, MIXED_OF_OTHERS * others.size))
    top = others.size - 1 - int(MIXED_OF_OTHERS * others.size)
    ordered = np.partition(others, (TAIL, mixed, top))
    nearest, spread = float(ordered[mixed]), float(ordered[top]) - float(ordered[mixed])
    gap = nearest - end
    if gap < MIN_GAP_SPREAD * spread:
        return None
    first = float(ordered[: TAIL + 1].min())
    apart = first - end >= MIN_GAP_TAIL * (float(ordered[TAIL]) - first) / TAIL
    apart = apart and first - end >= MIN_GAP_SPREAD * spread
    if not (apart or gap >= MIN_GAP_SLOPE * posting_m or gap >= MIN_GAP_ALL * spread):
        return None
    levels = np.unique(others)
    if levels.size < MIN_LEVELS or gap < MIN_GAP_STEPS * float(np.median(np.diff(levels))):
        return None
    return gap
