"""Pictures of an archive, with the geometry of their labels, to a picture folder."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from catalog.bodies.body import is_body_file, load_body
from catalog.bodies.ephemeris import Ephemeris, load_ephemeris
from catalog.bodies.kernels import KernelSet
from catalog.config import nearest_name, resource
from catalog.errors import ConfigError, DataError, UsageError
from optnav_cli.archives.frame import NINE_IDENTITY, FrameMaker, ImportTable, load_table
from optnav_cli.archives.geometry_check import check_import
from optnav_cli.archives.isis_camera import CubeCamera, crop_camera, read_cube_camera
from optnav_cli.archives.isis_cube import CubePose, read_cube_pose
from optnav_cli.archives.label import ArchiveLabel, read_label
from optnav_cli.archives.label_geometry import VectorKeys, list_unstated_keys
from optnav_cli.archives.pixels import (
    COPIED,
    ImportSource,
    check_row_time,
    is_flipped,
    read_picture_shape,
    read_sources,
    store_picture,
)
from optnav_cli.camera.camera import Camera
from optnav_cli.camera.camera_file import load_camera, preset_camera
from optnav_cli.frames.folder import write_folder
from optnav_cli.frames.frames import Frame
from optnav_cli.frames.run_settings import RunSettings
from optnav_cli.output.manifest import hash_files, output_folder

MIN_CUT = 8  # letters of a target's name that is cut
MIN_WITHIN = 4  # of a name inside a word, as in "433eros": "io" is in "dione"
KIND = "pictures"
TABLES = "configs/imports"
NO_TRANSX = (
    "how the picture lies in its camera's frame: no TRANSX in the label, x is taken to the right, "
    "y downwards, z along the boresight"
)


def find_target_body(target: str, names: Sequence[str]) -> str:
    """The body that a label's target names, or nothing.

    target  lower case: "101955 bennu", "67p/churyumov-gerasimenko", and cut to eight letters by
            some archives, "enceladu"
    """
    words = re.findall(r"[a-z0-9]+", target)
    for name in names:
        if name in words:
            return name
    for name in names:
        if any(len(word) >= MIN_CUT and name.startswith(word) for word in words):
            return name
    within = [name for name in names if name in target and len(name) >= MIN_WITHIN]
    return max(within, key=len, default="")


@dataclass(frozen=True)
class ImportOptions:
    """Options of an import besides its files; None: as the table says.

    table     a name of those that ship or a path; None: the one that matches a label
    camera    a name of those that ship or a path;  body  likewise
    pictures  pictures in place of those of the labels, one a file
    kernels   SPICE kernels: how the body turns; of a list of times where the craft is, too
    """

    table: str | None = None
    camera: str | None = None
    body: str | None = None
    pictures: tuple[Path, ...] = ()
    kernels: tuple[Path, ...] = ()


@dataclass(frozen=True, eq=False)
class Imported:
    """Result of an import: the frames, and remarks for people, one per line."""

    frames: list[Frame]
    remarks: list[str]


def import_folder(
    files: Sequence[Path], output: Path, options: ImportOptions = ImportOptions()
) -> Imported:
    """Make a picture folder of an archive's pictures; a file that cannot be used is left out.

    Raises DataError where none can be used, with the reason of the first, ConfigError for a wrong
    table, camera or body, UsageError for options that do not go together, OutputError.
    """
    if options.pictures and len(options.pictures) != len(files):
        raise UsageError(
            f"{len(options.pictures)} pictures for {len(files)} files; name one --picture a file"
        )
    sources = [*files, *options.pictures, *options.kernels]
    with output_folder(output, KIND, "import", sources, "import") as out:
        importer = _Importer(options, out.path)
        for number, path in enumerate(files):
            named = options.pictures[number] if options.pictures else None
            importer.add(path, named)
        imported = importer.finish(output)
        out.options = {"table": options.table, "camera": options.camera, "body": options.body}
        out.inputs = _hash_inputs(files)
        out.results = {"quaternions": "camera_from_body", "frames": len(imported.frames)}
    return imported


def _hash_inputs(files: Sequence[Path]) -> dict[str, Any]:
    hashes: dict[str, Any] = {}
    for path in files:
        hashes |= hash_files(path.parent, [path.name])
    return hashes


class _Importer:
    """Collects the frames of one folder."""

    def __init__(self, options: ImportOptions, place: Path) -> None:
        self._options, self._place = options, place
        self._tables: dict[Path, ImportTable] = {}
        self._body: tuple[str, Ephemeris] | None = None
        self._kernels = KernelSet(options.kernels) if options.kernels else None
        self._cameras: dict[str, Camera] = {}
        self._frames: dict[str, Frame] = {}
        self._skipped: list[str] = []
        self._doubts: list[str] = []
        self._notes: dict[str, None] = {}  # in order, each once
        self._pixel_notes: list[str] = []

    def add(self, path: Path, own_picture: Path | None) -> None:
        """Add the picture or pictures of a file; what cannot be used is noted."""
        try:
            sources = list(read_sources(path))
        except DataError as error:
            self._skipped.append(str(error))
            return
        for source in sources:
            try:
                self._add(source, own_picture)
            except DataError as error:
                row = f"{path}, {source.file}: " if source.file not in str(error) else ""
                self._skipped.append(f"{row}{error}")

    def _add(self, source: ImportSource, own_picture: Path | None) -> None:
        where, table = self._choose_table(source)
        if source.label is not None and source.kind == "fits" and table.extension != "":
            label = read_label(source.path, "fits", str(table.extension))
            source = replace(source, label=label)
        motion = self._find_motion(source, where, table)
        named = self._options.camera
        pose, shot = _read_cube(source, table)
        picture = own_picture or _locate_picture(source, table)
        if shot is not None and not (named or table.camera):
            camera = shot.camera
        else:
            beside = Path() if named else where.parent
            camera = _choose_camera(named or table.camera, beside, source, picture)
        upside_down = shot is not None and shot.upside_down
        if source.cube is not None and picture == source.path:
            camera = crop_camera(picture, source.cube, camera, upside_down)
        known = self._cameras.setdefault(camera.name, camera)
        if known != camera:  # another part of the same camera's picture
            camera = replace(camera, name=f"{camera.name}_{len(self._cameras)}")
        maker = FrameMaker(table, camera.name, motion, self._kernels)
        flipped, said = is_flipped(source, table, upside_down, own_picture)
        copied = picture.suffix.lower() in COPIED and not flipped
        file = picture.name if copied else f"{picture.stem}.tif"
        if file in self._frames:
            raise DataError(f"{picture}: a picture of this name is there already; rename one")
        if source.label is not None:
            frame = maker.make_from_label(source.label, file)
        elif pose is not None:
            turn = None if shot is None else shot.camera_from_isis
            frame = maker.make_from_cube(source.path, pose, file, turn)
        else:
            check_row_time(source)
            frame = maker.make_from_time(source.path, file, source.utc)
        said += store_picture(source, table, picture, camera, self._place / file, flipped)
        self._pixel_notes += said
        self._cameras[camera.name] = camera
        self._frames[file] = frame
        doubts = check_import(self._place / file, frame, camera, motion)
        self._doubts += [f"{file}: {doubt}" for doubt in doubts]
        self._collect_notes(table, frame, camera, source.label)
        self._notes |= maker.notes
        if shot is not None:
            self._notes |= dict.fromkeys(shot.notes)
        elif pose is not None and table.camera_from_frame == NINE_IDENTITY:
            self._notes[NO_TRANSX] = None

    def _collect_notes(
        self, table: ImportTable, frame: Frame, camera: Camera, label: ArchiveLabel | None
    ) -> None:
        notes = list(table.unknown)
        if frame.attitude_sigma_rad is None:
            notes.append("attitudes are first guesses: they are free (attitude_sigma_arcsec empty)")
        if frame.sun_body is None:
            missing = _list_missing_keys(label, table.sun)
            notes.append(f"no Sun in the labels{missing}: it is computed from the time")
        if frame.position_m is None:
            missing = _list_missing_keys(label, table.position)
            notes.append(f"no position in the labels{missing}: frames are solved without a prior")
        if camera.psf_sigma_px is None:
            notes.append(f"no blur of camera {camera.name} (psf_sigma_px)")
        self._notes |= dict.fromkeys(notes)

    def _choose_table(self, source: ImportSource) -> tuple[Path, ImportTable]:
        """The table for a label, and its file."""
        name = self._options.table
        shipped = sorted(resource(f"{TABLES}/near_msi.toml").parent.glob("*.toml"))
        if name is not None:
            path = Path(name)
            if not is_body_file(name):  # a path has a separator or ends in ".toml"
                known = [each.stem for each in shipped]
                if name not in known:
                    near = nearest_name(name, known)
                    hint = f"did you mean '{near}'?" if near else f"there are {', '.join(known)}"
                    raise ConfigError(f"no import table '{name}' ships with optnav; {hint}")
                path = shipped[known.index(name)]
            return path, self._read_table(path)
        # a mission's table goes before those that any label of a format fits
        for path in sorted(shipped, key=self._rank_table):
            table = self._read_table(path)
            stated = {key: source.text(key).upper() for key in table.match}
            if table.format == source.kind and all(
                text and text.startswith(table.match[key].upper()) for key, text in stated.items()
            ):
                return path, table
        raise DataError(
            f"{source.path}: no import table that ships is for its instrument; write one "
            "(configs/imports has examples) and name it with --table; where a label has no "
            "attitude, write its time to a .csv and name SPICE kernels (--kernel)"
        )

    def _rank_table(self, path: Path) -> tuple[int, str]:
        return -sum(map(bool, self._read_table(path).match.values())), path.name

    def _read_table(self, path: Path) -> ImportTable:
        if path not in self._tables:
            self._tables[path] = load_table(path)
        return self._tables[path]

    def _find_motion(self, source: ImportSource, where: Path, table: ImportTable) -> Ephemeris:
        """Return the rotation model of the folder's body; a label of another body is refused."""
        target = source.text(table.target).lower() if table.target else ""
        shipped = resource("configs/bodies/moon.toml").parent.glob("*.toml")
        of_target = find_target_body(target, [path.stem for path in sorted(shipped)])
        name = self._options.body or table.body or of_target
        if not name:
            raise DataError(f"{source.path}: no body is named; name it with --body")
        if is_body_file(name) and not self._options.body:
            name = str(where.parent / name)
        if self._body is None:
            self._body = name, load_ephemeris(load_body(name), self._options.kernels)
        folder, motion = self._body
        if name != folder or (target and not find_target_body(target, [motion.body.name])):
            shown = target.upper() or name
            raise DataError(
                f"{source.path}: shows {shown} by its label, not {motion.body.name}; import it "
                "into a folder of its own, or name the body (--body) and a table without target"
            )
        return motion

    def finish(self, output: Path) -> Imported:
        """Write the tables of the folder."""
        if not self._frames or self._body is None:
            first = self._skipped[0] if self._skipped else f"{output}: no file was named"
            raise DataError(first)
        used = {frame.camera for frame in self._frames.values()}
        cameras = [camera for name, camera in self._cameras.items() if name in used]
        frames = list(self._frames.values())
        settings = RunSettings(body=self._body[0], attitude="camera_from_body")
        write_folder(self._place, settings, cameras, frames)
        remarks = [f"left out: {reason}" for reason in self._skipped]
        remarks += self._pixel_notes
        remarks += [f"contradiction: {doubt}" for doubt in self._doubts]
        remarks += [f"not known: {note}" for note in self._notes]
        stated = () if self._kernels is None else self._kernels.cameras
        remarks += [f"not used: {line}; cameras/ has the camera's file" for line in stated]
        count = "1 picture" if len(frames) == 1 else f"{len(frames)} pictures"
        return Imported(frames, [f"{output}: {count} of {self._body[1].body.name}", *remarks])


