"""The write stage: what workers hand in, in whatever order, becomes one catalog."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest

from catalog.config import parse_toml
from catalog.control_point import SHADOW_AZIMUTHS, ControlPoint, Patch
from catalog.errors import ConfigError
from catalog.geometry.cells import CellGrid
from catalog.jobs.usage import StageAccount
from catalog.jobs.workers import SerialWorkers
from catalog.jobs.workspace import ChunkResults, Workspace
from catalog.pipeline.config import WriteSettings
from catalog.pipeline.ingest import cut_chunks
from catalog.pipeline.write import CatalogExtras, group_points, write
from catalog.progress import SilentProgress
from catalog.store.patches import PreparedPoint
from catalog.store.reader import Catalog
from catalog.store.records import round_point

CELLS = range(100, 263)  # of several bands


class PlaneWaveContext:
    """A body whose heights are a plane wave; remembers where patches were asked for."""

    def __init__(self) -> None:
        self.body = SimpleNamespace(name="moon", radius_m=1737400.0, photometry=None)
        self.grid = CellGrid(5.0)
        self.levels, self.size, self.posting_m = 2, 16, 200.0
        self.postings_m = (200.0, 400.0)
        self.config = SimpleNamespace(write=WriteSettings())
        self.mosaic = SimpleNamespace(in_planes=False)  # heights on maps, not a shape model's
        self.asked: list[tuple[float, float]] = []

    def patches(self, lat_deg: float, lon_deg: float) -> tuple[Patch, ...]:
        self.asked.append((lat_deg, lon_deg))
        ramp = np.arange(256, dtype=np.float32).reshape(16, 16)
        return (Patch(200.0, ramp + np.float32(lat_deg)), Patch(400.0, ramp))


def points(grid: CellGrid) -> list[ControlPoint]:
    return [
        ControlPoint(
            cell, grid.centre_deg(cell)[0] + 1e-8, grid.centre_deg(cell)[1], 1737400.0, 0.1, 1.0,
            1.0, 5, (0.5, 0.5), (0.0,) * SHADOW_AZIMUTHS, True, source="dem.tif",
        )
        for cell in CELLS
    ]  # fmt: skip


class BackwardWorkers:
    """Hands the last chunk in first."""

    count = 1

    def run(self, function: Any, context: Any, chunks: Sequence[Any]) -> Iterator[tuple[int, Any]]:
        done = list(SerialWorkers().run(function, context, chunks))
        return iter(done[::-1])


def results_beside(path: Path) -> ChunkResults:
    return ChunkResults(Workspace(path.with_suffix(".work")), "write", "key", PreparedPoint)


def pieces_of(given: Sequence[ControlPoint], grid: CellGrid) -> list[list[ControlPoint]]:
    return group_points(cut_chunks(grid, np.array([point.id for point in given])), given)


def written_with(
    workers: Any, path: Path, given: Sequence[ControlPoint], context: PlaneWaveContext
) -> Any:
    return write(
        context,  # type: ignore[arg-type]
        pieces_of(given, context.grid),
        path,
        extras=CatalogExtras({"dem.tif": "sha256 0"}, "[body]", relief=None),
        results=results_beside(path),
        workers=workers,
        progress=SilentProgress(),
        account=StageAccount("write"),
    )


def test_the_order_of_points_and_chunks_does_not_matter(tmp_path: Path) -> None:
    context = PlaneWaveContext()
    given = points(context.grid)
    pieces = [[point.id for point in chunk] for chunk in pieces_of(given, context.grid)]
    assert any(a[0] < b[0] < a[-1] for a in pieces for b in pieces)  # pieces that interleave
    first = written_with(SerialWorkers(), tmp_path / "a.gpkg", given, context)
    second = written_with(BackwardWorkers(), tmp_path / "b.gpkg", given[::-1], context)
    assert first.digest == second.digest
    with Catalog.open(tmp_path / "b.gpkg") as catalog:
        assert catalog.ids.tolist() == list(CELLS)
        assert catalog.meta.sources == {"dem.tif": "sha256 0"}
        assert catalog.meta.software.startswith("optnav ")


def test_patches_are_cut_about_the_place_that_the_catalog_states(tmp_path: Path) -> None:
    context = PlaneWaveContext()
    given = points(context.grid)
    written_with(SerialWorkers(), tmp_path / "a.gpkg", given, context)
    stated = [(round_point(p).lat_deg, round_point(p).lon_deg) for p in given]
    assert sorted(context.asked) == sorted(stated)
    assert context.asked[0][0] != given[0].lat_deg


def test_heights_are_rounded_by_the_posting_of_their_level_unless_a_step_is_set() -> None:
    postings = (118.5, 237.0, 474.0, 948.0, 1896.0)
    assert WriteSettings().steps_m(postings) == (0.5, 1.0, 2.0, 4.0, 4.0)
    assert WriteSettings(height_step_m=0.25).steps_m(postings) == (0.25,) * 5


@pytest.mark.parametrize("step", ["0.0", "-1.0"])
def test_an_impossible_height_step_is_told(step: str) -> None:
    class Config(msgspec.Struct):
        write: WriteSettings

    with pytest.raises(ConfigError, match="height_step_m"):
        parse_toml(f"[write]\nheight_step_m = {step}\n", Config, "c.toml")
