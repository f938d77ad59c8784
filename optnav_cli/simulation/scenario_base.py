"""What all kinds of scenario share: their settings, and the pictures of all cameras at all epochs.

A kind of scenario is a file of its own (`passes`, `inertial_path`, `portraits`): its
section, and when and from where it takes pictures.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, Self

import msgspec
import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import Float32Array, FloatArray
from catalog.bodies.ephemeris import Ephemeris
from catalog.bodies.epochs import utc_from_tdb_s
from catalog.errors import ConfigError
from catalog.photometry.sets import PhotometrySettings
from catalog.terrain.dem.source import DemSettings
from catalog.terrain.mesh.file import MeshSettings
from optnav_cli.camera.camera import Camera
from optnav_cli.frames.run_settings import InertialSettings, SpiceSettings
from optnav_cli.simulation import sections

# streams of random numbers, so that a setting more or less does not move the others
CAMERAS = 4  # whose rays a ground keeps: 100 MB each at 2048 pixels a side
PLACE, POINTING, PRIOR, ATTITUDE, ROUGHNESS = range(5)


@dataclass(frozen=True, eq=False)
class Epoch:
    """The ship at a time when its cameras take their pictures.

    number               of the epoch in the scenario
    position_m, forward  (3,) body frame, m; forward is a unit vector level with the ground
    sun_body             (3,) unit vector; reported_sun says whether frames.csv states it
    ground_seed          which added relief, None for none
    """

    number: int
    pass_index: int
    tdb_s: float
    position_m: FloatArray
    forward: FloatArray
    sun_body: FloatArray
    reported_sun: bool
    ground_seed: int | None


@dataclass(frozen=True, eq=False)
class Exposure(Epoch):
    """The truth about one picture, and what frames.csv states of it.

    index             number of the picture; camera: number of the camera in the scenario
    camera_from_body  the truth;  reported_camera_from_body with its error
    prior_m           (3,) body frame, m; no prior is stated where it is None
    """

    camera_from_body: Rotation
    reported_camera_from_body: Rotation
    prior_m: FloatArray | None = None
    index: int = 0
    camera: int = 0
    file: str = ""
    utc: str = ""


class TruthGround(Protocol):
    """The ground that a scenario's pictures show: a region, a whole body or a mesh."""

    def radiance(self, camera: Camera, exposure: Exposure) -> Float32Array:
        """Mean radiance factor over each pixel (height, width), sky 0, of a picture."""
        ...


def corner_rays(camera: Camera) -> FloatArray:
    """Unit rays (height + 1, width + 1, 3), camera frame, through the corners of the pixels."""
    x, y = np.meshgrid(np.arange(camera.width_px + 1), np.arange(camera.height_px + 1))
    return camera.unproject(np.stack([x, y], axis=-1) - 0.5)


def every_px(corners: FloatArray, step: int) -> FloatArray:
    """Every so many of corner rays (height + 1, width + 1, 3) along both sides, and the last."""
    r, c = (np.unique(np.append(np.arange(0, n - 1, step), n - 1)) for n in corners.shape[:2])
    chosen: FloatArray = corners[r][:, c]
    return chosen


@dataclass(frozen=True)
class FileNames:
    """Conversions of the names of a scenario's files, by kind."""

    terrain: Callable[[str], str]
    shape: Callable[[str], str]
    camera: Callable[[str], str]
    body: Callable[[str], str]
    kernel: Callable[[str], str]


