"""Published sets of Hapke's parameters, by body and kind of terrain, as files state them.

configs/photometry/BODY.toml holds those of a body; a body file may have a [photometry] of its own,
and a config may choose one by name or state its numbers.
"""

import math
from functools import cache
from typing import Annotated, NamedTuple

import msgspec
from msgspec import Meta

from catalog.arrays import FloatArray
from catalog.config import load_toml, nearest_name, resource
from catalog.errors import ConfigError

Number = Annotated[float, Meta(ge=-1e6, le=1e6)]
# What the parameters can be. Beyond these the law has no sense: H functions need w < 1, lobes
# |b| < 1, and no ground is rougher than talus.
RANGES: dict[str, tuple[float, float]] = {
    "w": (1e-3, 0.999),
    "b": (0.0, 0.95),
    "c": (-1.5, 1.5),
    "g": (-0.95, 0.95),
    "bs0": (0.0, 10.0),
    "hs": (1e-4, 1.0),
    "theta_bar_deg": (0.0, 60.0),
    "porosity_factor": (1.0, 3.0),
    "wavelength_nm": (100.0, 10_000.0),
    "incidence_max_deg": (0.0, 90.0),
    "emission_max_deg": (0.0, 90.0),
}
MOON = "moon"


class HapkeParameters(NamedTuple):
    """The parameters of a surface.

    w          single-scattering albedo
    b, c       double Henyey-Greenstein lobes: width, and (1 + c) / 2 of it goes backwards
    bs0, hs    amplitude and angular half-width (tan of half the phase) of the opposition surge
    theta_bar  mean slope of the unresolved relief, rad
    """

    w: float
    b: float
    c: float
    bs0: float
    hs: float
    theta_bar: float


