"""What cases are made from: small whole inputs of every kind, made once by the commands themselves.

Terrain models, shapes, configs of all kinds, a catalog of two points, one with relief and one of a
small body, picture folders, runs, and older outputs. All are as small as the commands take them, so
that a case costs milliseconds.
"""

import os
import shutil
from importlib import import_module
from pathlib import Path
from unittest import mock

import cv2
import erfa
import numpy as np
import rasterio
import trimesh
from rasterio.transform import Affine

from catalog.bodies.body import load_body
from catalog.bodies.ephemeris import AnalyticEphemeris
from catalog.bodies.epochs import utc_from_tdb_s
from catalog.bodies.stars import load_bright_stars
from catalog.geometry.rotations import ARCSEC
from optnav_cli.dynamics.forces import Forces, OrbitMotion
from optnav_cli.fix import Fix, Method, Solution
from optnav_cli.frames.orbit_tables import ZENITH
from optnav_cli.frames.run_settings import FileAttitude, RunSettings, write_run_settings
from optnav_cli.main import run
from optnav_cli.orbit.fit.zenith import zenith_distances, zenith_row
from optnav_cli.output.tables import write_solutions

MOON_DEG = "+proj=longlat +R=1737400 +no_defs"
REGION_PER_DEG = 32.0
DONE = "done"
SIDE_PX = 64
BOX = "10.4,20,11.3,21"  # one cell of the region
CAMERA = (
    f'name = "cam"\nmodel = "pinhole"\nwidth_px = {SIDE_PX}\nheight_px = {SIDE_PX}\n'
    f"focal_length_px = 90.0\nprincipal_point_px = [{SIDE_PX / 2 - 0.5}, {SIDE_PX / 2 - 0.5}]\n"
)
DESIGNS = {
    "qso.toml": '[qso]\ntime = "2026-01-01T00:00:00Z"\ndistance_km = 55.0\ndays = 1.0\n',
    "landing.toml": '[landing]\ntime = "2026-01-01T07:23:25Z"\ntarget_lat_deg = 0.0\n'
    "target_lon_deg = 90.0\ntrials = 1\n[beams]\nevery_s = 120.0\n",
    "delivery.toml": '[delivery]\ntarget = "moon"\ncentre = "earth"\n'
    'start = "2026-03-01T00:00:00Z"\n'
    "position_km = [6211.415694521102, 1778.842276298046, 1196.6938730985983]\n"
    "velocity_km_s = [-2.925287714986544, 9.809453411389116, 3.8147083990865895]\n"
    "corrections_days = [1.0, 3.0]\ntrials = 200\n[optical]\nevery_s = 20000.0\n",
}
LIMB_CAMERA = (
    'name = "wide"\nmodel = "kannala_brandt"\nwidth_px = 128\nheight_px = 128\n'
    "focal_length_px = 180.0\nprincipal_point_px = [63.5, 63.5]\n"
    "coefficients = [0.0, 0.0, 0.0, 0.0]\npsf_sigma_px = 0.7\npsf_error_px = 0.1\n"
)
PAIR_CAMERA = (
    'name = "shtk"\nmodel = "pinhole"\nwidth_px = 320\nheight_px = 320\n'
    "focal_length_px = 775.0\nprincipal_point_px = [159.5, 159.5]\n"
)
LAB_CAMERA = (
    'name = "lab"\nmodel = "pinhole"\nwidth_px = 160\nheight_px = 120\n'
    "focal_length_px = 450.0\nprincipal_point_px = [79.5, 59.5]\n"
)
BODY = """name = "pebble"
radius_km = 11.0
radii_km = [12.65, 11.0, 9.35]
gm_km3_s2 = 7.0e-4
plausible_heights_km = [-4.0, 4.0]
sun = "mars"
[rotation]
pole_ra_deg_by_century = [317.0, -0.1, 0.0]
pole_dec_deg_by_century = [52.0, -0.06, 0.0]
meridian_deg_by_day = [35.0, 1128.8, 0.0]
[[rotation.terms]]
angle_deg_by_century = [190.0, 15917.0, 0.0]
ra_deg = -1.7
"""
BUILD = """[body]
name = "moon"
[[dem]]
path = "dem.tif"
[pyramid]
levels = 2
size = 48
[check]
trials = 2
search_km = 4.0
"""
MESH_BUILD = """[body]
name = "body.toml"
[[mesh]]
path = "body.obj"
units = "km"
[grid]
cell_deg = 15.0
[pyramid]
levels = 1
size = 48
[render]
candidates = 2
sun_elevations = 1
[check]
trials = 1
min_recognition = 0.0
min_margin = 0.0
max_shadowed = 1.0
"""
FRAME = """KPL/FK
\\begindata
FRAME_MOON_ME = 31007
FRAME_31007_NAME = 'MOON_ME'
FRAME_31007_CLASS = 4
FRAME_31007_CLASS_ID = 31007
FRAME_31007_CENTER = 301
TKFRAME_31007_SPEC = 'ANGLES'
TKFRAME_31007_RELATIVE = 'IAU_MOON'
TKFRAME_31007_ANGLES = ( 0. 0. 0. )
TKFRAME_31007_AXES = ( 3 2 1 )
TKFRAME_31007_UNITS = 'ARCSECONDS'
\\begintext
"""
NAVIGATE = "[view]\nsun_max_deg = 80.0\n[match]\ntemplate_nodes = 32\nmax_search_nodes = 8\n"
CALIBRATE = "[search]\nposition_m = 1500.0\nattitude_arcsec = 400.0\n[prior]\nfocal_percent = 3.0\n"
ORBIT = '[forces]\ndegree = 2\n[noise]\nmodel = "white"\ndensity_m2_s3 = 1e-12\n'
_SHARED = 'seed = 3\ncamera = {name = "cam.toml"}\nsensor = {snr = 80.0}\n'
_GLOBE = (
    _SHARED + 'dem = []\nglobe = {path = "globe.tif"}\n'
    "detail = {seeds = [], smallest_m = 60000.0}\n"
)
_SHAPE = (
    _SHARED + 'body = "body.toml"\nmesh = {path = "body.obj", units = "km"}\n'
    "detail = {seeds = [], smallest_m = 4000.0}\n"
)
SCENARIOS = {
    "passes": _SHARED + 'dem = [{path = "dem.tif"}]\nglobe = {path = "globe.tif"}\n'
    "detail = {seeds = [], smallest_m = 900.0}\n"
    "[orbit]\naltitude_km = 100.0\nbox_deg = [10.8, 19.8, 11.2, 20.2]\n"
    "passes = 1\nframes = 1\n[sun]\nelevation_deg = [20.0, 25.0]\n",
    "route": _SHARED + 'dem = [{path = "dem.tif"}]\nglobe = {path = "globe.tif"}\n'
    "detail = {seeds = [], smallest_m = 900.0}\nattitude = {sigma_arcsec = 10.0}\n"
    "[orbit]\naltitude_km = 100.0\nbox_deg = [10.9, 19.9, 11.1, 20.1]\n"
    "passes = 4\nframes = 1\n[sun]\nelevation_deg = [20.0, 25.0]\n",
    "far": _GLOBE + "prior = {given = false}\n[orbit]\naltitude_km = 40000.0\n"
    "box_deg = [-180.0, -90.0, 180.0, 90.0]\npasses = 1\nframes = 2\n"
    "[sun]\nelevation_deg = [40.0, 50.0]\n",
    "limb": _GLOBE.replace("cam.toml", "wide.toml")
    + "prior = {given = false}\n[orbit]\naltitude_km = 5000.0\n"
    "box_deg = [-180.0, -90.0, 180.0, 90.0]\npasses = 1\nframes = 1\n"
    "[sun]\nelevation_deg = [40.0, 50.0]\n",
    "flight": _GLOBE + "[flight]\nlowest_km = 6000.0\nhighest_km = 6000.0\nframes = 1\n",
    "transfer": _GLOBE + "[transfer]\nfrom_km = 9000.0\nto_km = 6000.0\nframes = 2\n",
    "portraits": _SHAPE + "[portraits]\ndistance_km = [60.0, 60.0]\n",
    "approach": _SHARED + 'body = "phobos"\nmesh = {path = "body.obj", units = "km"}\n'
    "detail = {seeds = [], smallest_m = 4000.0}\n"
    "[approach]\nfrom_km = 100.0\nto_km = 60.0\nspeed_m_s = 35.0\nframes = 2\n",
    "stereo": 'seed = 3\ncamera = {name = "shtk.toml"}\nsensor = {snr = 80.0}\n'
    "detail = {seeds = [1], smallest_m = 0.2}\n"
    "[stereo]\nheights_m = [60.0]\nplace_deg = [11.0, 20.0]\nlargest_m = 20.0\n"
    '[[mount]]\ncamera = "left"\nposition_m = [-0.5, 0.0, 0.0]\n'
    '[[mount]]\ncamera = "right"\nposition_m = [0.5, 0.0, 0.0]\nerror_arcsec = 20.0\n',
    "cylinder": 'seed = 3\ncamera = {name = "lab.toml"}\n[cylinder]\nradius_m = 0.14\n'
    "height_m = 0.15\ndistance_m = 1.3\ntheta_deg = 40.0\npictures = 2\nspacing_s = 2.0\n",
    "descent": _SHARED + 'dem = [{path = "dem.tif"}]\ndetail = {seeds = [], smallest_m = 900.0}\n'
    "[descent]\nfrom_km = 60.0\nto_km = 56.0\nduration_s = 20.0\nspacing_s = 10.0\n"
    "speed_m_s = [800.0, 790.0]\nend_deg = [11.0, 20.0]\ntilt_deg = [5.0, 0.0]\n"
    "[inertial]\nposition_sigma_m = 300.0\nvelocity_sigma_m_s = 0.8\n"
    "attitude_sigma_arcsec = 12.0\n",
}  # fmt: skip
# in the order in which they are made: each needs those before it
COMMANDS = (
    ("build", "moon.toml", "-o", "moon.gpkg", "--workers", "1", "--bbox", "10,20,12,21"),
    ("build", "relief.toml", "-o", "relief.gpkg", "--workers", "1", "--bbox", BOX),
    ("build", "mesh.toml", "-o", "mesh.gpkg", "--workers", "1", "--bbox", "0,0,31,29"),
    ("simulate", "far.toml", "-o", "pictures"),
    ("navigate", "pictures", "--catalog", "moon.gpkg", "-o", "run"),
    ("simulate", "passes.toml", "-o", "near"),
    ("navigate", "near", "--catalog", "moon.gpkg", "-o", "near.run"),
    ("simulate", "route.toml", "-o", "route"),
    ("simulate", "limb.toml", "-o", "limb"),
    ("navigate", "limb", "--catalog", "relief.gpkg", "-o", "limb.run"),
    ("simulate", "stereo.toml", "-o", "pair"),
    ("stereo", "pair", "-o", "heights"),
    ("hazard", "pair", "--height-m", "60", "--pad-m", "4", "--square-m", "8", "-o", "pads"),
    ("slopes", "dem.tif", "--base-m", "3000", "-o", "slopes.tif"),
    ("config", "template", "points", "-o", "picked"),
    ("simulate", "cylinder.toml", "-o", "lamp"),
    ("simulate", "descent.toml", "-o", "fall"),
    ("navigate", "fall", "--catalog", "moon.gpkg", "-o", "fall.run"),
    ("orbit", "fit", "flown", "--config", "orbit.toml", "-o", "orbit"),
    ("evaluate", "run", "--truth", "pictures/truth.csv"),
    ("export", "run", "-o", "run.gpkg"),
    ("report", "run", "-o", "old.html"),
    ("report", "run", "-o", "old.svg"),
    ("catalog", "show", "moon.gpkg", "-o", "old.png", "27858"),
    ("catalog", "export", "moon.gpkg", "-o", "old.geojson"),
    ("catalog", "export", "moon.gpkg", "-o", "old.csv"),
    ("catalog", "export", "moon.gpkg", "-o", "points.gpkg"),
    ("catalog", "export", "relief.gpkg", "-o", "old.tif"),
    ("catalog", "export", "moon.gpkg", "--point", "27858", "-o", "patch.tif"),
    ("catalog", "export", "moon.gpkg", "--point", "27858", "-o", "old.glb"),
    ("catalog", "export", "moon.gpkg", "--point", "27858", "-o", "old.obj"),
)
# what the work folder of a stopped command is made with, which is named after the output
HALF_DONE = ("navigate", "pictures", "--catalog", "moon.gpkg", "-o", "half")


