"""Picked points, stars and lit cylinders: changed tables, pictures and settings."""

from tests.fuzz.cases import NOTHING, OK, OPEN, Case, Place, kind
from tests.fuzz.damage import damaged
from tests.fuzz.kinds.tables import changed

WRITTEN = frozenset({OK, NOTHING})


def _with_change(place: Place, folder: str, tables: tuple[str, ...], pictures: str) -> str:
    """A folder, one of whose tables, cameras, settings or pictures is changed."""
    place.take(folder)
    root = place.materials / folder
    names = [f"{folder}/{name}" for name in (*tables, *tables, "run.toml")]
    for pattern in ("cameras/*.toml", pictures):
        names += [p.relative_to(place.materials).as_posix() for p in sorted(root.glob(pattern))[:2]]
    name = place.rng.choice(names)
    change = changed if name.endswith(".csv") else damaged
    data, note = change(place.material(name), place.rng)
    place.write(name, data)
    return f"{name}: {note}"


@kind("sight-points", 1.0)
def points(place: Place) -> Case:
    """Navigation by changed points that a person picked."""
    note = _with_change(place, "picked", ("points.csv", "points.csv", "frames.csv"), "*.none")
    return Case(("-q", "navigate", "picked", "-o", "new"), OPEN, "new", WRITTEN, note=note)


@kind("sight-stars", 0.5)
def stars(place: Place) -> Case:
    """Attitudes from the stars of a changed folder, whose pictures show few of them or none."""
    note = _with_change(place, "pictures", ("frames.csv",), "*.png")
    return Case(("-q", "stars", "pictures", "-o", "new"), OPEN, "new", WRITTEN, note=note)


@kind("sight-cylinder", 0.7)
def cylinder(place: Place) -> Case:
    """Distances by changed pictures of a cylinder."""
    note = _with_change(place, "lamp", ("frames.csv",), "*.png")
    return Case(("-q", "cylinder", "lamp", "-o", "new"), OPEN, "new", WRITTEN, note=note)