class HapkeSet(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Hapke's parameters of a kind of ground, as they are published.

    w, bs0, hs           as in `HapkeParameters`
    b, c                 two lobes, (1 + c) / 2 of the light backwards; or
    g                    one lobe, below 0 backwards
    theta_bar_deg        mean slope of the unresolved relief
    porosity_factor      K of Hapke, Icarus 195 (2008) 918: it multiplies w here, which is exact for
                         single scattering, and right to 1 % of the light for dark ground
    wavelength_nm        of the light;  source  the publication
    phase_deg            lowest and highest phase of the pictures that it was fitted to
    incidence_max_deg, emission_max_deg  largest angles of these
    geometric_albedo     published, of the body at this wavelength, and its sigma
    """

    w: Number
    b: Number | None = None
    c: Number | None = None
    g: Number | None = None
    bs0: Number
    hs: Number
    theta_bar_deg: Number
    porosity_factor: Number = 1.0
    wavelength_nm: Number | None = None
    phase_deg: tuple[Number, Number] | None = None
    incidence_max_deg: Number | None = None
    emission_max_deg: Number | None = None
    geometric_albedo: tuple[Number, Number] | None = None
    source: str = ""

    @property
    def surface(self) -> HapkeParameters:
        """The parameters as kernels take them."""
        b, c = (self.b or 0.0), (self.c or 0.0)
        if self.g is not None:
            b, c = abs(self.g), -math.copysign(1.0, self.g)
        w, roughness = self.w * self.porosity_factor, math.radians(self.theta_bar_deg)
        return HapkeParameters(w, b, c, self.bs0, self.hs, roughness)

    def find_problem(self) -> str | None:
        """Say which number is out of its range or fits no other; None for none."""
        for key, (low, high) in RANGES.items():
            value = getattr(self, key)
            if value is not None and not low <= value <= high:
                return f"{key} is {value:g}; wanted {low:g} to {high:g}"
        if (self.g is None) == (self.b is None and self.c is None) or (
            self.g is None and (self.b is None or self.c is None)
        ):
            return "has no phase function; wanted g, or both b and c"
        surface = self.surface
        if surface.w >= 1.0:
            return f"w times porosity_factor is {surface.w:.3g}; wanted less than 1"
        # the double Henyey-Greenstein function, which is least at one of its ends
        lobe = 1.0 - surface.b**2
        narrow, wide = lobe / (1.0 - surface.b) ** 3, lobe / (1.0 + surface.b) ** 3
        half = 0.5 * (1.0 + surface.c)
        least = min(half * narrow + (1.0 - half) * wide, half * wide + (1.0 - half) * narrow)
        if least < 0.0:
            return (
                f"c is {surface.c:g} with b = {surface.b:g}: the phase function falls to "
                f"{least:.2g}; wanted a c for which it stays above 0, -1 to 1 is safe"
            )
        if self.phase_deg is not None and not 0.0 <= self.phase_deg[0] < self.phase_deg[1] <= 180.0:
            return (
                f"phase_deg is {list(self.phase_deg)}; wanted the lowest and the highest, 0 to 180"
            )
        return None


class PhotometricSet(HapkeSet, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A set with its name: that of its body and its own, such as "moon mare".

    body  whose ground it is
    """

    name: str
    body: str

    def describe(self) -> str:
        """Name, source and range, in a line."""
        phase = (
            "" if self.phase_deg is None else "{:g} to {:g} deg of phase".format(*self.phase_deg)
        )
        return ", ".join(part for part in (self.name, self.source, phase) if part)

    def find_outside(self, phase_deg: FloatArray) -> str | None:
        """Say which phases (n,) lie outside the published range; None for no known range, or none.

        NaN where a phase is not known.
        """
        if self.phase_deg is None:
            return None
        lowest, highest = self.phase_deg
        outside = phase_deg[(phase_deg < lowest) | (phase_deg > highest)]
        if not outside.size:
            return None
        return (
            f"{outside.size} of {phase_deg.size} frames have a phase, {outside.min():.1f} to "
            f"{outside.max():.1f} deg, outside that of the photometric set '{self.name}', "
            f"{lowest:g} to {highest:g} deg: there its brightness is extrapolated"
        )


class BodyPhotometry(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """[photometry] of a body: its sets by name, and which is used unless settings name another."""

    default: str
    sets: dict[str, HapkeSet]

    def name_sets(self, body: str, where: str) -> tuple[PhotometricSet, ...]:
        """The sets with their names, the default first. Raises ConfigError for a wrong one."""
        if self.default not in self.sets:
            raise ConfigError(
                f"{where}: [photometry] default is '{self.default}'; wanted one of "
                f"{', '.join(self.sets) or '[photometry.sets.NAME], of which there is none'}"
            )
        for name, numbers in self.sets.items():
            problem = numbers.find_problem()
            if problem:
                raise ConfigError(f"{where}: [photometry.sets.{name}] {problem}")
        names = sorted(self.sets, key=lambda name: name != self.default)
        return tuple(_name_set(body, name, self.sets[name]) for name in names)


class PhotometrySettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """[photometry] of a config: which set is used for the ground.

    set      a name among those of the body, such as "mare"; unset: the body's default
    numbers  a set of one's own, [photometry.numbers], in place of a name
    """

    set: str | None = None
    numbers: HapkeSet | None = None

    def choose(self, known: tuple[PhotometricSet, ...], body: str) -> PhotometricSet:
        """The set that is asked for among those of a body, the default first.

        Raises ConfigError for an unknown name, or numbers that do not go together.
        """
        if self.numbers is not None:
            problem = self.numbers.find_problem()
            if self.set is not None:
                problem = "stands beside set; wanted one of the two"
            if problem:
                raise ConfigError(f"[photometry.numbers] {problem}")
            return _name_set(body, "stated", self.numbers)
        if self.set is None:
            return known[0]
        names = {each.name.removeprefix(f"{each.body} "): each for each in known}
        if self.set not in names:
            near = nearest_name(self.set, list(names))
            hint = f"did you mean '{near}'?" if near else f"it has {', '.join(names)}"
            raise ConfigError(f"[photometry] set is '{self.set}', which the {body} has not; {hint}")
        return names[self.set]


def _name_set(body: str, name: str, numbers: HapkeSet) -> PhotometricSet:
    return PhotometricSet(name=f"{body} {name}", body=body, **msgspec.structs.asdict(numbers))


@cache
def load_sets(body: str) -> tuple[PhotometricSet, ...]:
    """The sets that ship for a body, the default first; those of the Moon for one without.

    Raises ConfigError for a wrong file.
    """
    folder = resource(f"configs/photometry/{MOON}.toml").parent
    path = folder / f"{body}.toml"
    name = body if body.isidentifier() or body.isalnum() else MOON
    if name != body or not path.is_file():
        name, path = MOON, folder / f"{MOON}.toml"
    return load_toml(path, BodyPhotometry).name_sets(name, str(path))


LUNAR = load_sets(MOON)[0].surface