def _stop_half_way(*args: str) -> None:
    """Leave what a command leaves that was killed before its output stood: OUTPUT.work."""
    output = Path(args[-1])
    with mock.patch("optnav_cli.output.manifest.shutil.rmtree"):
        run(["-q", *args])
    shutil.rmtree(output)


def make_materials(folder: Path) -> None:
    """Fill the folder, unless an earlier call has."""
    if (folder / DONE).exists():
        return
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    before = Path.cwd()
    os.chdir(folder)
    try:
        _write_inputs()
        for args in COMMANDS:
            code = run(["-q", *args])
            if code not in (0, 4):  # one frame with two points need not be solved
                raise RuntimeError(f"the material of `optnav {' '.join(args)}` ended with {code}")
        _stop_half_way(*HALF_DONE)
        Path(DONE).touch()
    finally:
        os.chdir(before)


def _write_inputs() -> None:
    _write_dem(Path("dem.tif"))
    _write_globe(Path("globe.tif"))
    shape = trimesh.creation.icosphere(subdivisions=2, radius=11.0)
    shape.vertices *= [1.15, 1.0, 0.85]
    for ending in ("obj", "ply", "stl", "glb"):
        shape.export(f"body.{ending}")
    shape.export("body_text.ply", encoding="ascii")
    shape.export("body_text.stl", file_type="stl_ascii")
    Path("body.tab").write_text(_radii_table())
    Path("body.plt").write_text(_plates(shape))
    _write_kernels(Path("kernels"))
    _write_flown(Path("flown"))
    _write_zenith(Path("zenith.csv"))
    _write_dots(Path("dots.png"))
    _write_fields()
    texts = {
        "cam.toml": CAMERA,
        "wide.toml": LIMB_CAMERA,
        "shtk.toml": PAIR_CAMERA,
        "lab.toml": LAB_CAMERA,
        "body.toml": BODY,
        "moon.toml": BUILD,
        "relief.toml": BUILD + '[relief]\ndem = {path = "globe.tif"}\n',
        "mesh.toml": MESH_BUILD,
        "navigate.toml": NAVIGATE,
        "hazard.toml": "pad_m = 4.0\nsquare_m = 8.0\n",
        "calibrate.toml": CALIBRATE,
        "orbit.toml": ORBIT,
        **DESIGNS,
        **{f"{name}.toml": text for name, text in SCENARIOS.items()},
    }
    for name, text in texts.items():
        Path(name).write_text(text)


