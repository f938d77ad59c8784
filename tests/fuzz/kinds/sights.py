"""Picked points, stars, lit cylinders, grids of dots: changed tables, pictures and settings."""

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


@kind("sight-grid", 0.3)
def grid(place: Place) -> Case:
    """A lens by pictures of a grid of dots: one right, one changed or of something else."""
    rng = place.rng
    other = rng.choice(["dots.png", "dots.png", "pictures/frame_0000.png", "moon.toml", "dem.tif"])
    data, note = place.material(other), "as it is"
    if rng.random() < 0.6:
        data, note = damaged(data, rng)
    place.write("other.png", data)
    place.take("dots.png")
    size = rng.choice([(), (), ("--grid", "7x5"), ("--grid", "9x4"), ("--grid", "999x999")])
    told = rng.choice([(), (), ("--distance-mm", "130"), ("--distance-mm", "1e-3")])
    spacing = rng.choice(["12", "12", "1e-3", "1e6"])
    names = rng.choice([("other.png",), ("dots.png", "other.png"), ("other.png", "dots.png")])
    args = ("-q", "calibrate", *names, "--grid-spacing-mm", spacing, *size, *told, "-o", "new")
    return Case(args, OPEN, "new", note=f"{other}: {note}")
