"""Small discs: how good directions and ranges are, and whether they are as good as they say.

Discs of the Moon and of Phobos, 2.2 to 40 pixels across, each over its own ground, from its own
side, at its own phase (0-120 deg), blur (0.5-1.2 px), noise (SNR 20-100) and depth of counts (8 or
12 bits), by the shipped cameras. Each is solved as `optnav navigate` solves a lone frame with an
exact attitude, once with its blur calibrated to 0.05 px and once without: then it is blurred by a
gaussian of 0.3-1.0 px, by a defocused lens of the same widths, or by a lens so sharp that hardly
more than the pixels blur. No size of the error model was set by these discs.

The light is blurred before it falls on the pixels, on a grid of finer pixels, so that a blur is the
one that a camera file states; pictures of the simulator are blurred pixel by pixel.
"""

import json
import tempfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import Float32Array, FloatArray
from catalog.bodies.body import Body, load_body
from catalog.config import resource
from catalog.errors import NoSolutionError
from catalog.files import check_file, make_prefix_test, write_output
from catalog.progress import Progress
from catalog.terrain.dem.source import DemSettings
from catalog.terrain.mesh.file import MeshSettings
from catalog.terrain.mesh.shape import load_shape
from catalog.terrain.mesh.terrain import MeshTerrain, make_mesh_relief
from catalog.terrain.relief.relief import GlobalRelief
from optnav_cli.camera.camera import Camera
from optnav_cli.camera.camera_file import preset_camera
from optnav_cli.frames.picture import Picture
from optnav_cli.outline import method as outline
from optnav_cli.simulation.globe_ground import GlobeGround
from optnav_cli.simulation.scenario import load_scenario
from optnav_cli.simulation.scenario_base import Epoch, Exposure, TruthGround
from optnav_cli.simulation.sections import DetailSettings, SensorSettings
from optnav_cli.simulation.sensor import expose
from optnav_cli.simulation.surroundings import MeshGround
from tests.studies.tables import Cell, StudyReport, StudyTable, columns, rms, tally

Shape = Literal["moon", "phobos"]

GLOBE, GLOBE_ROWS = "data/moon_gld100_4ppd.tif", 720
PHOBOS = "configs/scenarios/phobos_disc.toml"
CAMERAS: dict[Shape, tuple[str, ...]] = {"moon": ("shnk", "unk"), "phobos": ("tsnn_shtk",)}
GROUNDS = (7301, 7302, 7303)  # seeds of relief that no other study and no scenario has
FINE = 5  # pixels a side that are drawn for one
SIDES_PX = (64, 128)  # of the part of a picture that is drawn; the larger one for discs over
SMALL_PX = 16.0
OFF_AXIS = 0.35  # the part's middle lies up to here from the picture's, in sides of the picture
PHASE_DEG = (0.0, 120.0)
PSF_PX = (0.5, 1.2)
PSF_ERROR_PX = 0.05  # of the calibration
# Of blurs that are not stated: sigma of the light on the pixels.
OTHER_PSF_PX, SHARP_PX = (0.3, 1.0), 0.15
KNOWN = "known"
BLURS = ("gaussian", "defocus", "sharp")  # not stated
SNR = (20.0, 100.0)
BITS = (8, 12)
FULL = {8: 255.0, 12: 65535.0}  # where their files saturate
SEED = 77031
SHAPES: tuple[Shape, ...] = ("moon", "phobos")
EDGES_PX = (2.2, 3.0, 4.0, 6.0, 10.0, 16.0, 25.0, 40.0)  # of the bins of diameter
NEES = (0.7, 1.4)


@dataclass(frozen=True, eq=False)
class DrawnDisc:
    """A drawn disc with its truth.

    camera            of the part that is drawn, with its blur as calibrated
    position_m        (3,) body frame;  sun_body (3,) unit vector
    diameter_px       of the body's mean sphere
    radiance          on pixels FINE times finer, before any blur
    """

    picture: Picture
    camera: Camera
    position_m: FloatArray
    camera_from_body: Rotation
    sun_body: FloatArray
    diameter_px: float
    phase_deg: float
    radiance: Float32Array

    def blurred_anew(self, blur: str, rng: np.random.Generator) -> "DrawnDisc":
        """The same disc behind another of BLURS, which the camera does not state."""
        sigma = SHARP_PX if blur == "sharp" else rng.uniform(*OTHER_PSF_PX)
        camera = replace(self.camera, psf_sigma_px=None, psf_error_px=None)
        return replace(self, picture=_exposed(self.radiance, blur, sigma, rng), camera=camera)


