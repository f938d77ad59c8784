"""The build config: one TOML file; every section but [body] and the ground may be left out.

The ground is one or more [[dem]], or one [[mesh]]. An [[image]] stands beside [[dem]] or alone.

A section's settings are a struct of its own here; values that depend on each other are checked.
"""

import json
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Annotated, Literal

import msgspec

from catalog.bodies.body import is_body_file
from catalog.config import BUNDLED, Positive, Slope, parse_toml, read_toml_text, resolve_config
from catalog.errors import ConfigError
from catalog.photometry.sets import PhotometrySettings
from catalog.store.manifest import LIMITS
from catalog.terrain.dem.image import ImageSection
from catalog.terrain.dem.source import DemSettings
from catalog.terrain.error_model import StatedError
from catalog.terrain.mesh.file import MeshSettings

STEPS_PER_POSTING = 237.0
COARSEST_STEP_M = 4.0
MAX_CELL_DEG = 20.0
MAX_LEVELS = 10
SIZES = (32, 256)
MAX_CELLS = 50_000_000  # cell numbers and chunk lists must stay small
# Endings by which a terrain model is known where it stands in place of a config.
RASTERS = (".tif", ".tiff", ".lbl", ".img", ".cub", ".vrt", ".xml", ".jp2", ".asc")

Share = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]
Elevation = Annotated[float, msgspec.Meta(ge=0.01, le=89.99)]
HeightStep = Annotated[
    float, msgspec.Meta(ge=LIMITS["height_step_m"][0], le=LIMITS["height_step_m"][1])
]
Snr = Annotated[float, msgspec.Meta(ge=1e-3, le=1e6)]


class BodySettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """[body]. name: of configs/bodies, or the path of a body file, from this file's folder."""

    name: str


class DemSection(DemSettings, frozen=True, forbid_unknown_fields=True):
    """[[dem]]: a terrain model, and how far it may be wrong.

    product        whose error is known: a name of configs/models/terrain.toml; or, in numbers,
    error_m        rms of means over 2 km on highland slopes (0.085)
    resolution_km  the shortest wave that the model holds; two postings unless stated
    role           "ground": points are made from it; "comparison": they are compared with it
    """

    product: str | None = None
    error_m: Positive | None = None
    resolution_km: Positive | None = None
    role: Literal["ground", "comparison"] = "ground"


class MeshSection(MeshSettings, frozen=True, forbid_unknown_fields=True):
    """[[mesh]]: a shape model; its error as that of a [[dem]], product = "mesh" by its posting."""

    product: str | None = None
    error_m: Positive | None = None
    resolution_km: Positive | None = None


def make_stated_error(section: DemSection | MeshSection) -> StatedError:
    """Return the error that a section states of its model."""
    return StatedError(section.product, section.error_m, section.resolution_km)


class GridSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """[grid]. cell_deg: side of a cell, one control point each; 1 gives 41 252 on a sphere."""

    cell_deg: float = 1.0


class PyramidSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """[pyramid]. Patches of a control point.

    levels     grids, each of twice the posting of the one before; of a mesh, at most so many and
               none that spans more than 30 deg
    size       nodes a side of each
    posting_m  of the finest; without it the finest DEM's own, or, of a mesh, so that the finest
               spans two cells
    """

    levels: int = 5
    size: int = 80
    posting_m: Annotated[float, msgspec.Meta(ge=1e-3, le=1e6)] | None = None


class ReliefSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """[relief].

    dem  a terrain model of the whole body, for the ground that no [[dem]] shows; without it a
         catalog carries a relief only if its own models show the whole body. Settings are those
         of [[dem]], but for priority and feather_km: it lies below all others.
    """

    dem: DemSettings | None = None

    def __post_init__(self) -> None:
        if self.dem is not None and (self.dem.priority != 1 or self.dem.feather_km != 0.0):
            raise ValueError("dem has a priority or feather_km; it lies below all others")


class WriteSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """[write].

    height_step_m  what heights are rounded to, at all levels. Without it a share of each level's
                   posting, so that rounding turns slopes by 0.05 deg rms at most, whatever the
                   level: 0.5 m at 118 m; and no more than 4 m, which is 1.2 m rms, a tenth of what
                   lunar stereo models err by. A point of 5 levels of 80 nodes at 118 m takes 21 kB
                   so, and 29 kB with half a metre at all levels.
    """

    height_step_m: HeightStep | None = None

    def steps_m(self, postings_m: Sequence[float]) -> tuple[float, ...]:
        """The step of each level, finest first."""
        if self.height_step_m is not None:
            return (self.height_step_m,) * len(postings_m)
        return tuple(min(posting / STEPS_PER_POSTING, COARSEST_STEP_M) for posting in postings_m)


class CheckSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """[check].

    places               of a cell that are tried at most
    max_localisation_nodes            predicted error above which a place is called flat
    search_km            where a rival may stand at the coarsest level
    min_margin           least uniqueness margin over all levels
    max_shadowed         share of Suns under which foreign shadows may reach the patch
    trials               recognition trials of a place, at most: the verdict ends them
    min_recognition      share of all of them that must succeed
    good_recognition     share with which a place is taken without trying the cell's next one; by
                         default the least: looking on for a better one finds none
    template_nodes       side of the square that is matched in a trial
    max_error_nodes      a match further from the truth has failed
    min_score, rival_ratio            gate of a match, as navigation has it
    sun_min_deg, sun_max_deg          Suns of the trials
    snr_min, snr_max, scale_error, roll_deg, off_nadir_deg  what the trials' pictures suffer from
    relief_slope_deg     rms slope of the random relief that the picture's ground has beyond the
                         DEM's; craters come on top
    """

    places: Annotated[int, msgspec.Meta(ge=1, le=64)] = 3
    max_localisation_nodes: Positive = 3.0
    search_km: Annotated[float, msgspec.Meta(ge=1e-3, le=1e3)] = 10.0
    min_margin: Share = 0.05
    max_shadowed: Share = 0.75
    trials: Annotated[int, msgspec.Meta(ge=1, le=1000)] = 5
    min_recognition: Share = 0.6
    good_recognition: Share = 0.6
    template_nodes: Annotated[int, msgspec.Meta(ge=16, le=256, multiple_of=2)] = 64
    max_error_nodes: Positive = 1.5
    min_score: Share = 0.5
    rival_ratio: Share = 0.9
    sun_min_deg: Elevation = 10.0
    sun_max_deg: Elevation = 45.0
    snr_min: Snr = 10.0
    snr_max: Snr = 50.0
    scale_error: Annotated[float, msgspec.Meta(ge=0.0, le=0.3)] = 0.1
    roll_deg: Annotated[float, msgspec.Meta(ge=0.0, le=20.0)] = 6.0
    off_nadir_deg: Annotated[float, msgspec.Meta(ge=0.0, le=60.0)] = 25.0
    relief_slope_deg: Slope = 3.0


class ComparisonSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """[comparison].

    max_shift_m  a point whose ground a [[dem]] of role "comparison" has farther away is not usable;
                 without it shifts are only stored
    """

    max_shift_m: Positive | None = None


class SelectSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """[select].

    percentile    of the predicted errors over the Suns that counts; 100 is the worst Sun
    spacing_cell  least distance between points of different cells, share of a cell
    """

    percentile: Annotated[float, msgspec.Meta(ge=0.0, le=100.0)] = 90.0
    spacing_cell: Share = 0.6


class RenderSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """[render].

    candidates       places of a cell that are rendered and go on to selection
    separation_cell  least distance between them, share of a cell
    inset_cell       strip along a cell's borders where no candidate is taken, share of a cell
    window_nodes     side of the square that is scored: the template at the finest level
    levels           pyramid levels that are rendered, finest first
    sun_elevations, sun_azimuths, sun_min_deg, sun_max_deg  the Suns, of those that can occur:
                     away from the poles (75 deg) an elevation leaves two narrow bands of azimuth;
                     nearer to them at least eight azimuths are taken
    sun_declination_deg  how far from the body's equator the Sun stands
    law              of the render
    snr              mean brightness over noise, for the predicted error

    The defaults are the cheapest that lose nothing: with 24 candidates, two levels and 32 Suns
    the places were recognised as often (0.8 ± 1.0 points less), at seven times the cost.
    """

    candidates: Annotated[int, msgspec.Meta(ge=1, le=64)] = 8
    separation_cell: Annotated[float, msgspec.Meta(gt=0.0, le=1.0)] = 0.12
    inset_cell: Annotated[float, msgspec.Meta(ge=0.0, lt=0.5)] = 0.1
    window_nodes: Annotated[int, msgspec.Meta(ge=16, le=256)] = 64
    levels: Annotated[int, msgspec.Meta(ge=1, le=10)] = 1
    sun_elevations: Annotated[int, msgspec.Meta(ge=1, le=32)] = 2
    sun_azimuths: Annotated[int, msgspec.Meta(ge=2, le=64, multiple_of=2)] = 2
    sun_min_deg: Elevation = 8.0
    sun_max_deg: Elevation = 45.0
    sun_declination_deg: Annotated[float, msgspec.Meta(ge=0.0, le=90.0)] = 1.54
    law: Literal["hapke", "lommel_seeliger", "lunar_lambert", "lambert"] = "hapke"
    snr: Snr = 10.0


class BuildConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A build config as it is written."""

    body: BodySettings
    dem: tuple[DemSection, ...] = ()
    mesh: tuple[MeshSection, ...] = ()
    image: tuple[ImageSection, ...] = ()
    relief: ReliefSettings = msgspec.field(default_factory=ReliefSettings)
    grid: GridSettings = msgspec.field(default_factory=GridSettings)
    pyramid: PyramidSettings = msgspec.field(default_factory=PyramidSettings)
    render: RenderSettings = msgspec.field(default_factory=RenderSettings)
    select: SelectSettings = msgspec.field(default_factory=SelectSettings)
    check: CheckSettings = msgspec.field(default_factory=CheckSettings)
    comparison: ComparisonSettings = msgspec.field(default_factory=ComparisonSettings)
    write: WriteSettings = msgspec.field(default_factory=WriteSettings)
    photometry: PhotometrySettings = PhotometrySettings()

    def select_dems(self, role: str) -> list[DemSection]:
        """The terrain models of a role, the first used first."""
        return sorted((d for d in self.dem if d.role == role), key=lambda dem: dem.priority)


@dataclass(frozen=True)
class ConfigText:
    """A build config's text, and the place that messages name and paths in it start from."""

    path: Path
    text: str

    @classmethod
    def read(cls, path: Path) -> "ConfigText":
        """A file, or "bundled:NAME" for one that ships with optnav. Raises ConfigError."""
        path = resolve_config(path, "catalogs")
        return cls(path, read_toml_text(path))

    @classmethod
    def make_from_rasters(cls, rasters: Sequence[Path], body: str) -> "ConfigText":
        """The config that has nothing but terrain models, the one used first before the others.

        Paths in it start from the folder of the first, so that it says the same wherever that is.
        Raises ConfigError for a name that is not text.
        """
        base = rasters[0].parent

        def named(path: str) -> str:
            name = path if path.startswith(BUNDLED) else os.path.relpath(path, base)
            return json.dumps(name, ensure_ascii=False)  # text of TOML is written alike

        for name in (*map(str, rasters), body):
            if not name.isprintable():
                raise ConfigError(
                    f"{name!r}: has characters in its name that no config can hold; rename it"
                )
        lines = ["[body]", f"name = {named(body) if is_body_file(body) else json.dumps(body)}"]
        for priority, raster in enumerate(rasters, start=1):
            lines += ["", "[[dem]]", f"path = {named(str(raster))}", f"priority = {priority}"]
        return cls(rasters[0], "\n".join(lines) + "\n")

    def load(self) -> BuildConfig:
        """Check it. Raises ConfigError naming file, section and key."""
        config = parse_toml(self.text, BuildConfig, self.path)
        for problem in chain(
            _find_ground_problems(config),
            _find_image_problems(config),
            _find_comparison_problems(config),
            _find_size_problems(config),
        ):
            raise ConfigError(f"{self.path}: {problem}")
        return config