def _write_flown(folder: Path) -> None:
    """A run of ten fixes along an orbit."""
    folder.mkdir()
    body = load_body("moon")
    motion, start = AnalyticEphemeris(body), 7e8
    radius = body.radius_m + 1e5
    speed = (body.gm_m3_s2 / radius) ** 0.5
    first = np.array([radius, 0.0, 0.0, 0.0, 0.3 * speed, 0.95 * speed])
    times = start + 500.0 * np.arange(10)
    states, _ = OrbitMotion(Forces(motion)).propagate(first, start, times)
    rng, rows = np.random.default_rng(4), []
    for number, (time, state) in enumerate(zip(times, states, strict=True)):
        place = motion.body_from_inertial(time) @ state[:3] + 15.0 * rng.normal(size=3)
        fix = Fix(Method.CONTROL_POINTS, place, 225.0 * np.eye(3))
        rows.append(Solution(f"{number}.png", utc_from_tdb_s(time), fix))
    write_run_settings(RunSettings("moon", "camera_from_body"), folder)
    write_solutions(folder / "solution.csv", rows, FileAttitude("camera_from_body", body))


def _write_zenith(path: Path) -> None:
    """Zenith distances of three stars along a circular orbit."""
    stars, angles = load_bright_stars().propagate(7e8)[[4, 46, 6]], np.linspace(0.0, 6.0, 60)
    places = 2.7e6 * np.stack([np.cos(angles), 0.6 * np.sin(angles), 0.8 * np.sin(angles)], axis=1)
    directions = stars[np.arange(60) % 3]
    values = zenith_distances(places, directions)[0]
    rate = (4902.8001e9 / 2.7e6**3) ** 0.5
    rows = [
        zenith_row(utc_from_tdb_s(7e8 + angle / rate), star, float(value), 60.0 * ARCSEC)
        for angle, star, value in zip(angles, directions, values, strict=True)
    ]
    ZENITH.write(path, rows)


