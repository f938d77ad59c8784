"""Lines and areas of a sphere on a map that is cut at ±180 degrees."""

import numpy as np
import pytest

from catalog.arrays import BoolArray, FloatArray
from catalog.geometry.latlon import latlon_from_xyz, xyz_from_latlon
from catalog.geometry.map_pieces import clip_ring, split_area, split_line
from catalog.geometry.vectors import perpendicular_basis


def directions(lat_deg: FloatArray, lon_deg: FloatArray) -> FloatArray:
    return xyz_from_latlon(np.radians(lat_deg), np.radians(lon_deg), 1.0)


def cap(lat_deg: float, lon_deg: float, radius_deg: float, points: int = 180) -> FloatArray:
    """A circle on the sphere, counter-clockwise seen from outside."""
    middle = directions(np.array(lat_deg), np.array(lon_deg))
    u, v = perpendicular_basis(middle)
    turn = 2.0 * np.pi * np.arange(points)[:, None] / points
    radius = np.radians(radius_deg)
    ring: FloatArray = np.cos(radius) * middle + np.sin(radius) * (
        np.cos(turn) * u + np.sin(turn) * v
    )
    return ring


def inside(pieces: list[FloatArray], places: FloatArray) -> BoolArray:
    """Which lon, lat (n, 2) lie in one of some rings: by the number of edges to their north."""
    found = np.zeros(len(places), dtype=np.bool_)
    x, y = places[:, :1], places[:, 1:]
    for ring in pieces:
        (x0, y0), (x1, y1) = ring[:-1].T, ring[1:].T
        spans = (x0 <= x) != (x1 <= x)
        with np.errstate(divide="ignore", invalid="ignore"):
            north = y0 + (x - x0) / (x1 - x0) * (y1 - y0) > y
        found |= (spans & north).sum(axis=1) % 2 == 1
    return found


def sphere_area(pieces: list[FloatArray]) -> float:
    """Steradians of areas on the map: the integral of sin(lat) along their edges."""
    total = 0.0
    for ring in pieces:
        lon, lat = np.radians(ring).T
        fine = np.linspace(0.0, 1.0, 21)
        along = lat[:-1, None] + fine * np.diff(lat)[:, None]
        total -= float((np.trapezoid(np.sin(along), fine, axis=1) * np.diff(lon)).sum())
    return total


CAPS = [
    (20.0, 30.0, 15.0), (-10.0, 180.0, 25.0), (85.0, 10.0, 20.0), (-88.0, -170.0, 12.0),
    (60.0, -179.0, 30.0), (0.0, 179.9, 0.05), (90.0, 0.0, 40.0), (0.0, 0.0, 85.0),
]  # fmt: skip


@pytest.mark.parametrize("circle", CAPS)
def test_the_pieces_of_a_cap_hold_what_the_cap_holds(circle: tuple[float, float, float]) -> None:
    lat, lon, radius = circle
    pieces = split_area(cap(*circle))
    for ring in pieces:
        np.testing.assert_array_equal(ring[0], ring[-1])
        assert np.abs(ring[:, 0]).max() <= 180.0 + 1e-9
        assert np.abs(ring[:, 1]).max() <= 90.0
    rng = np.random.default_rng(1)
    near = directions(np.array(lat), np.array(lon)) + rng.normal(size=(4000, 3)) * np.radians(
        radius
    )
    near /= np.linalg.norm(near, axis=1, keepdims=True)
    away = np.arccos(near @ directions(np.array(lat), np.array(lon)))
    # the ring's chords lie inside of its arc by 2e-4 of the radius
    sure = np.abs(away / np.radians(radius) - 1.0) > 2e-3
    lat_rad, lon_rad, _ = latlon_from_xyz(near)
    held = inside(pieces, np.degrees(np.column_stack([lon_rad, lat_rad])))
    np.testing.assert_array_equal(held[sure], away[sure] < np.radians(radius))
    area = 2.0 * np.pi * (1.0 - np.cos(np.radians(radius)))
    assert sphere_area(pieces) == pytest.approx(area, rel=2e-3)


