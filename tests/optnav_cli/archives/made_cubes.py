"""ISIS cubes made from nothing: a label, tables as spiceinit attaches them, and a picture.

The Moon is seen from 5000 km. Each pixel's value is its number, so that a test finds it again
wherever an import puts it.
"""

import struct
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from catalog.bodies.body import load_body
from catalog.bodies.ephemeris import AnalyticEphemeris
from catalog.bodies.epochs import utc_to_tdb_s

UTC = "2009-01-20T12:00:00.000"
COLUMNS, ROWS = 8, 6
CAMERA_BODY_KM = np.array([3000.0, -3500.0, 1500.0])
FOCAL_MM, PITCH_MM = 50.0, 0.5
CODE = -99900
Record = dict[str, float]


@dataclass(frozen=True)
class Cube:
    """What a made cube states.

    by_pixel   TRANSX and TRANSY by sample and line, pixels
    backwards  the camera looks along -z of its ISIS frame
    """

    by_pixel: tuple[tuple[float, float], tuple[float, float]] = ((1.0, 0.0), (0.0, 1.0))
    backwards: bool = False
    naif: dict[str, str] = field(default_factory=dict)
    instrument: dict[str, str] = field(default_factory=dict)
    kernels: dict[str, str] = field(default_factory=dict)
    alpha: dict[str, float] | None = None
    groups: str = ""
    tables: dict[str, list[Record]] = field(default_factory=dict)
    table_words: dict[str, str] = field(default_factory=dict)
    constant: bool = False
    body_km: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def but(self, **changes: object) -> "Cube":
        return replace(self, **changes)  # type: ignore[arg-type]


def body_from_inertial() -> Rotation:
    moon = AnalyticEphemeris(load_body("moon"))
    return Rotation.from_matrix(moon.body_from_inertial(utc_to_tdb_s(UTC)))


def isis_from_body(backwards: bool = False) -> Rotation:
    """An ISIS frame that looks at the Moon's centre, a few degrees beside it, along z or -z."""
    down = -CAMERA_BODY_KM / np.linalg.norm(CAMERA_BODY_KM)
    across = np.cross(down, [0.1, 0.2, 0.97])
    across /= np.linalg.norm(across)
    ahead = Rotation.from_matrix([across, np.cross(down, across), down])
    beside = Rotation.from_euler("xy", [3.0, -2.0], degrees=True)
    turned = Rotation.from_euler("x", 180.0 if backwards else 0.0, degrees=True)
    return turned * beside * ahead


CONSTANT = Rotation.from_euler("xyz", [10.0, 20.0, 30.0], degrees=True)


def standard_tables(cube: Cube) -> dict[str, list[Record]]:
    """Tables of one record each, as spiceinit makes them."""
    turn, tdb_s = body_from_inertial(), utc_to_tdb_s(UTC)
    sun = AnalyticEphemeris(load_body("moon")).sun_inertial(tdb_s) * 1.5e8
    attitude = isis_from_body(cube.backwards) * turn
    if cube.constant:
        attitude = CONSTANT.inv() * attitude
    return {
        "InstrumentPointing": [_rotation(attitude, tdb_s)],
        "InstrumentPosition": [_state(turn.inv().apply(CAMERA_BODY_KM), tdb_s)],
        "BodyRotation": [_rotation(turn, tdb_s)],
        "SunPosition": [_state(sun, tdb_s)],
    }


def _rotation(rotation: Rotation, tdb_s: float) -> Record:
    quaternion = rotation.as_quat(scalar_first=True)
    return {**{f"J2000Q{n}": float(quaternion[n]) for n in range(4)},
            **dict.fromkeys(("AV1", "AV2", "AV3"), 0.0), "ET": tdb_s}  # fmt: skip


def _state(position_km: np.ndarray, tdb_s: float) -> Record:
    return {**{f"J2000{a}": float(position_km[n]) for n, a in enumerate("XYZ")},
            **{f"J2000{a}V": 0.0 for a in "XYZ"}, "ET": tdb_s}  # fmt: skip


