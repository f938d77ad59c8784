"""From the label of an archive's picture to a frame: a table of keywords says where things stand.

A table is a TOML file, one a mission's camera (configs/imports). Vectors are put together from
keywords, brought to metres and to the body's axes; attitudes are a quaternion against the stars, or
right ascension and declination of the boresight with the clock angle of north.

Labels of archives are off: on 75 pictures of comet 67P by 0.7 deg against the comet's shape (0.65
deg of it in the body's axes), on Apollo 15 frame 0297 by 0.33 deg and 1.3 km. So a table's sigmas
are those of what a label of its kind is off by, and where it states none, `choose_cube_sigmas` and
`choose_kernel_sigmas` give those of its source.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import msgspec
import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import FloatArray
from catalog.bodies.coverage import Quality
from catalog.bodies.ephemeris import Ephemeris
from catalog.bodies.epochs import utc_from_tdb_s, utc_to_tdb_s
from catalog.bodies.kernels import KernelSet
from catalog.config import load_toml
from catalog.errors import ConfigError, DataError
from catalog.geometry.vectors import unit
from optnav_cli.archives.isis_cube import CubePose, find_middle_utc
from optnav_cli.archives.label import ArchiveLabel, LabelFormat
from optnav_cli.archives.label_geometry import (
    AttitudeKeys,
    TimeKeys,
    VectorKeys,
    check_keys,
    check_label,
    find_axes,
    is_vector_stated,
    read_attitude,
    read_time,
    read_vector,
)
from optnav_cli.frames.frames import Frame

# The Sun and the rotation by a label and by the body file: further apart, one of both is of another
# body, time or frame. Poles of one asteroid by two reports differ by 0.8 deg.
MAX_APART_DEG = 2.0
NO_LIGHT_TIME = (
    "light time and aberration: no kernel joins the body to the solar system's barycentre; "
    "positions are off by speed times light time (add a planetary .bsp, such as de440s.bsp)"
)
Degrees = Annotated[float, msgspec.Meta(gt=0.0, le=180.0)]
Sigma = Annotated[float, msgspec.Meta(gt=0.0, le=1e12)]
Nine = tuple[float, float, float, float, float, float, float, float, float]
NINE_IDENTITY: Nine = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


class Share(NamedTuple):
    """A position's default sigma: a share of the height, and the least of it, m."""

    share: float
    least_m: float

    @property
    def words(self) -> str:
        return f"position {100.0 * self.share:g} % of the height, at least {self.least_m:g} m"

    def sigma_m(self, position_m: FloatArray, radius_m: float) -> float:
        """Sigma of a camera position (3,), m, body frame, above a body of a mean radius."""
        height_m = max(float(np.linalg.norm(position_m)) - radius_m, 0.0)
        return max(self.share * height_m, self.least_m)


class SourceSigmas(NamedTuple):
    """Defaults of one source: its name, the position's, and the attitude's, deg; None: free."""

    source: str
    position: Share
    attitude_deg: float | None

    def words(self, *, attitude: bool, position: bool) -> str:
        """Say which defaults were taken."""
        parts = []
        if attitude and self.attitude_deg is not None:
            parts.append(f"attitude {self.attitude_deg:g} deg")
        if position:
            parts.append(self.position.words)
        return f"1-sigma errors are defaults: {', '.join(parts)} ({self.source})" if parts else ""


LABEL = SourceSigmas("of a label", Share(0.01, 10.0), 0.5)
_CUBE = {"reconstructed": Share(0.005, 10.0), "predicted": Share(0.01, 1000.0)}
_CUBE_DEG = {"reconstructed": 0.1, "predicted": 0.5, "nadir": None}
_ORBIT = {
    "reconstructed": Share(2e-4, 100.0),
    "": Share(1e-3, 200.0),
    "predicted": Share(0.005, 1000.0),
}
_ATTITUDE_DEG = {"reconstructed": 0.05, "": 0.1, "predicted": 0.2}


def choose_cube_sigmas(position: str, pointing: str) -> SourceSigmas:
    """Defaults of an ISIS cube by what spiceinit calls its orbit and pointing."""
    return SourceSigmas(
        f"of a cube whose orbit is {position or 'not said how made'}, whose pointing "
        f"{pointing or 'not either'}",
        _CUBE.get(position, LABEL.position),
        _CUBE_DEG.get(pointing, LABEL.attitude_deg),
    )


def choose_kernel_sigmas(orbit: Quality, attitude: Quality) -> SourceSigmas:
    """Defaults of SPICE kernels by what their names and comments call them."""
    return SourceSigmas(
        f"of an orbit kernel {_describe_quality(orbit)}, "
        f"and attitudes {_describe_quality(attitude)}",
        _ORBIT[orbit],
        _ATTITUDE_DEG[attitude],
    )