def test_an_area_across_180_degrees_has_two_pieces_and_one_about_a_pole_reaches_it() -> None:
    assert len(split_area(cap(0.0, 180.0, 10.0))) == 2
    (polar,) = split_area(cap(90.0, 0.0, 10.0))
    assert polar[:, 1].max() == 90.0
    assert (polar[:, 0].min(), polar[:, 0].max()) == pytest.approx((-180.0, 180.0))
    assert len(split_area(cap(0.0, 0.0, 10.0))) == 1


def test_a_comb_across_180_degrees_is_cut_into_its_teeth() -> None:
    """Three teeth to the east of the line, joined in the west."""
    teeth = [(170.0, 20.0)]
    for lat in (20.0, 10.0, 0.0):
        teeth += [(175.0, lat), (-170.0, lat), (-170.0, lat - 4.0), (175.0, lat - 4.0)]
    teeth += [(170.0, -4.0)]
    lon, lat = np.array(teeth[::-1]).T
    pieces = split_area(directions(lat, lon))
    east = [ring for ring in pieces if ring[:, 0].max() < 0.0]
    assert (len(pieces), len(east)) == (4, 3)
    assert [ring[:, 0].min() for ring in east] == [-180.0] * 3


def test_a_line_is_cut_at_180_degrees_and_goes_over_the_pole() -> None:
    whole = split_line(directions(np.array([0.0, 10.0]), np.array([0.0, 20.0])))
    assert len(whole) == 1
    np.testing.assert_allclose(whole[0][[0, -1]], [[0.0, 0.0], [20.0, 10.0]], atol=1e-9)
    west, east = split_line(directions(np.array([0.0, 10.0]), np.array([170.0, -170.0])))
    assert (west[-1, 0], east[0, 0]) == (180.0, -180.0)
    assert west[-1, 1] == pytest.approx(east[0, 1])
    over = split_line(directions(np.array([80.0, 80.0]), np.array([30.0, -151.0])))
    lon, lat = np.vstack(over).T
    assert lat.max() > 89.8
    steps = np.diff(directions(lat, lon), axis=0)
    way = np.linalg.norm(steps, axis=1).sum()
    assert way == pytest.approx(np.radians(20.0), rel=1e-3)  # nowhere round the pole


def test_a_ring_is_clipped_to_a_circle_in_several_parts() -> None:
    """A bar across the unit circle, then a U whose ends alone are in it."""

    def depth(ring: FloatArray) -> FloatArray:
        return 1.0 - np.linalg.norm(ring, axis=1)

    def azimuth(points: FloatArray) -> FloatArray:
        return np.arctan2(points[:, 1], points[:, 0])

    def arc(start: float, length: float) -> FloatArray:
        turn = start + length * np.linspace(0.0, 1.0, 200)[1:-1]
        return np.column_stack([np.cos(turn), np.sin(turn)])

    def dense(corners: list[tuple[float, float]]) -> FloatArray:
        ends = [*corners[1:], corners[0]]
        return np.concatenate([np.linspace(a, b, 400)[:-1] for a, b in zip(corners, ends)])

    def area(ring: FloatArray) -> float:
        x, y = ring.T
        return float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2.0

    bar = dense([(-2.0, -0.5), (2.0, -0.5), (2.0, 0.5), (-2.0, 0.5)])
    (part,) = clip_ring(bar, depth(bar), azimuth, arc, 2.0 * np.pi)
    assert area(part) == pytest.approx(2.0 * (0.5 * np.sqrt(0.75) + np.arcsin(0.5)), rel=1e-3)
    ends = [(0.6, 0.5), (2.0, 0.5), (2.0, 2.0), (-2.0, 2.0), (-2.0, 0.5), (-0.6, 0.5)]
    u = dense([*ends, (-0.6, 0.6), (-1.5, 0.6), (-1.5, 1.5), (1.5, 1.5), (1.5, 0.6), (0.6, 0.6)])
    parts = clip_ring(u, depth(u), azimuth, arc, 2.0 * np.pi)
    assert len(parts) == 2
    assert all(area(part) > 0.0 for part in parts)