def load_build_config(path: Path) -> BuildConfig:
    """Read and check a build config. Raises ConfigError naming file, section and key."""
    return ConfigText.read(path).load()


def _find_ground_problems(config: BuildConfig) -> Iterator[str]:
    if not config.dem and not config.mesh and not config.image:
        yield "has no [[dem]], [[mesh]] or [[image]] section; name the body's ground"
    if config.mesh and (config.dem or config.relief.dem is not None):
        yield "has [[mesh]] beside terrain models; a mesh is all of a body: choose one kind"
    if len(config.mesh) > 1:
        yield f"has {len(config.mesh)} sections [[mesh]]; wanted one: a mesh is all of a body"
    for dem in config.dem:
        if not dem.path:
            yield "[[dem]] path is empty; name a terrain model"
        if dem.scale == 0.0:
            yield "[[dem]] scale is 0; wanted the height of one count"
    sections: list[DemSection | MeshSection] = [*config.dem, *config.mesh]
    for section in sections:
        problem = make_stated_error(section).find_problem(of_mesh=bool(config.mesh))
        if problem:
            yield f"{'[[mesh]]' if config.mesh else '[[dem]]'} {section.path}: {problem}"
    if config.relief.dem is not None and not config.relief.dem.path:
        yield "[relief] dem path is empty; name a terrain model of the whole body"


def _find_image_problems(config: BuildConfig) -> Iterator[str]:
    if config.image and config.mesh:
        yield "has [[image]] beside [[mesh]]; images lie on terrain models or the ellipsoid"
    if len(config.image) > 1:
        many = len(config.image)
        yield f"has {many} sections [[image]]; wanted one: join images with gdalbuildvrt"
    for image in config.image:
        if not image.path:
            yield "[[image]] path is empty; name an orthoimage"


def _find_comparison_problems(config: BuildConfig) -> Iterator[str]:
    if config.dem and not config.select_dems("ground"):
        yield '[[dem]] has role = "comparison" alone; name the ground that is compared, too'
    if config.comparison.max_shift_m is not None and not config.select_dems("comparison"):
        yield '[comparison] max_shift_m is set, but no [[dem]] has role = "comparison"; add one'
    for dem in config.select_dems("comparison"):
        if make_stated_error(dem) != StatedError():
            yield f"[[dem]] {dem.path}: has an error; that of a comparison model enters nothing"


def _find_size_problems(config: BuildConfig) -> Iterator[str]:
    step, pyramid = config.grid.cell_deg, config.pyramid
    smallest = (41_253.0 / MAX_CELLS) ** 0.5  # square degrees of a sphere shared by the cells
    if not smallest <= step <= MAX_CELL_DEG:
        yield f"[grid] cell_deg is {step:g}; wanted between {smallest:.2g} and {MAX_CELL_DEG:g}"
    if not 1 <= pyramid.levels <= MAX_LEVELS:
        yield f"[pyramid] levels is {pyramid.levels}; wanted 1 to {MAX_LEVELS}"
    if not SIZES[0] <= pyramid.size <= SIZES[1] or pyramid.size % 2:
        yield f"[pyramid] size is {pyramid.size}; wanted an even number, {SIZES[0]} to {SIZES[1]}"
    render, check = config.render, config.check
    for section, name, low, high in (
        ("render", "sun_{}_deg", render.sun_min_deg, render.sun_max_deg),
        ("check", "sun_{}_deg", check.sun_min_deg, check.sun_max_deg),
        ("check", "snr_{}", check.snr_min, check.snr_max),
    ):
        if low > high:
            least, most = name.format("min"), name.format("max")
            yield f"[{section}] {least} is {low:g}; wanted at most {most}, {high:g}"
