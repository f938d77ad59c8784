"""The pose in an ISIS cube: position, pointing, body rotation and Sun from its binary tables.

`spiceinit` writes these tables behind the picture (USGS ISIS, SpiceRotation and SpicePosition);
GDAL reads the picture but not them. Conventions, checked on a frame of Apollo 15 in the tests:

InstrumentPosition  camera minus centre of the body, J2000 axes, km
SunPosition         Sun minus centre of the body, J2000 axes, km; light time and aberration applied
InstrumentPointing  quaternion, scalar first, of the rotation taking J2000 vectors to the camera
BodyRotation        the same for the body, followed by the label's ConstantRotation

A table of a framing camera has one record; line scanners, which have many, are refused.

A frame of the Apollo 15 metric camera is the whole frame as a PNG of 1012 x 1012 pixels, whose
columns and rows run as the cube's samples and lines do. The ISIS frame of this camera has its
boresight along -z, x to the picture's left and y downwards: laid over a shaded terrain model in all
eight orientations, the picture correlates by 0.87 in this one and by 0.10 in the next best. The
pose is a first guess, 1.3 km off and tilted by 0.33 degrees to the wrong side of the nadir. With
the tilt held the best position leaves 1.0 px rms, with the tilt mirrored 0.40, with free attitude
0.36 (692 patches of the 474 m model). So the attitude is declared free.
"""

import re
import shutil
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import FloatArray
from catalog.errors import DataError
from optnav_cli.camera.camera_file import preset_camera
from optnav_cli.frames.folder import write_folder
from optnav_cli.frames.frames import Frame
from optnav_cli.frames.run_settings import RunSettings

Value = str | list[str]

_TOKEN = re.compile(r'"([^"]*)"|<[^>]*>|([(),=])|([^\s(),="<]+)')
_TYPES = {"Double": "f8", "Real": "f4", "Integer": "i4"}
CAMERA = "apollo15_metric"
CAMERA_FROM_ISIS = Rotation.from_matrix(np.diag([-1.0, 1.0, -1.0]))
PRIOR_SIGMA_M = 1500.0  # a component; the poses of the mission's support data are off by 1-2 km


@dataclass
class Block:
    """A group or object: its keywords and the blocks within it. Keyword names keep their case."""

    kind: str
    name: str
    keywords: dict[str, Value] = field(default_factory=dict)
    blocks: list["Block"] = field(default_factory=list)

    def find(self, kind: str, **keywords: str) -> "Block | None":
        """The first block below, at any depth, of this kind or name and with these keywords."""
        for block in self.blocks:
            matches = kind in (block.kind, block.name)
            if matches and all(block.keywords.get(key) == keywords[key] for key in keywords):
                return block
            deeper = block.find(kind, **keywords)
            if deeper is not None:
                return deeper
        return None

    def text(self, key: str) -> str:
        """A keyword's value as text. Raises DataError when it is missing or a list."""
        value = self.keywords.get(key)
        if not isinstance(value, str):
            raise DataError(f"label: {self.kind} {self.name} has no single value '{key}'")
        return value

    def number(self, key: str) -> float:
        """A keyword's value as a number. Raises DataError when it is none."""
        try:
            return float(self.text(key))
        except ValueError:
            raise DataError(f"label: {self.kind} {self.name}: '{key}' is no number") from None

    def numbers(self, key: str) -> list[float]:
        """A keyword's list of numbers; empty when the keyword is missing. Raises DataError."""
        value = self.keywords.get(key, [])
        try:
            return [float(item) for item in ([value] if isinstance(value, str) else value)]
        except ValueError:
            raise DataError(
                f"label: {self.kind} {self.name}: '{key}' is no list of numbers"
            ) from None