def _describe_quality(quality: Quality) -> str:
    return f"called {quality}" if quality else "that says neither reconstructed nor predicted"


class SpiceKeys(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Names of the craft (a NAIF number) and of its camera's frame in SPICE kernels.

    correction  of the body's place and rotation as the craft sees them: light time and stellar
                aberration ("LT+S"), light time alone ("LT"), neither ("NONE")
    """

    craft: int
    frame: str
    correction: Literal["LT+S", "LT", "NONE"] = "LT+S"


class ImportTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A table of keywords.

    format             of the labels; "isis": the tables of a cube; "times": a list of times, whose
                       geometry SPICE kernels have
    match              keywords with what their values begin with: the labels that it is for
    camera, body       a name of those that ship, or a path from the table's folder; may be left out
                       and named on the command line; a body may be the label's target; of several
                       cameras the first is taken whose pictures have the label's size
    target             keyword of the body's name, which must agree with `body`
    picture            name of the picture, "{stem}" being the label's without its ending; else the
                       label's own file has it
    camera_from_frame  rotation, row by row, from the label's frame to the camera's: x right, y
                       down, z along the boresight
    attitude_sigma_deg, position_sigma_m  what labels of this kind are off by, 1 sigma an axis
    attitude_free      the attitude is a first guess only
    unknown            what the labels do not say, a line each
    extension          number or name of the picture in a FITS file; left out: the first
    line_order         which line of a file is the picture's uppermost: the first, the last, or as
                       the label says of its display; left out: the first, with a remark where the
                       label says otherwise; a PNG or JPEG of --picture has its first uppermost
    """

    format: LabelFormat | Literal["isis", "times"]
    match: dict[str, str] = {}
    camera: str | tuple[str, ...] = ""
    body: str = ""
    target: str = ""
    picture: str = ""
    camera_from_frame: Nine = NINE_IDENTITY
    time: TimeKeys = TimeKeys()
    attitude: AttitudeKeys = AttitudeKeys()
    position: VectorKeys | None = None
    sun: VectorKeys | None = None
    spice: SpiceKeys | None = None
    attitude_sigma_deg: Degrees | None = None
    attitude_free: bool = False
    position_sigma_m: Sigma | None = None
    unknown: tuple[str, ...] = ()
    extension: int | str = ""
    line_order: Literal["top_first", "bottom_first", "label"] | None = None

    @property
    def rotation(self) -> Rotation:
        """camera_from_frame."""
        return Rotation.from_matrix(np.reshape(self.camera_from_frame, (3, 3)))


def load_table(path: Path) -> ImportTable:
    """A table of keywords. Raises ConfigError for a wrong file."""
    table = load_toml(path, ImportTable)
    matrix = np.reshape(table.camera_from_frame, (3, 3))
    if not np.abs(matrix @ matrix.T - np.eye(3)).max() < 1e-5 or np.linalg.det(matrix) < 0.0:
        raise ConfigError(f"{path}: camera_from_frame is no rotation; wanted right-handed axes")
    if table.format == "times" and table.spice is None:
        raise ConfigError(f'{path}: format "times" needs [spice] craft and frame')
    if table.format not in ("isis", "times"):
        has_spice = table.spice is not None
        check_keys(path, table.time, table.attitude, table.position, table.sun, has_spice=has_spice)
    if table.time.clock:
        try:
            utc_to_tdb_s(table.time.clock_began_utc, "[time] clock_began_utc")
        except DataError as error:
            raise ConfigError(f"{path}: {error}") from None
    return table


@dataclass(frozen=True)
class FrameMaker:
    """Makes frames by one table; motion says how the body turns, kernels where the craft is."""

    table: ImportTable
    camera: str
    motion: Ephemeris
    kernels: KernelSet | None = None
    notes: dict[str, None] = field(default_factory=dict)  # what people must know, each once

    def make_from_label(self, label: ArchiveLabel, file: str) -> Frame:
        """The frame that a label describes. Raises DataError for what it does not state."""
        table = self.table
        self.notes.update(dict.fromkeys(check_label(label)))
        utc, tdb_s = read_time(label, table.time)
        if table.attitude == AttitudeKeys() and self.kernels is not None:
            return self.make_from_time(label.path, file, utc)
        camera_from_inertial = table.rotation * read_attitude(label, table.attitude)
        body_from_inertial = Rotation.from_matrix(self.motion.body_from_inertial(tdb_s))
        camera_from_body = camera_from_inertial * body_from_inertial.inv()
        body_from = {
            "inertial": body_from_inertial,
            "body": Rotation.identity(),
            "camera": camera_from_body.inv(),
        }
        position, sun = (
            None
            if keys is None or not is_vector_stated(label, keys)
            else body_from[find_axes(label, keys)].apply(read_vector(label, keys, self.motion.body))
            for keys in (table.position, table.sun)
        )
        return self._make_frame(
            label.path, file, (utc, tdb_s), camera_from_body, position, sun, LABEL
        )

    def make_from_cube(
        self, path: Path, pose: CubePose, file: str, camera_from_isis: Rotation | None = None
    ) -> Frame:
        """The frame that the tables of an ISIS cube describe. Raises DataError.

        camera_from_isis  by the cube's own label; None: the table's camera_from_frame
        """
        theory = Rotation.from_matrix(self.motion.body_from_inertial(pose.tdb_s))
        apart = float(np.degrees((theory * pose.body_from_inertial.inv()).magnitude()))
        if apart > MAX_APART_DEG:
            raise DataError(
                f"{path}: its body rotation is {apart:.3g} deg from that of the body "
                f"{self.motion.body.name}; name the body that it shows (--body)"
            )
        attitude = (camera_from_isis or self.table.rotation) * pose.isis_from_body
        time = (find_middle_utc(pose), pose.tdb_s)
        source = choose_cube_sigmas(pose.position_quality, pose.pointing_quality)
        return self._make_frame(path, file, time, attitude, pose.position_m, pose.sun_body, source)

    def make_from_time(self, path: Path, file: str, utc: str) -> Frame:
        """The frame of a time by SPICE kernels. Raises DataError where they do not reach."""
        spice, body, kernels = self.table.spice, self.motion.body, self.kernels
        if spice is None or body.spice is None or kernels is None:
            raise DataError(
                f"{path}: a list of times needs SPICE kernels (--kernel), a table with [spice] and "
                "a body whose file has [spice]"
            )
        tdb_s = utc_to_tdb_s(utc)
        number = next(filter(kernels.has_orbit, body.spice.naif), body.spice.naif[0])
        correction = spice.correction
        if correction != "NONE" and not kernels.has_barycentre_link(number, tdb_s):
            correction = "NONE"
            self.notes[NO_LIGHT_TIME] = None
        seen_m, light_s = kernels.compute_apparent_m(number, spice.craft, tdb_s, correction)
        attitude = Rotation.from_matrix(kernels.rotation(spice.frame, tdb_s))
        # the picture shows the body as it stood when the light left it
        body_from_inertial = Rotation.from_matrix(self.motion.body_from_inertial(tdb_s - light_s))
        position = body_from_inertial.apply(-seen_m)
        attitude = self.table.rotation * attitude * body_from_inertial.inv()
        sun = self.motion.sun_body(tdb_s - light_s)
        source = choose_kernel_sigmas(*kernels.judge_qualities(spice.craft, tdb_s))
        return self._make_frame(path, file, (utc, tdb_s), attitude, position, sun, source)

    def _make_frame(
        self,
        path: Path,
        file: str,
        time: tuple[str, float],
        camera_from_body: Rotation,
        position_m: FloatArray | None,
        sun: FloatArray | None,
        source: SourceSigmas,
    ) -> Frame:
        table, (utc, tdb_s) = self.table, time
        degrees = None if table.attitude_free else table.attitude_sigma_deg or source.attitude_deg
        position_sigma_m = None
        if position_m is not None:
            default_m = source.position.sigma_m(position_m, self.motion.body.radius_m)
            position_sigma_m = table.position_sigma_m or default_m
        self._report_defaults(source, has_position=position_m is not None)
        sun_body = None if sun is None else unit(sun)
        if sun_body is not None:
            self._check_sun(path, tdb_s, sun_body)
        return Frame(
            file=file,
            utc=utc,
            camera=self.camera,
            tdb_s=tdb_s,
            camera_from_body=camera_from_body,
            attitude_sigma_rad=None if degrees is None else float(np.radians(degrees)),
            position_m=position_m,
            position_sigma_m=position_sigma_m,
            sun_body=sun_body,
        )

    def _report_defaults(self, source: SourceSigmas, *, has_position: bool) -> None:
        """Note which sigmas the table leaves to the defaults of the source."""
        table = self.table
        words = source.words(
            attitude=table.attitude_sigma_deg is None and not table.attitude_free,
            position=table.position_sigma_m is None and has_position,
        )
        if words:
            self.notes[words] = None

    def _check_sun(self, path: Path, tdb_s: float, sun_body: FloatArray) -> None:
        """Refuse a Sun that does not stand where the body's own theory has it."""
        try:
            theory = self.motion.sun_body(tdb_s)
        except DataError:  # the body's file says nothing of that time
            return
        apart = float(np.degrees(np.arccos(np.clip(theory @ sun_body, -1.0, 1.0))))
        if apart > MAX_APART_DEG:
            raise DataError(
                f"{path}: the Sun of its label is {apart:.3g} deg from that of the body "
                f"{self.motion.body.name} at {utc_from_tdb_s(tdb_s, 0)}; name the body that it "
                "shows (--body), or correct the table"
            )
