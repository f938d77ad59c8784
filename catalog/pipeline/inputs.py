"""What a build works on: terrain models read, posting settled, cells found and cut into chunks."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import msgspec

import catalog
from catalog.errors import ConfigError
from catalog.geometry.cells import CellGrid
from catalog.jobs.workspace import compute_stage_key, hash_package
from catalog.photometry.sets import PhotometricSet
from catalog.pipeline.comparison import check_comparison
from catalog.pipeline.config import BuildConfig, DemSection, MeshSection, make_stated_error
from catalog.pipeline.context import DemRecord, IngestRun, StageContext
from catalog.pipeline.ingest import (
    Bbox,
    MeshRecord,
    cut_chunks,
    find_covered_cells,
    ingest,
    ingest_image,
    ingest_mesh,
    list_ground_sections,
    settle_mesh_relief,
    settle_pyramid,
)
from catalog.pipeline.relief import ReliefRecord, settle_relief
from catalog.store.manifest import ComparisonMeta, ImageMeta
from catalog.terrain.dem.mosaic import Mosaic
from catalog.terrain.error_model import TerrainErrorModel
from catalog.terrain.terrain import Terrain

MANIFEST = "manifest.json"
MAX_OVERSAMPLING = 4.0  # a posting finer than the terrain model by more shows nothing new
MAX_NODES_ACROSS = 8192  # of a cell: a grid of 268 MB, of which a worker holds several


@dataclass(frozen=True)
class BuildInputs:
    """The ground of a build.

    chunks  cells, cut into pieces of work
    keys    by stage: hash of all that its results depend on
    relief  of the whole body; None for a build of a part of it that names none
    errors  of the terrain models that state one, by name as in points' sources
    comparison  what the catalog says of a second terrain model; None without one
    image       what it says of the image that templates are; None without one
    """

    context: StageContext
    dems: list[DemRecord | MeshRecord]
    chunks: list[list[int]]
    keys: dict[str, str]
    relief: ReliefRecord | None
    errors: dict[str, TerrainErrorModel]
    comparison: ComparisonMeta | None
    image: ImageMeta | None = None

    @property
    def cells(self) -> int:
        """Number of cells that have ground."""
        return sum(map(len, self.chunks))

    def sources(self) -> dict[str, str]:
        """Hashes of the terrain models by name; of two with one name the second tells its rank."""
        sources: dict[str, str] = {}
        for dem in self.dems:
            name = dem.name
            if name in sources and isinstance(dem, DemRecord):
                name = f"{name} ({dem.priority})"
            sources[name] = dem.sha256
        if self.image is not None:
            sources[f"{self.image.name} (image)"] = self.image.sha256
        return sources | (self.relief.sources if self.relief is not None else {})


def prepare_inputs(run: IngestRun, bbox: Bbox | None) -> BuildInputs:
    """Read the terrain models and settle what all stages need; cheap where overviews are there.

    Raises DataError, ConfigError or UsageError for what cannot be built from.
    """
    body, config = run.body, run.config
    grid = CellGrid(config.grid.cell_deg)
    terrain: Terrain
    second: Mosaic | None = None
    compared: list[DemRecord] = []
    image: Mosaic | None = None
    image_meta: ImageMeta | None = None
    if config.mesh:
        pyramid, posting = settle_pyramid(run)
        config = msgspec.structs.replace(config, pyramid=pyramid)
        terrain, mesh = ingest_mesh(run, posting)
        _check_cells(run, posting)
        cells = find_covered_cells(terrain, grid, bbox)
        relief: ReliefRecord | None = settle_mesh_relief(run, terrain, mesh)
        records: list[DemRecord | MeshRecord] = [mesh]
        read: list[tuple[object, ...]] = [(mesh.sha256, mesh.folder)]
    else:
        terrain, dems, second, compared = ingest(run)
        shown = ingest_image(run)
        if shown is not None:
            image, record = shown
            error_m = config.image[0].error_m
            image_meta = ImageMeta(record.name, record.sha256, error_m)
        finest_m = (terrain if image is None else image).posting_m
        posting = config.pyramid.posting_m or finest_m
        _check_posting(run, posting, finest_m)
        _check_cells(run, posting)
        cells = find_covered_cells(terrain if image is None else image, grid, bbox)
        relief = settle_relief(run, terrain, dems)
        records = [*dems]
        # paths and ranks do not matter by themselves: what was read, and in which order, does
        read = [(dem.sha256, dem.folder, dem.feather_km) for dem in dems]
        read += [] if shown is None else [(shown[1].sha256, shown[1].folder)]
    first = compute_stage_key(hash_package(), body.name, read, cells.tolist())
    others = [(dem.sha256, dem.folder) for dem in compared]
    keys = _make_stage_keys(first, config, posting, others, body.photometry)
    context = StageContext(body, terrain, grid, posting, config, second, image)
    check_comparison(context, str(run.config_path), cells.tolist())
    errors = _collect_stated_errors(run, terrain.names, records)
    comparison = None
    if second is not None:
        hashes = dict(zip(second.names, (dem.sha256 for dem in compared), strict=True))
        comparison = ComparisonMeta(hashes, config.comparison.max_shift_m)
    chunks = cut_chunks(grid, cells)
    inputs = BuildInputs(context, records, chunks, keys, relief, errors, comparison, image_meta)
    manifest = {
        "software": f"optnav {catalog.__version__}",
        "body": body.name,
        "dems": records,
        "cells": inputs.cells,
        "keys": keys,
        "config": config,
    }
    run.workspace.put(MANIFEST, msgspec.json.format(msgspec.json.encode(manifest), indent=2))
    return inputs


def _make_stage_keys(
    first: str,
    config: BuildConfig,
    posting_m: float,
    compared: list[tuple[str, str]],
    photometry: PhotometricSet,
) -> dict[str, str]:
    """Keys of the stages; each depends on the one before and on the stage's own settings."""
    keys = {"ingest": first}
    parts: dict[str, tuple[Any, ...]] = {
        "render": (config.grid, config.pyramid, posting_m, config.render, photometry),
        "select": (config.select,),
        "check": (config.check, config.comparison, compared),
        "write": (config.write,),
    }
    for stage, settings in parts.items():
        keys[stage] = first = compute_stage_key(first, stage, settings)
    return keys


