"""Colours of maps and their legends; all are distinct for colour-blind people.

Values: viridis, bright for good. Reasons: the palette of Okabe and Ito.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from catalog.arrays import ByteArray, FloatArray

USABLE = "#0072b2"
REASON_COLOURS = (
    "#ffffff",
    "#d55e00",
    "#cc79a7",
    "#000000",
    "#f0e442",
    "#009e73",
    "#56b4e9",
    "#8c564b",
)
SOURCE_COLOURS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#d55e00", "#56b4e9", "#f0e442")
OTHER = "#8a8f98"
OUTER_PERCENT = 0.5  # of the values at either end that may share the last colour
STEPS = 64  # colours of a map: as many as eyes distinguish, few enough for small pictures
MIN_RELATIVE_SPAN = 1e-6
WORTH_A_LOG = 8.0  # highest over lowest value, from which a logarithm shows more


@dataclass(frozen=True)
class Scale:
    """Colours of values from `low` to `high`.

    more_is_better  which end is bright
    log             colours and axes follow the logarithm; what is not positive counts as `low`
    """

    low: float
    high: float
    more_is_better: bool
    log: bool = False

    @classmethod
    def of(cls, values: FloatArray, more_is_better: bool, log: bool = False) -> "Scale":
        """A scale for finite values (n,), at least one; the outermost values may lie beyond.

        log  allows a logarithmic one, which is taken where the values span much
        """
        ends = [OUTER_PERCENT, 100.0 - OUTER_PERCENT]
        positive = values[values > 0.0]
        if log and positive.size:
            low, high = (float(v) for v in np.percentile(positive, ends))
            if high > WORTH_A_LOG * low:
                return cls(low, high, more_is_better, True)
        low, high = (float(v) for v in np.percentile(values, ends))
        if high - low <= MIN_RELATIVE_SPAN * max(abs(high), 1.0):
            margin = max(0.1 * abs(high), 0.05)
            low, high = low - margin, high + margin
        return cls(low, high, more_is_better)

    def along(self, values: FloatArray) -> FloatArray:
        """Where values stand on an axis: themselves, or their common logarithm."""
        values = np.asarray(values, np.float64)
        return np.log10(np.maximum(values, self.low)) if self.log else values

    def bgr(self, values: FloatArray) -> ByteArray:
        """Colours (n, 3) of finite values (n,)."""
        return self._bgr(self.along(values))

    def _bgr(self, along: FloatArray) -> ByteArray:
        low, high = self.along(np.array([self.low, self.high]))
        share = np.clip((along - low) / (high - low), 0.0, 1.0)
        share = share if self.more_is_better else 1.0 - share
        step = np.minimum((share * STEPS).astype(np.int64), STEPS - 1)
        places = np.rint((step + 0.5) / STEPS * 255.0).astype(np.uint8)
        coloured = cv2.applyColorMap(places.reshape(-1, 1), cv2.COLORMAP_VIRIDIS)
        colours: ByteArray = coloured.reshape(-1, 3)
        return colours

    def css(self, along: FloatArray) -> list[str]:
        """CSS colours of places (n,) on the axis."""
        return [f"#{r:02x}{g:02x}{b:02x}" for b, g, r in self._bgr(along).tolist()]


def blended(css: str, share: float, gray: float) -> str:
    """A colour as it looks over a gray (0..255) that it covers by a share."""
    mixed = (round(share * channel + (1.0 - share) * gray) for channel in reversed(bgr_of(css)))
    return "#" + "".join(f"{channel:02x}" for channel in mixed)


def bgr_of(css: str) -> tuple[int, int, int]:
    """Blue, green, red of "#rrggbb"."""
    red, green, blue = (int(css[i : i + 2], 16) for i in (1, 3, 5))
    return blue, green, red
