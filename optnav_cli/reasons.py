"""Why a frame has no position, a match is not used, or a solution carries a remark.

A reason is a sentence for people and a code for programs: the column `reason_code` of solution.csv,
matches.csv and evaluation.csv. The sentences may change; the codes stay. Tables and pages count by
the code's words, its label.
"""

from dataclasses import dataclass, replace
from enum import StrEnum

from catalog.errors import NoSolutionError


class ReasonCode(StrEnum):
    """The codes, each with its meaning; TABLES.md refers to this list."""

    meaning: str

    @property
    def label(self) -> str:
        """The code in words: what tables and pages count frames and points by."""
        return self.value.replace("_", " ") or "no reason given"

    def __new__(cls, value: str, meaning: str = "") -> "ReasonCode":
        """A member that is its code, with its meaning beside it."""
        code = str.__new__(cls, value)
        code._value_ = value
        code.meaning = meaning
        return code

    NONE = ""
    # the input of a frame
    BAD_FRAME = "bad_frame", "a field of the frame's row in frames.csv is wrong"
    UNKNOWN_CAMERA = "unknown_camera", "the frame names a camera that has no file"
    BAD_PICTURE = "bad_picture", "the picture is missing, damaged or not as the camera file says"
    BAD_DATA = "bad_data", "data of the catalog that the frame needs is damaged"
    NO_ATTITUDE = "no_attitude", "the frame's attitude is empty"
    NO_SUN = "no_sun", "the direction to the Sun is not known"
    # what the picture shows
    NO_BODY = "no_body", "nothing in the picture stands out of the background"
    NO_SKY = "no_sky", "the body fills the picture, or too little sky is left about it"
    NO_LIMB = "no_limb", "the picture shows no lit limb"
    SHORT_ARC = "short_arc", "too little of the limb is lit and in view for a good position"
    COVERED_LIMB = "covered_limb", "a large part of the lit limb that should be seen is not"
    NOISY_LIMB = "noisy_limb", "too few limb points stand out of the noise"
    SATURATED = "saturated", "too many pixels of the body are at full scale"
    SEVERAL_BODIES = "several_bodies", "two or more discs or spots could be the body"
    OTHER_BODY = "other_body", "the disc in the picture is probably the neighbour's"
    CUT_DISC = "cut_disc", "the frame cuts the disc or its surroundings"
    LARGE_DISC = "large_disc", "the disc is too large for its brightness centre"
    SMALL_DISC = "small_disc", "the disc is too small for its limb, or was solved as a small disc"
    POINT_SOURCE = "point_source", "the disc is no wider than a star"
    THIN_CRESCENT = "thin_crescent", "the phase is too large for the centre of a disc"
    WRONG_LIGHT = "wrong_light", "the light is not that of the body under the Sun of the frame"
    NONLINEAR_COUNTS = "nonlinear_counts", "the limb shows that counts are not linear in light"
    LIMB_MISFIT = "limb_misfit", "the limb does not fit the body's figure or relief"
    # stars
    FEW_STARS = "few_stars", "fewer than four spots that could be stars"
    NO_STARS = "no_stars", "no attitude makes stars of the spots"
    WRONG_LENS = "wrong_lens", "stars or points fit another focal length than the camera file's"
    # the solution
    NO_SOLUTION = "no_solution", "the measurements give no position"
    NOT_SETTLED = "not_settled", "the iteration does not settle on a position"
    INSIDE_BODY = "inside_body", "the position or its prior lies inside the body"
    DEGENERATE = "degenerate", "the measurements leave a direction of the position open"
    NUMERICAL_FAILURE = "numerical_failure", "a computation failed, or memory did not suffice"
    MIRRORED = "mirrored", "picture or coordinates are mirrored: no pose without a reflection fits"
    # priors and control points
    NO_PRIOR = "no_prior", "neither file, outline nor earlier frames give a position to start from"
    NO_CATALOG = "no_catalog", "no catalog was given, so control points were not searched"
    NO_POINTS_IN_VIEW = "no_points_in_view", "the catalog has no point in the frame"
    POINTS_UNLIT = "points_unlit", "the control points in the frame are not lit well"
    POINTS_HIDDEN = "points_hidden", "the control points in the frame are shaded or cut by it"
    FEW_POINTS = "few_points", "too few control points were matched"
    POINTS_DISAGREE = "points_disagree", "the matches do not belong to one position"
    BY_CHANCE = "by_chance", "no more control points agree than chance offers"
    WRONG_SUN = "wrong_sun", "the ground is lit from another side than the stated Sun"
    FAR_FROM_PRIOR = "far_from_prior", "the matches give a position that the prior excludes"
    POINTS_MISSING = "points_missing", "well-lit control points are not where the outline puts them"
    TOO_COARSE = "too_coarse", "a pixel sees more ground than the catalog's coarsest level resolves"
    DISTANT_BODY = "distant_body", "the body is so small in the picture that its limb is better"
    # methods against each other
    WRONG_ATTITUDE = "wrong_attitude", "the picture fits the inverse of the frame's rotation"
    METHODS_DISAGREE = "methods_disagree", "two methods give positions apart by many sigmas"
    CONTRADICTS_ARC = "contradicts_arc", "the position does not lie where the orbit arc leads"
    TOO_FAST = "too_fast", "no craft comes from the fix before to this position in the time"
    PICTURE_REMARK = "picture_remark", "how the picture was read, which people must know"
    NEIGHBOUR_IN_VIEW = "neighbour_in_view", "a second body in the picture was recognised"
    # a descent
    TRACK_JUMP = "track_jump", "the inertial track jumps, or the ground lies where it does not lead"
    CARRIED = "carried", "nothing was measured; the inertial track carries on from frames before"
    RANGE_REFUSED = (
        "range_refused",
        "the altimeter contradicts the picture or meets no ground",
    )
    OUT_OF_VIEW = "out_of_view", "a landmark left the picture"
    LOST = "lost", "a landmark was not found again"
    # a single control point
    DAMAGED_PATCH = "damaged_patch", "the point's patches are damaged in the catalog"
    NO_TERRAIN = "no_terrain", "the catalog has too little terrain about the point"
    IN_SHADOW = "in_shadow", "too little of the point's ground is lit"
    OUTSIDE_FRAME = "outside_frame", "too little of the point's ground is in the frame"
    SEARCH_BORDER = "search_border", "the best match lies at the border of the search"
    LOW_SCORE = "low_score", "the correlation is too low"
    RIVAL = "rival", "a second place correlates nearly as well"
    OUTLIER = "outlier", "the match disagrees with the others"


