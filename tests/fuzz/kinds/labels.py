"""Labels of archives' pictures and tables of their keywords, damaged."""

from tests.fuzz.cases import DATA, OK, Case, Place, kind
from tests.fuzz.damage import damaged

OPEN = frozenset({OK, DATA})
SIDE_PX = 8
CAMERA = f"""name = "made"
model = "pinhole"
width_px = {SIDE_PX}
height_px = {SIDE_PX}
focal_length_px = 100.0
principal_point_px = [3.5, 3.5]
"""
TABLE = """format = "FORMAT"
match = {NAME = "MOON"}
camera = "made.toml"
body = "moon"
target = "NAME"
position_sigma_m = 500.0
[time]
utc = "TIME"
[attitude]
boresight = ["RA", "DEC", "CLOCK"]
[position]
keys = ["X", "Y", "-Z"]
"""
VALUES = {"NAME": "'MOON'", "TIME": "'2004-05-01T12:00:00'", "RA": "30.0", "DEC": "-4E1", "CLOCK": "7",
          "X": "2000.0", "Y": "1000.5", "Z": "-1500"}  # fmt: skip


def _fits() -> bytes:
    cards = {"SIMPLE": "T", "BITPIX": "8", "NAXIS": "2", "NAXIS1": str(SIDE_PX),
             "NAXIS2": str(SIDE_PX), **VALUES}  # fmt: skip
    lines = [f"{key:8}= {value} / text".ljust(80) for key, value in cards.items()]
    return "".join([*lines, "END"]).encode().ljust(2880) + bytes(range(SIDE_PX**2))


def _pds3() -> bytes:
    lines = ["PDS_VERSION_ID = PDS3", "RECORD_TYPE = FIXED_LENGTH", f"RECORD_BYTES = {SIDE_PX}",
             f"FILE_RECORDS = {SIDE_PX}", '^IMAGE = "a.img"',
             *(f"{key} = {value} <KM>" for key, value in VALUES.items()),
             "OBJECT = IMAGE", f"LINES = {SIDE_PX}", f"LINE_SAMPLES = {SIDE_PX}", "SAMPLE_BITS = 8",
             "SAMPLE_TYPE = UNSIGNED_INTEGER", "END_OBJECT = IMAGE", "END", ""]  # fmt: skip
    return "\r\n".join(lines).encode()


@kind("import-damaged", 1.0)
def damaged_label(place: Place) -> Case:
    """A label, its picture, its table or its camera is damaged."""
    rng, is_fits = place.rng, place.rng.random() < 0.5
    files = {
        "a.lbl": _fits() if is_fits else _pds3(),
        "a.img": bytes(range(SIDE_PX**2)),
        "t.toml": TABLE.replace("FORMAT", "fits" if is_fits else "pds3").encode(),
        "made.toml": CAMERA.encode(),
    }
    name = rng.choice(("a.lbl", "a.lbl", "a.lbl", "t.toml", *files))
    changed, note = damaged(files[name], rng)
    for file, data in {**files, name: changed}.items():
        place.write(file, data)
    args = ("-q", "import", "a.lbl", "--table", "t.toml", "-o", "new")
    return Case(args, OPEN, "new", note=f"{name}: {note}")
