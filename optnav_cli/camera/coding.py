"""Coding of a camera's counts: from counts as stored to counts that are linear in light.

Cameras store the root of the light, or look counts up in a table, to save bits; pictures for
screens have a gamma. Limbs, discs and cylinders need brightness that is linear in light.
"""

from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from catalog.arrays import FloatArray

MAX_ENTRIES = 65536
Number = Annotated[float, msgspec.Meta(ge=-1e9, le=1e9)]


class Coding(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Relation between stored counts and light.

    curve   "linear": as light;  "square": light grows by the square of the counts;  "gamma": by
            their power `gamma`;  "table": as `counts` and `linear` say, straight lines between
    """

    curve: Literal["linear", "square", "gamma", "table"]
    gamma: Annotated[float, msgspec.Meta(ge=0.1, le=10.0)] | None = None
    counts: tuple[Number, ...] = ()
    linear: tuple[Number, ...] = ()

    def find_problem(self) -> str:
        """Describe what is wrong with the settings, with the remedy; empty for nothing."""
        if (self.gamma is None) == (self.curve == "gamma"):
            return 'gamma belongs to curve = "gamma", and that wants it'
        if self.curve != "table":
            return 'counts and linear belong to curve = "table"' if self.counts else ""
        if not 2 <= len(self.counts) == len(self.linear) <= MAX_ENTRIES:
            return (
                f"the table has {len(self.counts)} counts and {len(self.linear)} linear values; "
                f"wanted as many of both, 2 to {MAX_ENTRIES}"
            )
        if min(np.diff(self.counts).min(), np.diff(self.linear).min()) <= 0.0:
            return "counts and linear of the table must rise from entry to entry"
        return ""

    def decode(self, values: NDArray[Any], full: float) -> FloatArray:
        """Counts linear in light of counts as stored, any shape.

        full  coded counts that are the same decoded; of a power
        """
        if self.curve == "table":
            decoded: FloatArray = np.interp(values, self.counts, self.linear)
            return decoded
        power = self.gamma or (1.0 if self.curve == "linear" else 2.0)
        share = np.maximum(np.asarray(values, np.float64), 0.0) / full
        powered: FloatArray = full * share**power
        return powered

    def format_toml(self) -> str:
        """The section of a camera file."""
        lines = ["", "[coding]", f'curve = "{self.curve}"']
        if self.gamma is not None:
            lines.append(f"gamma = {self.gamma!r}")
        for key in ("counts", "linear"):
            if numbers := getattr(self, key):
                lines.append(f"{key} = {[float(number) for number in numbers]}")
        return "\n".join(lines) + "\n"