def parse_label(text: str) -> Block:
    """The label up to its `End`, as an unnamed block. Raises DataError when it does not nest."""
    tokens = _tokens(re.sub(r"-[ \t]*\r?\n\s*", "", text))
    root = Block("Label", "")
    open_blocks = [root]
    position = 0
    while position < len(tokens):
        word = tokens[position]
        if word == "End":
            break
        if word.startswith("End_"):
            if len(open_blocks) == 1:
                raise DataError(f"label: '{word}' ends nothing")
            open_blocks.pop()
            position += 1
            continue
        if tokens[position + 1 : position + 2] != ["="]:
            raise DataError(f"label: '{word}' has no value")
        value, position = _value(tokens, position + 2)
        if word in ("Group", "Object"):
            block = Block(word, str(value))
            open_blocks[-1].blocks.append(block)
            open_blocks.append(block)
        else:
            open_blocks[-1].keywords[word] = value
    if len(open_blocks) > 1:
        raise DataError(f"label: {open_blocks[-1].kind} {open_blocks[-1].name} does not end")
    return root


def _tokens(text: str) -> list[str]:
    tokens = []
    for match in _TOKEN.finditer(text):
        quoted, mark, word = match.groups()
        if quoted is not None:
            tokens.append(" ".join(quoted.split()))
        elif mark or word:
            tokens.append(mark or word)
    return tokens


def _value(tokens: list[str], position: int) -> tuple[Value, int]:
    if position >= len(tokens):
        raise DataError("label: it breaks off")
    if tokens[position] != "(":
        return tokens[position], position + 1
    items: list[str] = []
    for end in range(position + 1, len(tokens)):
        if tokens[end] == ")":
            return items, end + 1
        if tokens[end] != ",":
            items.append(tokens[end])
    raise DataError("label: a list does not end")


@dataclass(frozen=True, eq=False)
class CubePose:
    """What a cube's tables say, in the frames of this project.

    utc                 as the label writes it
    tdb_s               TDB s past J2000, of the tables
    position_m          (3,) camera position, body frame, m
    velocity_m_s        (3,) camera velocity against the stars along the body frame's axes, m/s
    isis_from_body      rotation taking body vectors to the *ISIS* camera frame of the instrument,
                        whose boresight may be -z and whose x need not point right
    sun_body            (3,) unit vector to the Sun, body frame
    body_from_inertial  orientation of the body that the tables use
    """

    utc: str
    tdb_s: float
    position_m: FloatArray
    velocity_m_s: FloatArray
    isis_from_body: Rotation
    sun_body: FloatArray
    body_from_inertial: Rotation


def read_cube_pose(path: str | Path) -> CubePose:
    """The pose in the tables of a cube of a framing camera.

    Raises DataError for a file that is missing or no such cube, or that lacks a table.
    """
    path = Path(path)
    label = read_cube_label(path)
    try:
        body_from_inertial = _rotation(path, label, "BodyRotation")
        isis_from_inertial = _rotation(path, label, "InstrumentPointing")
        position = _vector(path, label, "InstrumentPosition")
        velocity = _vector(path, label, "InstrumentPosition", "V")
        sun = _vector(path, label, "SunPosition")
        instrument = label.find("Instrument")
        utc = instrument.text("StartTime") if instrument else ""
        tdb_s = _record(path, label, "InstrumentPosition")["ET"]
    except DataError as error:
        raise DataError(
            f"{path}: {error}; run spiceinit on the cube and attach its tables"
        ) from None
    return CubePose(
        utc=utc,
        tdb_s=tdb_s,
        position_m=body_from_inertial.apply(position) * 1e3,
        velocity_m_s=body_from_inertial.apply(velocity) * 1e3,
        isis_from_body=isis_from_inertial * body_from_inertial.inv(),
        sun_body=body_from_inertial.apply(sun / np.linalg.norm(sun)),
        body_from_inertial=body_from_inertial,
    )


def read_cube_label(path: str | Path) -> Block:
    """The label at the head of a cube. Raises DataError for a file that is missing or no cube."""
    try:
        with Path(path).open("rb") as file:
            head = file.read(65536)
            if not head.lstrip().startswith(b"Object = IsisCube"):
                raise DataError(
                    f"{path}: not an ISIS cube; wanted a file that begins with its label"
                )
            while b"\nEnd\n" not in head and (more := file.read(65536)):
                head += more
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror}") from None
    try:
        return parse_label(head.split(b"\nEnd\n")[0].decode("latin-1"))
    except DataError as error:
        raise DataError(f"{path}: {error}; the label is damaged") from None


