"""Settings of what a picture shows besides the ground: sky, ship, stray light."""

from typing import Annotated

import msgspec
from msgspec import Meta

NotNegative = Annotated[float, Meta(ge=0.0)]
Pixel = tuple[float, float]


class SkySettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The sky behind the body.

    stars_to_magnitude  the star that stands out by 5 sigma of the dark noise; brighter ones by as
                        much as they are brighter, fainter ones drown. 0 shows no stars
    earth               the Earth as a lit disc where the picture looks at it
    """

    stars_to_magnitude: Annotated[float, Meta(ge=0.0, le=6.5)] = 0.0
    earth: bool = False


class GlareSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A smooth veil of stray sunlight.

    strength     at the pixel nearest the Sun, as a share of the bright ground; 0 for none
    falloff_deg  farther from the Sun by this angle the veil is fainter by e
    """

    strength: NotNegative = 0.0
    falloff_deg: Annotated[float, Meta(gt=0.0)] = 30.0


class StructureSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A part of the ship in view of a camera, in front of everything.

    outline_px   corners, px
    width_px     of a rod along the corners; 0: the corners bound a panel
    brightness   share of the bright ground; 0 is black
    camera       which camera sees it; "" for every one
    """

    outline_px: Annotated[tuple[Pixel, ...], Meta(min_length=2)]
    width_px: NotNegative = 0.0
    brightness: NotNegative = 0.0
    camera: str = ""