def _write_dots(path: Path) -> None:
    """A plane grid of 7 x 5 dots, tilted by 30 deg."""
    tilt = np.radians(30.0)
    picture = np.full((240, 320), 220, np.uint8)
    for row, col in np.ndindex(5, 7):
        x, y = 12.0 * (col - 3), 12.0 * (row - 2)
        scale = 300.0 / (130.0 + y * np.sin(tilt))
        middle = 159.5 + scale * x, 119.5 + scale * y * np.cos(tilt)
        size = (round(4 * 16 * scale), round(4 * 16 * scale * np.cos(tilt)))  # 1/16 px
        at = (round(16 * middle[0]), round(16 * middle[1]))
        cv2.ellipse(picture, at, size, 0, 0, 360, 30, -1, cv2.LINE_AA, 4)
    cv2.imwrite(str(path), picture)


def _write_fields() -> None:
    """A gravity field of degree 3 in three formats."""
    made = [(n, m, 1e-5 / (n + m), 1e-6 * m) for n in (2, 3) for m in range(n + 1)]
    gm, radius = 4902.8001e9, 1738e3
    lines = [f"{n}, {m}, {c:.9e}, {s:.9e}" for n, m, c, s in made]
    head = f"{radius / 1e3}, {gm / 1e9}, 0, 3, 3, 1, 0, 0"
    Path("field.tab").write_text("\n".join([head, *lines]) + "\n")
    head = f"gravity_constant {gm}\nradius {radius}\nmax_degree 3\nend_of_head ==="
    lines = [f"gfc {n} {m} {c:.9e} {s:.9e} 1e-9 1e-9" for n, m, c, s in made]
    Path("field.gfc").write_text("\n".join([head, *lines]) + "\n")
    head = f"POTFIELD  3  3  1 {gm:.14E} {radius:.14E} 1.0"
    lines = [f"RECOEF  {n:3d}{m:3d}   {c:21.14E}{s:21.14E}" for n, m, c, s in made]
    Path("field.cof").write_text("\n".join([head, *lines, "END"]) + "\n")