def format_distinct(value: float, limit: float, decimals: int) -> tuple[str, str]:
    """A number and its limit with so many decimals, or as many as tell them apart."""
    while decimals < 17 and value != limit and f"{value:.{decimals}f}" == f"{limit:.{decimals}f}":
        decimals += 1
    return f"{value:.{decimals}f}", f"{limit:.{decimals}f}"


def describe_length(share: float) -> str:
    """Say by how much a length is longer, in words: "9.7 % shorter" of -0.097."""
    return f"{100.0 * abs(share):.1f} % {'longer' if share > 0.0 else 'shorter'}"


@dataclass(frozen=True)
class Reason:
    """A reason: its code and its sentence; false where there is nothing to say."""

    code: ReasonCode = ReasonCode.NONE
    text: str = ""

    @classmethod
    def from_error(cls, error: NoSolutionError) -> "Reason":
        """Make the reason that an error states."""
        return cls(ReasonCode(error.code), str(error))

    def __bool__(self) -> bool:
        return bool(self.text)

    def __str__(self) -> str:
        return self.text

    def error(self) -> NoSolutionError:
        """The error that says so."""
        return NoSolutionError(self.text, self.code)

    def with_text(self, text: str) -> "Reason":
        """Return the same code with another sentence, which includes this one."""
        return replace(self, text=text)

    def add_sentence(self, other: "Reason") -> "Reason":
        """Both sentences; the code of the first."""
        if not (self and other):
            return self or other
        return replace(self, text=f"{self.text}; {other.text}")


NO_REASON = Reason()
