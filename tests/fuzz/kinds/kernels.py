"""SPICE kernels: binary and text ones, damaged, and lists of them."""

from tests.catalog.bodies.made_kernels import (
    CLOCK,
    FRAMES,
    LEAP_SECONDS,
    TIMES_S,
    attitude_segment,
    daf,
    orbit_segment,
)
from tests.fuzz.cases import DATA, NOTHING, OK, Case, Place, kind
from tests.fuzz.damage import damaged
from tests.fuzz.kinds.labels import CAMERA, SIDE_PX

READ = frozenset({OK, DATA, NOTHING})
BEGAN_S = 820497600.0  # 2026-01-01 to a minute, TDB s
TIMES = """format = "times"
camera = "made.toml"
body = "moon"
[spice]
craft = -999
frame = "MADE_CAMERA"
"""
NAMES = ("moon.tpc", "moon.tf", "moon.bsp", "moon.bpc")


@kind("kernel-damaged", 0.7)
def damaged_kernel(place: Place) -> Case:
    """Navigation by kernels, one of which is damaged."""
    rng = place.rng
    place.take("pictures", "moon.gpkg", *(f"kernels/{name}" for name in NAMES))
    name = rng.choice(NAMES)
    data, note = damaged(place.material(f"kernels/{name}"), rng)
    place.write(f"kernels/{name}", data)
    return _navigate(place, [f"kernels/{name}" for name in NAMES], f"{name}: {note}")


@kind("kernel-text", 0.5)
def text_kernel(place: Place) -> Case:
    """A text kernel with a line of its data changed."""
    rng = place.rng
    place.take("pictures", "moon.gpkg", *(f"kernels/{name}" for name in NAMES))
    name = rng.choice(("moon.tpc", "moon.tf"))
    lines = place.material(f"kernels/{name}").decode().splitlines()
    at = rng.randrange(len(lines))
    key = lines[at].partition("=")[0]
    lines[at] = rng.choice((
        f"{key}= ( 1 2", f"{key}= 'x'", f"{key}= 1e999", f"{key}= ( )", f"{key}= nan", f"{key}=", "\\begintext", "\\begindata", "", "x" * 5000,
        f"{key}= ( {'1 ' * 3000})", f"{key}+= 5", f"{key}= @2000-JAN-01", "KERNELS_TO_LOAD = ( '/etc/passwd' )", "PATH_VALUES = ( '..' )",
    ))  # fmt: skip
    place.write(f"kernels/{name}", "\n".join(lines) + "\n")
    return _navigate(
        place, [f"kernels/{name}" for name in NAMES], f"{name} line {at + 1}: {lines[at][:50]!r}"
    )


@kind("kernel-list", 0.5)
def lists(place: Place) -> Case:
    """Kernels that are not there, twice, of another kind, or under strange names."""
    rng = place.rng
    place.take("pictures", "moon.gpkg", *(f"kernels/{name}" for name in NAMES))
    names = [f"kernels/{name}" for name in rng.sample(NAMES, rng.randrange(len(NAMES) + 1))]
    others = [
        "nothing.bsp",
        "",
        ".",
        "/",
        "kernels",
        "moon.gpkg",
        "/dev/zero",
        "/etc/passwd",
        "shared:x.bsp",
        "a" * 300,
        "é.tpc",
        *names,
    ]
    for _ in range(rng.choice((0, 1, 1, 2))):
        names.insert(rng.randrange(len(names) + 1), rng.choice(others))
    return _navigate(place, names, f"{names}")


@kind("kernel-craft", 1.0)
def craft_kernels(place: Place) -> Case:
    """Import of a list of times by a craft's clock, frames, attitudes and orbit, one damaged."""
    rng = place.rng
    place.take(*(f"kernels/{name}" for name in NAMES))
    type_ = rng.choice((1, 2, 3, 5, 6))
    subtype, order = rng.randrange(4) if type_ > 3 else 1, rng.choice("<>")
    times = (BEGAN_S + TIMES_S).tolist()
    attitude = daf(
        [attitude_segment(type_, subtype, times)], rng.choice((b"DAF/CK  ", b"NAIF/DAF")), order
    )
    files = {
        "made.tls": LEAP_SECONDS.encode(), "made.tsc": CLOCK.encode(), "made.tf": FRAMES.encode(),
        "made.bc": attitude, "made.bsp": daf([orbit_segment(times)], b"DAF/SPK ", order),
        "a.pgm": b"P5 8 8 255\n" + bytes(range(SIDE_PX**2)), "made.toml": CAMERA.encode(),
        "times.csv": b"file,utc\na.pgm,2026-01-01T00:01:40Z\n", "times.toml": TIMES.encode(),
    }  # fmt: skip
    name = rng.choice(("made.bc", "made.bc", "made.tsc", "made.tf", "made.bsp"))
    changed, note = damaged(files[name], rng)
    for file, data in {**files, name: changed}.items():
        place.write(file, data)
    kernels = [f"made.{end}" for end in ("tls", "tsc", "tf", "bc", "bsp")]
    kernels += [f"kernels/{name}" for name in NAMES]
    listed = [part for file in kernels for part in ("--kernel", file)]
    args = ("-q", "import", "times.csv", "--table", "times.toml", *listed, "-o", "new")
    return Case(args, READ, "new", note=f"{type_}.{subtype} {order} {name}: {note}")


def _navigate(place: Place, names: list[str], note: str) -> Case:
    listed = ", ".join(f'"{name}"' for name in names)
    place.write("navigate.toml", f"[spice]\nkernels = [{listed}]\n")
    args = (
        "-q",
        "navigate",
        "pictures",
        "--catalog",
        "moon.gpkg",
        "--config",
        "navigate.toml",
        "-o",
        "new",
    )
    return Case(args, READ, "new", frozenset({OK, NOTHING}), note=note)