def _list_missing_keys(label: ArchiveLabel | None, keys: VectorKeys | None) -> str:
    """Words for the keywords of a vector that a label leaves out."""
    missing = list_unstated_keys(label, keys) if label is not None and keys is not None else []
    if not missing:
        return ""
    return f" ({', '.join(missing)} {'is' if len(missing) == 1 else 'are'} not stated)"


def _read_cube(
    source: ImportSource, table: ImportTable
) -> tuple[CubePose | None, CubeCamera | None]:
    """Pose and camera of a cube; no camera where the table says how the picture lies."""
    if source.cube is None:
        return None, None
    pose = read_cube_pose(source.path)
    if table.camera_from_frame != NINE_IDENTITY:
        return pose, None
    body_isis = -pose.isis_from_body.apply(pose.position_m)
    return pose, read_cube_camera(source.path, source.cube, body_isis)


def _choose_camera(
    names: str | tuple[str, ...], beside: Path, source: ImportSource, picture: Path
) -> Camera:
    """The camera of a name, or the first of several that takes pictures of this one's size."""
    if not names and source.cube is not None:
        raise DataError(
            f"{source.path}: its label has no NaifKeywords with a focal length, as spiceinit "
            "writes them since 2011; run it anew, or name the camera with --camera"
        )
    if not names:
        raise DataError(f"{source.path}: no camera is known for it; name one with --camera")
    cameras = [
        load_camera(beside / name) if is_body_file(name) else preset_camera(name)
        for name in ((names,) if isinstance(names, str) else names)
    ]
    if len(cameras) == 1:
        return cameras[0]
    try:
        shape = read_picture_shape(source, picture)
    except DataError:  # said where the picture is read
        return cameras[0]
    return next((camera for camera in cameras if camera.shape == shape), cameras[0])


def _locate_picture(source: ImportSource, table: ImportTable) -> Path:
    if source.file:
        return source.path.parent / source.file
    if table.picture:
        return source.path.parent / table.picture.replace("{stem}", source.path.stem)
    return source.path
