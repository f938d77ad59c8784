"""Rocks by their shadows: drawn ones are found with their sizes, and what hides them is said."""

import math
import sqlite3
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from scipy.special import expit

from catalog.arrays import Float32Array
from catalog.bodies.body import load_body
from catalog.errors import NoSolutionError
from catalog.geometry.projection import Stereographic
from catalog.rendering.map_view import render_map
from optnav_cli.frames.tables import ROCKS
from optnav_cli.hazard.ground_view import PictureOnGround
from optnav_cli.hazard.hazard_map import map_hazard
from optnav_cli.hazard.output import HazardOutput, MappedFrame
from optnav_cli.hazard.pads import add_rocks, choose_pads, rate_slopes
from optnav_cli.hazard.rocks import (
    FEATURES,
    Rock,
    RockSurvey,
    check_scale,
    find_cell,
    find_rocks,
    rate_edges,
    survey_rocks,
)
from optnav_cli.hazard.settings import HazardSettings, RockNumbers, load_hazard_model
from optnav_cli.hazard.shading import map_slopes
from tests.optnav_cli.hazard.views import RADIUS, bumps, drawn, view_of

MODEL = load_hazard_model()
SETTINGS = HazardSettings()
CELL, SIZE = 0.05, 500
# x, y from the middle, half width and height, m: one of each class, and a small one
ROCKS_DRAWN = (
    (-6.0, 5.0, 0.45, 0.45),
    (4.0, -3.0, 0.7, 0.7),
    (5.0, 6.0, 1.0, 1.1),
    (-4.0, -6.0, 0.15, 0.15),
)


def make_heights(crater_m: float = 0.0) -> Float32Array:
    """Level ground, slightly rough, with ROCKS_DRAWN on it, or with one crater and none."""
    axis = (np.arange(SIZE) - 0.5 * (SIZE - 1)) * CELL
    x, y = np.meshgrid(axis, -axis)
    heights = 0.002 * np.random.default_rng(3).standard_normal(x.shape)
    if crater_m:
        r = np.hypot(x, y) / (0.5 * crater_m)
        return (heights + np.where(r < 1.0, 0.25 * crater_m * (r * r - 1.0), 0.0)).astype(
            np.float32
        )
    for left, up, half, tall in ROCKS_DRAWN:
        r = np.hypot(x - left, y - up) / half
        heights += tall * np.sqrt(np.maximum(1.0 - r**3, 0.0))
    return heights.astype(np.float32)


def see(
    heights: Float32Array, elevation_deg: float = 20.0, azimuth_deg: float = 130.0
) -> PictureOnGround:
    e, a = np.radians([elevation_deg, azimuth_deg])
    sun = np.array([np.cos(e) * np.sin(a), np.cos(e) * np.cos(a), np.sin(e)])
    bright = render_map(heights, CELL, sun, radius_m=RADIUS)
    return replace(view_of(bright, elevation_deg, azimuth_deg), cell_m=CELL)


@pytest.mark.parametrize(
    ("sun", "azimuth"), [(20.0, 130.0), (20.0, 301.0), (10.0, 20.0), (30.0, 90.0)]
)
def test_rocks_are_found_where_they_stand_with_their_heights(sun: float, azimuth: float) -> None:
    rocks = find_rocks(see(make_heights(), sun, azimuth), SETTINGS, MODEL)
    assert len(rocks) == 3
    for x, y, half, tall in ROCKS_DRAWN[:3]:
        rock = min(rocks, key=lambda r: math.hypot(r.x_m - x, r.y_m - y))
        assert math.hypot(rock.x_m - x, rock.y_m - y) < half
        assert rock.height_m == pytest.approx(tall, rel=0.15)
        assert abs(rock.height_m - tall) < 3.0 * rock.height_sigma_m
        assert rock.diameter_m == pytest.approx(2.0 * half, rel=0.3)


def test_an_oblique_view_tells_the_same_heights() -> None:
    """From 20 m east of above, tops of rocks are seen west of their feet; so are shadows' edges."""
    view = see(make_heights(), 20.0, 90.0)
    shift = 0.3  # tangent of the view
    slanted = replace(view, camera_m=np.array([-shift * 1e6, 0.0, 1e6]))
    straight, oblique = find_rocks(view, SETTINGS, MODEL), find_rocks(slanted, SETTINGS, MODEL)
    # the same picture seen from the other side of the Sun means lower edges: shadows look longer
    ratio = np.mean([r.height_m for r in oblique[:2]]) / np.mean([r.height_m for r in straight[:2]])
    cotangent = 1.0 / math.tan(math.radians(20.0))
    assert ratio == pytest.approx(cotangent / (cotangent + shift), rel=0.05)


def test_a_crater_is_no_rock() -> None:
    assert not find_rocks(see(make_heights(4.0)), SETTINGS, MODEL)


def test_rocks_on_a_slope_are_as_tall() -> None:
    """Shadows on ground that falls away from the Sun are longer; shading tells the slope."""
    heights = make_heights()
    axis = (np.arange(SIZE) - 0.5 * (SIZE - 1)) * CELL
    tall = []
    for grade in (0.0, 0.08):
        x = np.broadcast_to(axis, heights.shape)
        # half of the ground falls to the west, half to the east: the mean slope stays 0
        tilted = heights + grade * np.abs(x).astype(np.float32) * -1.0
        rocks = find_rocks(see(tilted.astype(np.float32), 20.0, 90.0), SETTINGS, MODEL)
        tall.append([r.height_m for r in sorted(rocks, key=lambda r: r.x_m)])
    assert len(tall[0]) == len(tall[1]) == 3
    assert tall[1] == pytest.approx(tall[0], rel=0.12)