def _record(path: Path, label: Block, name: str) -> dict[str, float]:
    """The one record of a binary table, by field name."""
    table = label.find("Table", Name=name)
    if table is None:
        raise DataError(f"it has no table {name}")
    if table.number("Records") != 1:
        raise DataError(f"its table {name} has {table.text('Records')} records; wanted 1")
    order = ">" if table.text("ByteOrder").lower() == "msb" else "<"
    fields = [block for block in table.blocks if block.name == "Field"]
    kinds = [_TYPES.get(block.text("Type"), "") for block in fields]
    if not all(kinds) or any(block.number("Size") != 1 for block in fields):
        raise DataError(f"its table {name} has a field that is no number")
    layout = np.dtype(
        [(b.text("Name"), order + kind) for b, kind in zip(fields, kinds, strict=True)]
    )
    with path.open("rb") as file:
        file.seek(int(table.number("StartByte")) - 1)
        raw = file.read(layout.itemsize)
    if len(raw) < layout.itemsize or table.number("Bytes") != layout.itemsize:
        raise DataError(f"its table {name} is cut short")
    values = np.frombuffer(raw, layout)[0]
    record = {field: float(values[field]) for field in layout.names or ()}
    if not np.isfinite(list(record.values())).all():
        raise DataError(f"its table {name} holds values that are not finite")
    return record


def _vector(path: Path, label: Block, name: str, suffix: str = "") -> FloatArray:
    record = _record(path, label, name)
    try:
        return np.array([record[f"J2000{axis}{suffix}"] for axis in "XYZ"])
    except KeyError as error:
        raise DataError(f"its table {name} has no field {error}") from None


def _rotation(path: Path, label: Block, name: str) -> Rotation:
    """Rotation from J2000: the table's quaternion, then the constant part of the label."""
    record = _record(path, label, name)
    try:
        quaternion = [record[f"J2000Q{part}"] for part in range(4)]
        rotation = Rotation.from_quat(quaternion, scalar_first=True)
    except KeyError as error:
        raise DataError(f"its table {name} has no field {error}") from None
    except ValueError:
        raise DataError(f"its table {name} holds a quaternion of zero length") from None
    table = label.find("Table", Name=name)
    constant = table.numbers("ConstantRotation") if table else []
    if not constant:
        return rotation
    if len(constant) != 9:
        raise DataError(f"its table {name} has a ConstantRotation of {len(constant)} numbers")
    return Rotation.from_matrix(np.reshape(constant, (3, 3))) * rotation


def apollo_frame(cube: str | Path, file: str) -> Frame:
    """The frame that a cube describes, for a picture called `file`. Raises DataError."""
    pose = read_cube_pose(cube)
    return Frame(
        file=file,
        utc=pose.utc + "Z",
        camera=CAMERA,
        tdb_s=pose.tdb_s,
        camera_from_body=CAMERA_FROM_ISIS * pose.isis_from_body,
        attitude_sigma_rad=None,
        position_m=pose.position_m,
        position_sigma_m=PRIOR_SIGMA_M,
        sun_body=pose.sun_body,
    )


def write_apollo_folder(picture: str | Path, cube: str | Path, folder: str | Path) -> None:
    """Write a picture folder of one metric frame: its PNG, its camera and the cube's pose.

    Raises DataError when the picture or the cube cannot be used.
    """
    picture, folder = Path(picture), Path(folder)
    frame = apollo_frame(cube, picture.name)
    settings = RunSettings(body="moon", attitude="camera_from_body")
    write_folder(folder, settings, [preset_camera(CAMERA)], [frame])
    try:
        shutil.copyfile(picture, folder / picture.name)
    except OSError as error:
        raise DataError(f"{picture}: cannot be copied: {error.strerror}") from None
