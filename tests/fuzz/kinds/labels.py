"""Labels of archives' pictures and tables of their keywords: damaged, in other units and words."""

from random import Random

from tests.fuzz.cases import DATA, OK, Case, Place, kind
from tests.fuzz.damage import damaged
from tests.optnav_cli.archives.made_cubes import CODE, Cube, write_cube

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


UNITS = dict.fromkeys("XYZ", "KM") | dict.fromkeys(("RA", "DEC", "CLOCK"), "deg")
LENGTHS = ("m", "KM", "Kilometers", "cm", "AU", "METER")
ANGLES = ("deg", "RAD", "degrees", "arcsec", "mrad")
OTHERS = ("s", "km/s", "deg/s", "pixel", "furlong", "kg", "DN", "degC", "m**2")
NEUTRAL = ("", "N/A", "none")
TIMES = ("2004-122T12:00:00", "2004-05-01T12:00:00.25Z", "2004-05-01T24:00:00", "20040501T120000",
         "2004-05-01T12:00")  # fmt: skip
WRONG_TIMES = ("2004-400T12:00:00", "2004-05-01", "2004-05-01T12:00:00-08:00", "12:00:00", "0",
               "2004-05-01T12:00:61", "2004-05-01T12:00:00 TDB")  # fmt: skip


def _fits(units: dict[str, str] = UNITS, values: dict[str, str] = VALUES) -> bytes:
    cards = {"SIMPLE": "T", "BITPIX": "8", "NAXIS": "2", "NAXIS1": str(SIDE_PX),
             "NAXIS2": str(SIDE_PX), **values}  # fmt: skip
    lines = [f"{key:8}= {value} / {_comment(units.get(key, ''))}".ljust(80)
             for key, value in cards.items()]  # fmt: skip
    return "".join([*lines, "END"]).encode().ljust(2880) + bytes(range(SIDE_PX**2))


def _comment(unit: str) -> str:
    return f"[{unit}] text" if unit else "text"


def _pds3(
    units: dict[str, str] = UNITS, values: dict[str, str] = VALUES, rng: Random | None = None
) -> bytes:
    """A label; with a generator, written in one of the ways that the language leaves open."""
    lines = ["PDS_VERSION_ID = PDS3", "RECORD_TYPE = FIXED_LENGTH", f"RECORD_BYTES = {SIDE_PX}",
             f"FILE_RECORDS = {SIDE_PX}", '^IMAGE = "a.img"']  # fmt: skip
    for key, value in values.items():
        unit = f" <{units[key]}>" if units.get(key) else ""
        lines.append(f"{key} = {value.replace(chr(39), chr(34))}{unit}")
    image = ["OBJECT = IMAGE", f"LINES = {SIDE_PX}", f"LINE_SAMPLES = {SIDE_PX}",
             "SAMPLE_BITS = 8", "SAMPLE_TYPE = UNSIGNED_INTEGER", "END_OBJECT = IMAGE"]  # fmt: skip
    if rng is None:
        return "\r\n".join([*lines, *image, "END", ""]).encode()
    extra = [
        'NOTE = "calib/*.img of"', "EMPTY =", "/* X = 5 */", "/* over", "lines */", "SET = {1, 'a b'}",
        "N = ((1 <m>, 2), (3,\n 4)) <km>", "B = -16#FF#", 'L = "one\n two"', "A:B = N/A",
        "GROUP = G\nX = 7 <s>\nEND_GROUP", "OBJECT = T\nX = 9\nX = 8\nEND_OBJECT = T",
    ]  # fmt: skip
    for text in rng.sample(extra, rng.randint(1, 4)):
        if text not in ("/* over", "lines */"):
            lines.insert(rng.randint(1, len(lines)), text)
    head = rng.choice(("", "CCSD3ZF0000100000001NJPL3IF0PDS200000001 = SFDU_LABEL\n", "\n"))
    text = head + "\n".join([*lines, *image, rng.choice(("END", "End")), "no label ("])
    return text.replace("\n", rng.choice(("\n", "\r\n", "  \n"))).encode()


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


def _case(place: Place, label: bytes, *, is_fits: bool, right: int, note: str) -> Case:
    files = {
        "a.lbl": label,
        "a.img": bytes(range(SIDE_PX**2)),
        "t.toml": TABLE.replace("FORMAT", "fits" if is_fits else "pds3").encode(),
        "made.toml": CAMERA.encode(),
    }
    for file, data in files.items():
        place.write(file, data)
    args = ("-q", "import", "a.lbl", "--table", "t.toml", "-o", "new")
    return Case(args, frozenset({right}), "new", note=note)


@kind("import-units", 1.0)
def label_in_units(place: Place) -> Case:
    """A number of a label has another unit: of its quantity it is converted, else refused."""
    rng = place.rng
    key = rng.choice(tuple(UNITS))
    fitting, foreign = (LENGTHS, ANGLES) if key in "XYZ" else (ANGLES, LENGTHS)
    is_right = rng.random() < 0.5
    unit = rng.choice((*fitting, *NEUTRAL) if is_right else (*foreign, *OTHERS))
    # small enough for each unit: angles within a turn, lengths within the solar system
    values = {**VALUES, key: rng.choice(("1.0", "-0.5", "2E0"))}
    is_fits = rng.random() < 0.4
    write = _fits if is_fits else _pds3
    label = write({**UNITS, key: unit}, values)
    note = f"{key} in '{unit}'"
    return _case(place, label, is_fits=is_fits, right=OK if is_right else DATA, note=note)


@kind("import-words", 1.0)
def label_in_words(place: Place) -> Case:
    """A PDS3 label in the ways that its language leaves open, with a right or a wrong time."""
    rng = place.rng
    is_right = rng.random() < 0.7
    time = rng.choice(TIMES if is_right else WRONG_TIMES)
    label = _pds3(UNITS, {**VALUES, "TIME": f"'{time}'"}, rng)
    return _case(place, label, is_fits=False, right=OK if is_right else DATA, note=time)


@kind("import-cube", 1.0)
def damaged_cube(place: Place) -> Case:
    """An ISIS cube whose label, tables or picture are damaged."""
    rng = place.rng
    turns = rng.choice(
        (((1.0, 0.0), (0.0, 1.0)), ((1.0, 0.0), (0.0, -1.0)), ((0.0, 1.0), (1.0, 0.0)))
    )
    lens = rng.choice(({}, {f"INS{CODE}_K1": "-0.002"}, {f"INS{CODE}_OD_K": "(0.0, 0.001, 0.0)"}))
    path = write_cube(place.folder / "a.cub", Cube(turns, naif=lens))
    data = path.read_bytes()
    head, rest = data[:65536].rstrip(b"\0"), data[65536:]
    if rng.random() < 0.7:
        head, note = damaged(head, rng)
    else:
        rest, note = damaged(rest, rng)
    path.write_bytes(head[:65536].ljust(65536, b"\0") + rest)
    return Case(("-q", "import", "a.cub", "-o", "new"), OPEN, "new", note=note)
