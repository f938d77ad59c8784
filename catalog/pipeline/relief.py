"""Relief: the coarse ground of the whole body, which the catalog carries for the horizon.

It is made of the build's own terrain models by their priority, and of the one that [relief] names
below them. A build of a part of the body without such a one carries no relief.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import msgspec
import numpy as np

from catalog.errors import DataError
from catalog.jobs.workspace import (
    Workspace,
    compute_stage_key,
    encode_records,
    hash_contents,
    hash_package,
)
from catalog.pipeline.context import DemRecord, IngestRun
from catalog.store.relief import PreparedRelief, prepare_relief
from catalog.terrain.dem.mosaic import Mosaic
from catalog.terrain.dem.source import DemSource
from catalog.terrain.pyramid.overviews import BLOCK
from catalog.terrain.pyramid.pyramid import HeightPyramid
from catalog.terrain.relief.sums import (
    MIN_COVERAGE,
    CellSums,
    Layer,
    add_dem,
    check_share,
    count_rows,
    finish_relief,
    measure_share_within_bounds,
)

# Tops are those of area means, so many across a cell: of a raster at 118 m they are read from its
# overview at 474 m, which is a sixteenth of the work.
SAMPLES_ACROSS = 4


class ReliefRecord(NamedTuple):
    """The relief of a build, ready in its work folder.

    key      hash of all that it depends on
    sources  terrain models that only it is made of: name -> hash
    """

    key: str
    sources: dict[str, str]


def settle_relief(run: IngestRun, mosaic: Mosaic, dems: list[DemRecord]) -> ReliefRecord | None:
    """Make the relief, or keep that of an earlier run; None for a build without one.

    Raises DataError when the named terrain model cannot be used or the whole is not the body's.
    """
    workspace, wanted = run.workspace, run.config.relief.dem
    shares = [measure_share_within_bounds(p.source) * p.record.valid_share for p in mosaic.pyramids]
    if wanted is None and sum(shares) < MIN_COVERAGE:
        workspace.keep_only("relief", set())
        return None
    named, sources = None, {}
    parts: list[object] = [(dem.sha256, dem.folder) for dem in dems]
    if wanted is not None:
        try:
            named = DemSource.open(wanted, run.folder, mosaic.body, "[relief] dem")
            check_share(sum(shares) + measure_share_within_bounds(named), named.path, mosaic.body)
        except DataError as error:
            raise DataError(f"{run.config_path}: [relief] dem: {error}") from None
        digest = hash_contents(named.files, workspace, run.progress)
        sources = {f"{named.path.name} (relief)": digest}
        parts += [digest, msgspec.structs.replace(wanted, path="")]
    key = compute_stage_key(hash_package(), mosaic.body.name, parts)
    make_or_keep(run, key, lambda: _make_relief(run, mosaic, shares, named))
    if named is not None:
        named.close()
    return ReliefRecord(key, sources)


def make_or_keep(run: IngestRun, key: str, make: Callable[[], PreparedRelief | None]) -> None:
    """Leave the relief of a key in the work folder, made now unless it is there, and no other."""
    workspace = run.workspace
    if workspace.is_intact(_format_path(key)):
        run.account.kept += 1
    else:
        made = make()
        workspace.put(_format_path(key), encode_records([made] if made is not None else []))
        run.account.done += 1
    workspace.keep_only("relief", {key})


def read_stored_relief(workspace: Workspace, record: ReliefRecord) -> PreparedRelief | None:
    """The relief that `settle_relief` left; None where the models do not show the whole body.

    Raises DataError for a work folder whose medium fails.
    """
    records = workspace.read_records(_format_path(record.key), PreparedRelief)
    if records is None:
        raise DataError(
            f"{workspace.path(_format_path(record.key))}: changed after it was written; its medium "
            "may be failing: give the same command again"
        )
    return records[0] if records else None


def _make_relief(
    run: IngestRun, mosaic: Mosaic, shares: list[float], named: DemSource | None
) -> PreparedRelief | None:
    body, sums = mosaic.body, CellSums(_choose_rows(mosaic, shares, named))
    cell_m = np.pi * body.radius_m / len(sums.means)
    names, covered = [], 0.0
    for pyramid, name in zip(mosaic.pyramids, mosaic.names):
        sums.fill_from(_make_layer(pyramid, cell_m / SAMPLES_ACROSS), run.progress)
        if sums.coverage > covered:
            names.append(name)
        covered = sums.coverage
    if named is not None:
        try:
            add_dem(sums, named, run.progress)
            check_share(sums.coverage, f"with {named.path}", body)
        except DataError as error:
            raise DataError(f"{run.config_path}: [relief] dem: {error}") from None
        if sums.coverage > covered:
            names.append(named.path.name)
    elif sums.coverage < MIN_COVERAGE:
        return None
    return prepare_relief(finish_relief(sums, body.radius_m, " + ".join(names)))


def _choose_rows(mosaic: Mosaic, shares: list[float], named: DemSource | None) -> int:
    """Rows of the relief: half of the body's ground is shown by models as fine, or finer."""
    steps = [pyramid.source.georeference.row_angle for pyramid in mosaic.pyramids]
    if named is not None:
        steps.append(named.georeference.row_angle)
        shares = [*shares, max(0.0, 1.0 - sum(shares))]
    order = np.argsort(steps, kind="stable")
    shown = np.cumsum(np.array(shares)[order])
    return count_rows(steps[order[int(np.searchsorted(shown, shown[-1] / 2.0))]])


def _make_layer(pyramid: HeightPyramid, posting_m: float) -> Layer:
    """A model at the overview that has this posting, or at its own where none is as fine."""
    level = pyramid.choose_level(posting_m)
    is_untiled = level == 0 and not pyramid.record.tiled_copy
    block = pyramid.source.block_shape if is_untiled else (BLOCK, BLOCK)
    read = partial(pyramid.read, level)
    return Layer(pyramid.source.georeference, level, pyramid.shape(level), block, read)


def _format_path(key: str) -> str:
    return f"relief-{key}/records.bin"