class ScenarioBase(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of every scenario file, as written.

    beside  further cameras of the same ship; all take their pictures at the same times
    photometry  which set of Hapke's parameters the ground has; unset: the body's default
    body    a name of configs/bodies, or the path of a body file, from the scenario's folder
    """

    camera: sections.MainCamera
    beside: tuple[sections.MountedCamera, ...] = ()
    dem: tuple[DemSettings, ...] = (DemSettings("tycho_gld100_256ppd.tif"),)
    body: str = "moon"
    seed: sections.Seed = 1
    globe: sections.GlobeSettings = sections.GlobeSettings()
    detail: sections.DetailSettings = sections.DetailSettings()
    # unset, not null, so that the copy of a scenario without it has no such section
    truth: sections.TruthSettings | msgspec.UnsetType = msgspec.UNSET
    pointing: sections.PointingSettings = sections.PointingSettings()
    sensor: sections.SensorSettings = sections.SensorSettings()
    prior: sections.PriorSettings = sections.PriorSettings()
    attitude: sections.AttitudeSettings = sections.AttitudeSettings()
    spice: SpiceSettings = SpiceSettings()
    sky: sections.SkySettings = sections.SkySettings()
    glare: sections.GlareSettings = sections.GlareSettings()
    structure: tuple[sections.StructureSettings, ...] = ()
    # unset, not null, so that the copy of a scenario without it has no such section
    photometry: PhotometrySettings | msgspec.UnsetType = msgspec.UNSET

    @property
    def shape(self) -> MeshSettings | None:
        """The shape model that is flown over; None for the ground of terrain models."""
        return None

    @property
    def track(self) -> InertialSettings | msgspec.UnsetType:
        """[inertial] of run.toml: the pictures are of one inertial track; unset for none."""
        return msgspec.UNSET

    @property
    def is_near_ground(self) -> bool:
        """Whether the ground is drawn as finely as pictures from low heights resolve."""
        return False

    @property
    def world(self) -> sections.TruthSettings:
        """[truth], or its defaults."""
        return self.truth or sections.TruthSettings()

    def epochs(self, motion: Ephemeris) -> list[Epoch]:
        """When and from where pictures are taken. Raises ConfigError for no possible path.

        motion  of the body; passes and portraits need only the body
        """
        raise NotImplementedError

    def shortened(self, frames: int) -> Self:
        """Return the scenario with fewer pictures per camera, for a quick look."""
        raise NotImplementedError

    def check(self) -> None:
        """Raise ConfigError for settings that contradict each other."""
        for dem in self.dem:
            if dem.feather_km:
                raise ConfigError(
                    f"[[dem]] feather_km is {dem.feather_km:g}; wanted 0: "
                    "simulated ground has hard edges, only builds blend"
                )
        self.world.check()
        if self.globe.detail and not self.dem:
            raise ConfigError(
                "[globe] has detail, and there is no [[dem]] that it could lie around; "
                "put the relief of a whole body into [detail]"
            )

    def with_files(self, names: FileNames) -> Self:
        """Return the scenario with other names of its files."""
        dems = (msgspec.structs.replace(dem, path=names.terrain(dem.path)) for dem in self.dem)
        mounts = (
            msgspec.structs.replace(mount, name=names.camera(mount.name)) for mount in self.beside
        )
        truth = self.truth
        if truth and truth.albedo_map:
            path = names.terrain(truth.albedo_map.path)
            map_settings = msgspec.structs.replace(truth.albedo_map, path=path)
            truth = msgspec.structs.replace(truth, albedo_map=map_settings)
        return msgspec.structs.replace(
            self,
            truth=truth,
            dem=tuple(dems),
            globe=msgspec.structs.replace(self.globe, path=names.terrain(self.globe.path)),
            body=names.body(self.body),
            camera=sections.MainCamera(names.camera(self.camera.name)),
            beside=tuple(mounts),
            spice=SpiceSettings(tuple(map(names.kernel, self.spice.kernels))),
        )

    def exposures(self, motion: Ephemeris) -> list[Exposure]:
        """The pictures of all cameras at all epochs, in order of time, those of a pass together.

        Cameras of one epoch share its prior and the error of the ship's attitude.
        Raises ConfigError for a path that cannot be flown.
        """
        epochs = self.epochs(motion)
        mounted = [None, *(_turned(m.forward_deg, m.right_deg, m.roll_deg) for m in self.beside)]
        mounted += [None] * (len(self.mounts()) - len(mounted))
        names = self.camera_names()
        digits = max(4, len(str(len(epochs))))
        taken: list[Exposure] = []
        for epoch in epochs:
            truth = self.ship_attitude(epoch)
            stated, prior = self.stated(epoch, truth)
            for number, own_from_ship in enumerate(mounted):
                which = f"_{names[number]}" if len(mounted) > 1 else ""
                camera_from_body = truth if own_from_ship is None else own_from_ship * truth
                taken.append(
                    Exposure(
                        **vars(epoch),
                        index=len(taken),
                        camera=number,
                        file=f"frame_{epoch.number:0{digits}d}{which}.png",
                        utc=utc_from_tdb_s(epoch.tdb_s, 3),
                        camera_from_body=camera_from_body,
                        reported_camera_from_body=(
                            stated if own_from_ship is None else own_from_ship * stated
                        ),
                        prior_m=prior if self.prior.given else None,
                    )
                )
        return taken

    def ship_attitude(self, epoch: Epoch) -> Rotation:
        """The true attitude of the first camera, camera_from_body."""
        return _ship_attitude(self, epoch)

    def stated(self, epoch: Epoch, truth: Rotation) -> tuple[Rotation, FloatArray]:
        """Attitude of the first camera and position (3,), m, as frames.csv states them."""
        sigma = np.radians(self.attitude.sigma_arcsec / 3600.0)
        slip = np.random.default_rng([self.seed, ATTITUDE, epoch.number]).normal(size=3)
        rng = np.random.default_rng([self.seed, PRIOR, epoch.number])
        prior = epoch.position_m + self.prior.position_sigma_m * rng.normal(size=3)
        if self.prior.along_sigma_m is not msgspec.UNSET:
            prior = prior + self.prior.along_sigma_m * rng.normal() * epoch.forward
        return Rotation.from_rotvec(sigma * slip) * truth, prior

    def mounts(self) -> tuple[sections.MountedCamera, ...]:
        """All cameras, the first one as [pointing] turns the ship."""
        return (sections.MountedCamera(self.camera.name), *self.beside)

    def camera_names(self) -> list[str]:
        """List the names of the cameras' pictures."""
        return [m.name.rpartition("/")[2].removesuffix(".toml") for m in self.mounts()]


class ShapeScenario(ScenarioBase, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A flight over a small body, whose ground is a shape model refined by [detail]."""

    mesh: MeshSettings
    dem: tuple[DemSettings, ...] = ()

    @property
    def shape(self) -> MeshSettings:
        return self.mesh

    def check(self) -> None:
        super().check()
        if self.world != sections.TruthSettings(camera=self.world.camera):
            raise ConfigError(
                "[truth] model_error, albedo and phase_law are for terrain models, and the ground "
                "is a mesh; leave them out"
            )
        if self.dem:
            raise ConfigError("there are [[dem]] and mesh; give one of them")

    def with_files(self, names: FileNames) -> Self:
        mesh = msgspec.structs.replace(self.mesh, path=names.shape(self.mesh.path))
        return msgspec.structs.replace(super().with_files(names), mesh=mesh)


def _ship_attitude(scenario: ScenarioBase, epoch: Epoch) -> Rotation:
    """First camera from body: looking down, the picture's top forward, then turned as set."""
    pointing = scenario.pointing
    position, forward = epoch.position_m, epoch.forward
    down = -position / np.linalg.norm(position)
    # y points down in the picture: backward; x completes the right-handed camera frame
    level = Rotation.from_matrix(np.stack([np.cross(-forward, down), -forward, down]))
    noise = np.random.default_rng([scenario.seed, POINTING, epoch.number]).normal(size=3)
    ahead = pointing.forward_deg + pointing.tilt_sigma_deg * noise[0]
    right = pointing.right_deg + pointing.tilt_sigma_deg * noise[1]
    roll = pointing.roll_deg + pointing.roll_sigma_deg * noise[2]
    return _turned(ahead, right, roll) * level


def _turned(ahead_deg: float, right_deg: float, roll_deg: float) -> Rotation:
    # the boresight turned forward about x, to the right about y, then the camera about it
    return Rotation.from_euler("xyz", [ahead_deg, right_deg, roll_deg], degrees=True).inv()
