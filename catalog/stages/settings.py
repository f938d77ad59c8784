"""The build config: one TOML file; every section but [body] and the ground may be left out.

The ground is one or more [[dem]], or one [[mesh]].

Each stage's settings are defined in the file that reads them; here they are put together and
their values checked.
"""

from pathlib import Path

import msgspec

from catalog.config import load_toml
from catalog.errors import ConfigError
from catalog.stages.check import Settings as CheckSettings
from catalog.stages.context import BodySettings, GridSettings, PyramidSettings
from catalog.stages.relief import Settings as ReliefSettings
from catalog.stages.render import Settings as RenderSettings
from catalog.stages.select import Settings as SelectSettings
from catalog.stages.write import Settings as WriteSettings
from catalog.terrain.mesh.file import MeshSettings
from catalog.terrain.source import DemSettings

LARGEST_CELL_DEG = 20.0
MOST_LEVELS = 10
SIZES = (32, 256)
MOST_CELLS = 50_000_000  # cell numbers and chunk lists must stay small


class BuildConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A build config as it is written."""

    body: BodySettings
    dem: tuple[DemSettings, ...] = ()
    mesh: tuple[MeshSettings, ...] = ()
    relief: ReliefSettings = msgspec.field(default_factory=ReliefSettings)
    grid: GridSettings = msgspec.field(default_factory=GridSettings)
    pyramid: PyramidSettings = msgspec.field(default_factory=PyramidSettings)
    render: RenderSettings = msgspec.field(default_factory=RenderSettings)
    select: SelectSettings = msgspec.field(default_factory=SelectSettings)
    check: CheckSettings = msgspec.field(default_factory=CheckSettings)
    write: WriteSettings = msgspec.field(default_factory=WriteSettings)


def load_build_config(path: Path) -> BuildConfig:
    """Read and check a build config. Raises ConfigError naming file, section and key."""
    config = load_toml(path, BuildConfig)
    for problem in _problems(config):
        raise ConfigError(f"{path}: {problem}")
    return config


def _problems(config: BuildConfig) -> list[str]:
    found = []
    if not config.dem and not config.mesh:
        found.append("has no [[dem]] and no [[mesh]] section; name the body's ground")
    if config.mesh and (config.dem or config.relief.dem is not None):
        found.append("has [[mesh]] beside terrain models; a mesh is all of a body: choose one kind")
    if len(config.mesh) > 1:
        found.append(
            f"has {len(config.mesh)} sections [[mesh]]; wanted one: a mesh is all of a body"
        )
    for dem in config.dem:
        if not dem.path:
            found.append("[[dem]] path is empty; name a terrain model")
        if dem.priority < 1:
            found.append(f"[[dem]] priority is {dem.priority}; wanted 1 (used first) or more")
        if dem.scale == 0.0:
            found.append("[[dem]] scale is 0; wanted the height of one count")
    if config.relief.dem is not None and not config.relief.dem.path:
        found.append("[relief] dem path is empty; name a terrain model of the whole body")
    step = config.grid.cell_deg
    smallest = (41_253.0 / MOST_CELLS) ** 0.5  # square degrees of a sphere shared by the cells
    if not smallest <= step <= LARGEST_CELL_DEG:
        found.append(
            f"[grid] cell_deg is {step:g}; wanted between {smallest:.2g} and {LARGEST_CELL_DEG:g}"
        )
    pyramid = config.pyramid
    if not 1 <= pyramid.levels <= MOST_LEVELS:
        found.append(f"[pyramid] levels is {pyramid.levels}; wanted 1 to {MOST_LEVELS}")
    if not SIZES[0] <= pyramid.size <= SIZES[1] or pyramid.size % 2:
        found.append(
            f"[pyramid] size is {pyramid.size}; wanted an even number, {SIZES[0]} to {SIZES[1]}"
        )
    if pyramid.posting_m is not None and pyramid.posting_m <= 0.0:
        found.append(f"[pyramid] posting_m is {pyramid.posting_m:g}; wanted more than 0")
    return found