def _rotation() -> str:
    """A text kernel of the Moon's series, as configs/bodies has it."""
    series = load_body("moon").rotation

    def row(name: str, *values: float) -> str:
        # a line of a text kernel has up to 132 letters
        return f"BODY{name} = (\n" + "\n".join(f"  {value:.12g}" for value in values) + " )"

    terms = series.terms
    angles = [value for term in terms for value in term.angle_deg_by_century[:2]]
    lines = [
        "KPL/PCK",
        "\\begindata",
        row("301_POLE_RA", *series.pole_ra_deg_by_century),
        row("301_POLE_DEC", *series.pole_dec_deg_by_century),
        row("301_PM", *series.meridian_deg_by_day),
        row("301_RADII", 1737.4, 1737.4, 1737.4),
        row("3_NUT_PREC_ANGLES", *angles),
        row("301_NUT_PREC_RA", *(term.ra_deg for term in terms)),
        row("301_NUT_PREC_DEC", *(term.dec_deg for term in terms)),
        row("301_NUT_PREC_PM", *(term.meridian_deg for term in terms)),
        "\\begintext",
    ]
    return "\n".join(lines) + "\n"


def _write_kernels(folder: Path) -> None:
    """The Moon's rotation as text and as a binary kernel, a frame, and its orbit about the Sun."""
    folder.mkdir()
    (folder / "moon.tpc").write_text(_rotation())
    (folder / "moon.tf").write_text(FRAME)
    orbit, turn = folder / "moon.bsp", folder / "moon.bpc"
    try:
        spice = import_module("spiceypy")
    except ImportError:  # without it a binary kernel is refused whatever it holds
        orbit.write_bytes(b"DAF/SPK " + bytes(2040))
        turn.write_bytes(b"DAF/PCK " + bytes(2040))
        return
    day_s, au_km = 86400.0, 149597870.7
    days = np.arange(9490.0, 9700.0)  # past J2000: December 2025 to July 2026
    first, last = float(days[0] * day_s), float(days[-1] * day_s)
    _, earth = erfa.epv00(2451545.0, days)
    moon = erfa.moon98(2451545.0, days)
    handle = spice.spkopn(str(orbit), "fuzz", 0)
    for body, share, of_moon in ((301, 1.0, 1.0), (399, 1.0, 0.0), (10, 1e-9, 0.0)):
        position = earth["p"] + of_moon * moon["p"]
        speed = (earth["v"] + of_moon * moon["v"]) / day_s
        states = share * au_km * np.concatenate([position, speed], axis=1)
        form = "J2000", first, last, "fuzz", 7, days.size, states, first, day_s
        spice.spkw08(handle, body, 0, *form)
    spice.spkcls(handle)
    handle = spice.pckopn(str(turn), "fuzz", 0)
    angles = np.zeros(9)  # three angles of two coefficients, one interval; the last three unused
    spice.pckw02(handle, 31006, "J2000", first, last, "fuzz", last - first, 1, 2, angles[:6], first)
    spice.pckcls(handle)


