"""SPICE kernels: binary and text ones, damaged, and lists of them."""

from tests.fuzz.cases import DATA, NOTHING, OK, Case, Place, kind
from tests.fuzz.damage import damaged

READ = frozenset({OK, DATA, NOTHING})
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