def _exposed(
    radiance: Float32Array, blur: str, sigma_px: float, rng: np.random.Generator
) -> Picture:
    """A picture of light that a lens blurs before it falls on the pixels."""
    sigma = sigma_px * FINE
    if blur == "defocus":  # a disc: its second moments are those of half its radius
        reach = int(2.0 * sigma) + 2
        y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
        disc = np.clip(2.0 * sigma + 0.5 - np.hypot(x, y), 0.0, 1.0)
        blurred = cv2.filter2D(radiance, -1, disc / disc.sum(), borderType=cv2.BORDER_REPLICATE)
        # of the Fourier transform by which it is done
        blurred[blurred < 1e-5 * blurred.max()] = 0.0
    else:
        blurred = cv2.GaussianBlur(radiance, (0, 0), sigma)
    size = (radiance.shape[1] // FINE, radiance.shape[0] // FINE)
    light = cv2.resize(blurred, size, interpolation=cv2.INTER_AREA)
    bits = int(rng.choice(BITS))
    sensor = SensorSettings(psf_sigma_px=0.0, snr=float(rng.uniform(*SNR)), bits=bits)
    counts = expose(light.astype(np.float32), sensor, rng).astype(np.float32)
    return Picture(counts, FULL[bits])


class DiscScene:
    """Discs of one body; `relief` is what a navigator knows of its shape, None of a sphere."""

    def __init__(self, shape: Shape) -> None:
        self._shape: Shape = shape
        self.body = load_body(shape)
        self.relief: GlobalRelief | None = None
        self._ground: TruthGround
        if shape == "phobos":
            scenario = load_scenario(resource(PHOBOS))
            if scenario.shape is None:
                raise TypeError(f"{PHOBOS} is no scenario of a small body")
            self._ground = MeshGround(scenario.shape, scenario.detail, self.body)
            self.relief = _relief(scenario.shape, self.body)
        else:
            model = DemSettings(str(resource(GLOBE)))
            finest = np.pi * self.body.radius_m / GLOBE_ROWS / 2.0
            detail = DetailSettings(GROUNDS, smallest_m=finest, rms_slope_deg=5.0)
            self._ground = GlobeGround.of_model(model, detail, self.body, kept=1)

    def draw(self, diameter_px: float, ground: int, rng: np.random.Generator) -> DrawnDisc:
        """A disc of this size over one of GROUNDS, all else drawn at random."""
        psf = rng.uniform(*PSF_PX)
        stated = max(psf + rng.normal(0.0, PSF_ERROR_PX), 0.0)
        preset = preset_camera(str(rng.choice(CAMERAS[self._shape])))
        side = SIDES_PX[int(diameter_px > SMALL_PX)]
        camera = replace(_part(preset, side, rng), psf_sigma_px=stated, psf_error_px=PSF_ERROR_PX)
        middle = camera.unproject(0.5 * (side - 1) + rng.uniform(-1.0, 1.0, 2))
        phase = rng.uniform(*np.radians(PHASE_DEG))
        up, aside = np.linalg.qr(rng.normal(size=(3, 2)))[0].T
        sun = np.cos(phase) * up + np.sin(phase) * aside
        radius = float(np.mean(self.body.radii_m))
        angle = 0.5 * diameter_px * _rad_per_px(camera, middle)
        position = radius / np.sin(angle) * up
        level = Rotation.align_vectors(middle[None], -up[None])[0]
        attitude = Rotation.from_rotvec(rng.uniform(0.0, 2.0 * np.pi) * middle) * level
        epoch = Epoch(0, 0, 0.0, position, aside, sun, False, ground)
        exposure = Exposure(
            **vars(epoch), camera_from_body=attitude, reported_camera_from_body=attitude
        )
        radiance = self._ground.radiance(_finer(camera), exposure)
        picture, phase_deg = _exposed(radiance, KNOWN, psf, rng), float(np.degrees(phase))
        return DrawnDisc(picture, camera, position, attitude, sun, diameter_px, phase_deg, radiance)


def _relief(model: MeshSettings, body: Body) -> GlobalRelief:
    """The relief that a catalog of the shape model carries."""
    shape = load_shape(model, Path.cwd(), body)
    with tempfile.TemporaryDirectory() as folder:
        corners = Path(folder) / "corners.npy"
        np.save(corners, shape.vertices[shape.faces])
        return make_mesh_relief(MeshTerrain(body, corners, "shape model", shape.posting_m))


def _part(camera: Camera, side: int, rng: np.random.Generator) -> Camera:
    """A square part of a camera's picture, somewhere off the axis."""
    off = rng.uniform(-OFF_AXIS, OFF_AXIS, 2) * camera.width_px
    x, y = 0.5 * (side - 1) - off
    return replace(camera, width_px=side, height_px=side, principal_point_px=(float(x), float(y)))


def _finer(camera: Camera) -> Camera:
    x, y = (FINE * (value + 0.5) - 0.5 for value in camera.principal_point_px)
    return replace(
        camera,
        width_px=FINE * camera.width_px,
        height_px=FINE * camera.height_px,
        focal_length_px=FINE * camera.focal_length_px,
        principal_point_px=(x, y),
    )


def _rad_per_px(camera: Camera, towards: FloatArray) -> float:
    """Side of the square that a pixel sees there."""
    pixel = camera.project(towards)
    steps = camera.unproject(pixel + np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]))
    return float(np.sqrt(np.linalg.norm(np.cross(steps[1] - steps[0], steps[2] - steps[0]))))