def _write_dem(path: Path) -> None:
    """A rough square of 6 degrees, 8-14 E and 17-23 N."""
    rng = np.random.default_rng(5)
    size = int(6 * REGION_PER_DEG)
    heights = np.zeros((size, size), np.float32)
    for step in (2, 4, 8, 16):
        coarse = rng.normal(0.0, 24.0 * step, (size // step + 1,) * 2).astype(np.float32)
        heights += cv2.resize(coarse, (size, size), interpolation=cv2.INTER_CUBIC)
    affine = Affine(1 / REGION_PER_DEG, 0, 8.0, 0, -1 / REGION_PER_DEG, 23.0)
    write_raster(path, heights, affine)


def _write_globe(path: Path) -> None:
    lat = np.radians(90.0 - (np.arange(60) + 0.5) * 3.0)[:, None]
    lon = np.radians(-180.0 + (np.arange(120) + 0.5) * 3.0)[None, :]
    x, y, z = np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)
    heights = 3000.0 * np.sin(3.0 * x + 1.0) * np.cos(4.0 * y) + 1500.0 * z * np.sin(5.0 * x * y)
    write_raster(path, heights.astype(np.float32), Affine(3.0, 0, -180.0, 0, -3.0, 90.0))


def write_raster(path: Path, values, affine, **changes) -> None:  # type: ignore[no-untyped-def]
    """A GeoTIFF of one band on the Moon's sphere, unless changed."""
    rows, cols = values.shape
    profile = {
        "driver": "GTiff", "dtype": values.dtype.name, "count": 1, "width": cols, "height": rows,
        "crs": MOON_DEG, "transform": affine,
    } | changes  # fmt: skip
    with rasterio.open(path, "w", **profile) as file:
        for band in range(1, file.count + 1):
            file.write(values.astype(file.dtypes[0]), band)


def _radii_table(step_deg: int = 15) -> str:
    """Latitude, longitude and radius of a triaxial ellipsoid, one place a line."""
    lines = []
    for lat_deg in range(-90, 91, step_deg):
        for lon_deg in range(0, 361, step_deg):
            lat, lon = np.radians(lat_deg), np.radians(lon_deg)
            way = np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
            radius = 1.0 / np.linalg.norm(way / [12.65, 11.0, 9.35])
            lines.append(f"{lat_deg:8.1f} {lon_deg:8.1f} {radius:10.5f}")
    return "\n".join(lines) + "\n"


def _plates(shape: trimesh.Trimesh) -> str:
    """Numbers of vertices and plates, then both, counted from 1."""
    lines = [f"{len(shape.vertices)} {len(shape.faces)}"]
    lines += [f"{i} {x:.6f} {y:.6f} {z:.6f}" for i, (x, y, z) in enumerate(shape.vertices, 1)]
    lines += [f"{i} {a} {b} {c}" for i, (a, b, c) in enumerate(shape.faces + 1, 1)]
    return "\n".join(lines) + "\n"
