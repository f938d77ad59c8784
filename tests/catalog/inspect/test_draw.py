"""The picture of a control point."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from catalog.control_point import Patch, Pyramid
from catalog.errors import OutputError
from catalog.inspect.draw import GAP_PX, HEAD_PX, LABEL_PX, TILE_PX, draw_pyramid, write_png

RADIUS_M = 1737400.0


def hill(size: int = 64, posting_m: float = 100.0) -> Patch:
    """A round hill, 600 m high, in the middle."""
    offsets = (np.arange(size) - (size - 1) / 2.0) * posting_m
    x, y = np.meshgrid(offsets, offsets)
    return Patch(posting_m, (600.0 * np.exp(-(x**2 + y**2) / 1500.0**2)).astype(np.float32))


def tile(picture: np.ndarray, row: int, column: int) -> np.ndarray:
    top = HEAD_PX + row * (TILE_PX + LABEL_PX)
    left = GAP_PX + column * (TILE_PX + GAP_PX)
    return picture[top : top + TILE_PX, left : left + TILE_PX].astype(np.float64).mean(axis=2)


@pytest.mark.parametrize("row", [0, 1])
def test_light_comes_from_the_north_west_in_both_rows(world: Any, row: int) -> None:
    point = world.points[0][0]
    drawn = tile(draw_pyramid(Pyramid(point, (hill(),)), RADIUS_M), row, 0)
    # slopes 45 degrees up-left and down-right of the middle, 0.7 of the hill's width away
    near = slice(TILE_PX // 2 - 60, TILE_PX // 2 - 20)
    far = slice(TILE_PX // 2 + 20, TILE_PX // 2 + 60)
    assert drawn[near, near].mean() > 1.1 * drawn[far, far].mean()


def test_every_level_is_drawn_and_holes_do_no_harm(world: Any, tmp_path: Path) -> None:
    point, patches = world.points[0]
    empty = Patch(1000.0, np.full((32, 32), np.nan, dtype=np.float32))
    picture = draw_pyramid(Pyramid(point, (*patches, empty)), RADIUS_M)
    assert picture.shape[1] == GAP_PX + 4 * (TILE_PX + GAP_PX)
    write_png(picture, tmp_path / "p.png")
    assert np.array_equal(cv2.imread(str(tmp_path / "p.png")), picture)


def test_a_point_without_patches_is_drawn_as_words(world: Any) -> None:
    point = replace(world.points[0][0], usable=False)
    assert draw_pyramid(Pyramid(point, ()), RADIUS_M)[:HEAD_PX].min() < 100


def test_pictures_go_to_png_files_only(tmp_path: Path) -> None:
    picture = np.zeros((4, 4, 3), dtype=np.uint8)
    with pytest.raises(OutputError, match=r"ends in \.png"):
        write_png(picture, tmp_path / "p.jpg")
    notes = tmp_path / "p.png"
    notes.write_text("not a picture")
    with pytest.raises(OutputError, match="not made by optnav"):
        write_png(picture, notes)
    write_png(picture, tmp_path / "q.png")
    write_png(picture, tmp_path / "q.png")
    cv2.imwrite(str(tmp_path / "holiday.png"), picture)
    with pytest.raises(OutputError, match="not made by optnav"):
        write_png(picture, tmp_path / "holiday.png")