def pixel_rays_isis(cube: Cube, columns: int = COLUMNS, rows: int = ROWS) -> np.ndarray:
    """Directions (rows, columns, 3) of the file's pixels, ISIS frame, by ISIS's own equations."""
    sample, line = np.meshgrid(np.arange(columns) + 1.0, np.arange(rows) + 1.0)
    away = np.stack([sample - (columns + 1) / 2, line - (rows + 1) / 2], axis=-1)
    x, y = np.moveaxis(away @ (PITCH_MM * np.array(cube.by_pixel)).T, -1, 0)
    return np.stack([x, y, np.full_like(x, -FOCAL_MM if cube.backwards else FOCAL_MM)], axis=-1)


def write_cube(path: Path, cube: Cube = Cube(), columns: int = COLUMNS, rows: int = ROWS) -> Path:
    """Write a cube whose pixels have their numbers as values."""
    (xs, xl), (ys, yl) = (PITCH_MM * np.array(cube.by_pixel)).tolist()
    naif = {
        f"INS{CODE}_FOCAL_LENGTH": f"{FOCAL_MM}",
        f"INS{CODE}_PIXEL_PITCH": f"{PITCH_MM}",
        f"INS{CODE}_TRANSX": f"(0.0, {xs!r}, {xl!r})",
        f"INS{CODE}_TRANSY": f"(0.0, {ys!r}, {yl!r})",
        f"INS{CODE}_BORESIGHT_SAMPLE": f"{(COLUMNS + 1) / 2}",
        f"INS{CODE}_BORESIGHT_LINE": f"{(ROWS + 1) / 2}",
    } | cube.naif
    instrument = {"SpacecraftName": "MADE", "InstrumentId": "MADECAM", "TargetName": "MOON",
                  "StartTime": UTC, **cube.instrument}  # fmt: skip
    kernels = {"NaifFrameCode": str(CODE), **cube.kernels}
    # 0 to 2 are special pixels
    pixels = np.arange(3, 3 + rows * columns, dtype="<u2").tobytes()
    start, data, blocks = 65537 + len(pixels), b"", ""
    for name, records in (standard_tables(cube) | cube.tables).items():
        raw = b"".join(struct.pack(f"<{len(record)}d", *record.values()) for record in records)
        words = cube.table_words.get(name, "")
        if cube.constant and name == "InstrumentPointing":
            values = ", ".join(repr(float(v)) for v in CONSTANT.as_matrix().ravel())
            words += f"  ConstantRotation = ({values})\n"
        fields = "".join(
            f"  Group = Field\n    Name = {key}\n    Type = Double\n    Size = 1\n  End_Group\n"
            for key in records[0]
        )
        blocks += (
            f"Object = Table\n  Name = {name}\n  StartByte = {start + len(data)}\n"
            f"  Bytes = {len(raw)}\n  Records = {len(records)}\n  ByteOrder = Lsb\n{words}{fields}"
            "End_Object\n"
        )
        data += raw
    label = (
        "Object = IsisCube\n  Object = Core\n    StartByte = 65537\n    Format = BandSequential\n"
        f"    Group = Dimensions\n      Samples = {columns}\n      Lines = {rows}\n"
        "      Bands = 1\n    End_Group\n    Group = Pixels\n      Type = UnsignedWord\n"
        "      ByteOrder = Lsb\n      Base = 0.0\n      Multiplier = 1.0\n    End_Group\n"
        f"  End_Object\n{_group('Instrument', instrument)}{_group('Kernels', kernels)}"
        f"{'' if cube.alpha is None else _group('AlphaCube', cube.alpha)}{cube.groups}"
        f"End_Object\nObject = Label\n  Bytes = 65536\nEnd_Object\n{blocks}"
        f"Object = NaifKeywords\n{_lines(naif)}End_Object\nEnd\n"
    )
    path.write_bytes(label.encode().ljust(65536, b"\0") + pixels + data)
    return path


def _group(name: str, words: dict[str, object]) -> str:  # type: ignore[type-arg]
    return f"  Group = {name}\n{_lines(words)}  End_Group\n"


def _lines(words: dict[str, object]) -> str:  # type: ignore[type-arg]
    return "".join(f"    {key} = {value}\n" for key, value in words.items() if value != "")