def _check_posting(run: IngestRun, posting_m: float, finest_m: float) -> None:
    """Refuse patches wider than the body and a posting that shows nothing more."""
    least_m = finest_m / MAX_OVERSAMPLING
    if posting_m < least_m:
        raise ConfigError(
            f"{run.config_path}: [pyramid] posting_m is {posting_m:g}, but the finest terrain "
            f"model has {finest_m:.6g} m; wanted at least {least_m:.6g}, or leave it out"
        )
    reach = posting_m * run.config.pyramid.size * 2 ** (run.config.pyramid.levels - 1)
    if reach > run.body.radius_m:
        raise ConfigError(
            f"{run.config_path}: [pyramid] the coarsest patch would be {reach / 1e3:.0f} km "
            f"wide on a body of {run.body.radius_m / 1e3:.0f} km radius; "
            "wanted fewer levels, a smaller size or a finer posting_m"
        )


def _collect_stated_errors(
    run: IngestRun, names: tuple[str, ...], records: Sequence[DemRecord | MeshRecord]
) -> dict[str, TerrainErrorModel]:
    """The stated errors by names of models, which stand as their records do.

    Raises ConfigError for one larger than the heights themselves.
    """
    ground = [] if run.config.mesh else list_ground_sections(run)
    sections: list[DemSection | MeshSection] = [*ground]
    errors = {}
    for name, section, record in zip(names, sections or run.config.mesh, records, strict=True):
        error = TerrainErrorModel.make(make_stated_error(section), record.posting_m)
        lowest, highest = run.body.plausible_heights_m
        if isinstance(record, DemRecord):
            lowest, highest = record.lowest_m, record.highest_m
        if error is not None and not error.error_m < highest - lowest:
            raise ConfigError(
                f"{run.config_path}: error_m of {section.path} is {error.error_m:g} m, but its "
                f"heights differ by {highest - lowest:.6g} m in all; state the rms error of means "
                "over 2 km, in metres"
            )
        if error is not None:
            errors[name] = error
    return errors


def _check_cells(run: IngestRun, posting_m: float) -> None:
    """Refuse huge cells."""
    across = math.radians(run.config.grid.cell_deg) * run.body.radius_m / posting_m
    if across > MAX_NODES_ACROSS:
        raise ConfigError(
            f"{run.config_path}: a cell of {run.config.grid.cell_deg:g} deg is {across:.0f} "
            f"nodes of {posting_m:g} m wide; wanted at most {MAX_NODES_ACROSS}: set a smaller "
            "[grid] cell_deg or a coarser [pyramid] posting_m"
        )