@dataclass(frozen=True)
class DiscResult:
    """A disc solved, or why not.

    blur           KNOWN or one of BLURS
    direction_px   error of the direction to the centre, rms of an axis, in pixels
    range_share    of the range, over it
    direction_nees, range_nees  squared errors over their expectation
    """

    shape: str
    blur: str
    diameter_px: float
    phase_deg: float
    method: str = ""
    direction_px: float = np.nan
    range_share: float = np.nan
    direction_nees: float = np.nan
    range_nees: float = np.nan
    reason: str = ""


is_disc_file = make_prefix_test(b'[\n {\n  "shape"')


def run(progress: Progress, discs: int, output: Path | None) -> list[DiscResult]:
    """Draw and solve `discs` discs a bin and body; output is a JSON file of all results."""
    if output is not None:
        check_file(output, is_disc_file)
    found: list[DiscResult] = []
    bins = list(pairwise(EDGES_PX))
    for which, shape in enumerate(SHAPES):
        scene = DiscScene(shape)
        total = discs * len(bins)
        with progress.stage(f"discs of {shape}", total, "disc") as bar:
            for number in range(total):
                rng = np.random.default_rng([SEED, which, number])
                low, high = bins[number % len(bins)]
                diameter = float(np.exp(rng.uniform(np.log(low), np.log(high))))
                disc = scene.draw(diameter, GROUNDS[number * len(GROUNDS) // total], rng)
                found.append(solve(scene, disc, KNOWN))
                blur = BLURS[(number // len(bins)) % len(BLURS)]
                found.append(solve(scene, disc.blurred_anew(blur, rng), blur))
                bar.advance()
    if output is not None:
        text = json.dumps([asdict(result) for result in found], indent=1)
        write_output(output, f"{text}\n".encode(), is_disc_file)
    return found


def solve(scene: DiscScene, disc: DrawnDisc, blur: str) -> DiscResult:
    """Solve a disc and compare it with its truth."""
    body, camera = scene.body, disc.camera
    result = DiscResult(body.name, blur, disc.diameter_px, disc.phase_deg)
    try:
        fix = outline.navigate(
            disc.picture, camera, disc.camera_from_body, 0.0, disc.sun_body, body, scene.relief
        )
    except NoSolutionError as error:
        return replace(result, reason=str(error))
    error_m = fix.position_m - disc.position_m
    distance = float(np.linalg.norm(disc.position_m))
    up = disc.position_m / distance
    square = np.linalg.svd(up[None])[2][1:]
    across = square @ error_m
    covariance = square @ fix.covariance_m2 @ square.T
    px_per_m = 0.5 * disc.diameter_px / float(np.mean(body.radii_m))
    return replace(
        result,
        method=fix.method,
        direction_px=float(np.linalg.norm(across)) * px_per_m / np.sqrt(2.0),
        range_share=float(error_m @ up) / distance,
        direction_nees=float(across @ np.linalg.solve(covariance, across)) / 2.0,
        range_nees=float(error_m @ up) ** 2 / float(up @ fix.covariance_m2 @ up),
    )


COLUMNS = columns(
    "disc; solved; discs; direction_px = direction, rms [px] .3f; direction_nees = NEES .2f; "
    "range_share = range, rms [%] .2f; range_nees = NEES .2f; worst [σ] .1f; methods"
)


def report(results: Sequence[DiscResult]) -> StudyReport:
    """One line a body, knowledge of the blur and bin of diameter; one for each unknown blur."""
    rows = []
    pooled: list[tuple[str, tuple[str, ...], tuple[float, float]]]
    pooled = [(f"blur unknown, {blur}", (blur,), (EDGES_PX[0], 10.0)) for blur in BLURS]
    for shape in SHAPES:
        cases: list[tuple[str, tuple[str, ...], tuple[float, float]]]
        cases = [("", (KNOWN,), edges) for edges in pairwise(EDGES_PX)]
        cases += [("blur unknown", BLURS, edges) for edges in pairwise(EDGES_PX)]
        for words, blurs, (low, high) in cases + pooled:
            own = [r for r in results if r.shape == shape and r.blur in blurs]
            own = [r for r in own if low <= r.diameter_px < high]
            name = f"{shape}, {low:g}-{high:g} px" + (f", {words}" if words else "")
            rows.append(_cells(name, own))
    reasons = Counter(r.reason.rpartition("; ")[2][:90] for r in results if not r.method)
    notes = [f"wanted: NEES {NEES[0]}-{NEES[1]}; worst: of direction or range"]
    notes += [f"{count} not solved: {reason}" for reason, count in reasons.most_common(6)]
    return StudyReport((StudyTable("", COLUMNS, tuple(rows)),), tuple(notes))


def _cells(name: str, results: Sequence[DiscResult]) -> tuple[Cell, ...]:
    solved = [r for r in results if r.method]
    start = (name, len(solved), len(results))
    if not solved:
        return (*start, None, None, None, None, None, "none solved")
    across = np.array([r.direction_nees for r in solved])
    along = np.array([r.range_nees for r in solved])
    direction = (rms([r.direction_px for r in solved]), across.mean())
    ranges = (100.0 * rms([r.range_share for r in solved]), along.mean())
    worst = np.sqrt(max(2.0 * across.max(), along.max()))
    return (*start, *direction, *ranges, worst, tally([r.method for r in solved]))