def test_cells_without_a_value_hide_rocks_and_invent_none() -> None:
    view = see(make_heights())
    valid = view.valid.copy()
    first = ROCKS_DRAWN[0]
    row, col = (round(at) for at in find_cell(Rock(*first[:2], 1.0, 1.0, 0.1, 1.0), view))
    valid[row - 30 : row + 30, col - 30 : col + 30] = False
    rocks = find_rocks(replace(view, valid=valid), SETTINGS, MODEL)
    assert len(rocks) == 2
    assert all(math.hypot(r.x_m - first[0], r.y_m - first[1]) > 2.0 for r in rocks)


@pytest.mark.parametrize(
    ("pixel", "sun", "rock", "words"),
    [
        (0.3, 20.0, 0.3, "too coarse for rocks of 0.3 m; wanted up to 0.075 m"),
        (0.05, 59.9, 0.2, "throws a shadow of 2.3 pixels; wanted at least 3"),
    ],
)
def test_pictures_that_cannot_show_rocks_are_refused(
    pixel: float, sun: float, rock: float, words: str
) -> None:
    with pytest.raises(NoSolutionError, match=words):
        check_scale(pixel, sun, rock, MODEL.rocks)


def replace_numbers(**changed: float) -> RockNumbers:
    return msgspec.structs.replace(MODEL.rocks, **changed)


def test_a_survey_says_why_there_are_none() -> None:
    view = view_of(np.ones((64, 64), np.float32))
    coarse = survey_rocks(view, lambda cell: view, SETTINGS, MODEL)
    assert "no rocks looked for: pixels of 1 m are too coarse" in coarse.reason
    off = survey_rocks(view, lambda cell: view, HazardSettings(min_rock_m=0.0), MODEL)
    assert "min_rock_m is 0" in off.reason
    dark = replace(see(make_heights()), brightness=np.zeros((SIZE, SIZE), np.float32))
    assert "holds no light" in survey_rocks(dark, lambda cell: dark, SETTINGS, MODEL).reason


def test_rocks_make_their_pads_worse_and_are_counted() -> None:
    """Of pads alike, the one without rocks is chosen."""
    view = view_of(np.full((100, 100), 0.3, np.float32) + 0.001 * bumps(100))
    risk = rate_slopes(view, map_slopes(view, MODEL), 10.0, MODEL)
    best = choose_pads(view, risk, 100.0)[0]
    assert best.cell is not None
    x, y = (float(at) for at in view.xy_m(*best.cell))
    survey = RockSurvey((Rock(x, y, 0.6, 0.5, 0.05, 0.9), Rock(x + 1.0, y, 0.6, 0.5, 0.05, 0.9)))
    rocky = add_rocks(risk, view, *survey.mark_cells(view))
    at = tuple(round(part) for part in best.cell)
    assert rocky.shares["n_rocks"][at] == 2.0
    # two discs of radius 1.8 m, 1 m apart, on 11 x 11 m
    assert rocky.shares["rock_share"][at] == pytest.approx(0.12, abs=0.04)
    assert rocky.code[at] > risk.code[at]
    other = choose_pads(view, rocky, 100.0)[0]
    assert other.shares["n_rocks"] == 0.0
    assert other.cell != best.cell


def test_rocks_are_written_as_a_table_and_a_layer(tmp_path: Path) -> None:
    """One picture shows its rocks, the other one is too coarse and says so."""
    projection = Stereographic(math.radians(-70.0), math.radians(44.0), 1737400.0)
    fine = replace(see(make_heights()), projection=projection)
    mapped = map_hazard(fine, HazardSettings(pad_m=3.0, square_m=20.0), look=lambda cell: fine)
    coarse = map_hazard(
        replace(drawn(bumps(), 20.0, 90.0), projection=projection),
        HazardSettings(square_m=80.0),
        look=lambda cell: fine,
    )
    body = load_body("moon")
    with HazardOutput(tmp_path, body, SETTINGS, many=True) as out:
        out.add(MappedFrame("a.tif", None, None, None, mapped))
        out.add(MappedFrame("b.tif", None, None, None, coarse))
    *rows, last = ROCKS.rows(tmp_path / "rocks.csv")
    assert [row["file"] for row in rows] == ["a.tif"] * 3
    assert last["reason"].startswith("no rocks looked for: pixels of 1 m are too coarse")
    assert [row.number("height_m") for row in rows] == pytest.approx([1.1, 0.7, 0.45], rel=0.15)
    x, y = ROCKS_DRAWN[2][:2]
    lat, lon = projection.latlon(np.array(x), np.array(y))
    assert rows[0].number("lat_deg") == pytest.approx(math.degrees(float(lat)), abs=3e-5)
    assert rows[0].number("lon_deg") == pytest.approx(math.degrees(float(lon)), abs=9e-5)
    with sqlite3.connect(tmp_path / "rocks.gpkg") as db:
        stored = db.execute("SELECT file, height_m, chance FROM rocks").fetchall()
    assert [(file, round(height, 3)) for file, height, _ in stored] == [
        (row["file"], row.number("height_m")) for row in rows
    ]


def test_weights_between_two_suns_are_mixed() -> None:
    numbers = replace_numbers()
    features = np.zeros((1, FEATURES))
    suns, constants = numbers.sun_elevation_deg, [row[0] for row in numbers.weights]
    sun = 0.5 * (suns[0] + suns[1])
    chance = rate_edges(features, sun, numbers)
    assert chance[0] == pytest.approx(expit(0.5 * (constants[0] + constants[1])))
