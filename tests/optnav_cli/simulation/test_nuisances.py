"""Sky, ship and faults in pictures: where, how bright, and hidden by what."""

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from catalog.bodies.body import load_body
from catalog.bodies.ephemeris import AnalyticEphemeris
from optnav_cli.camera.camera import Camera
from optnav_cli.simulation.passes import Scenario
from optnav_cli.simulation.scenario import load_scenario
from optnav_cli.simulation.scenario_base import Exposure
from optnav_cli.simulation.sections import (
    GlareSettings,
    SensorSettings,
    SkySettings,
    StructureSettings,
)
from optnav_cli.simulation.sensor import Besides, expose
from optnav_cli.simulation.surroundings import Surroundings, load_bright_stars

ROOT = Path(__file__).resolve().parents[3]
MOTION = AnalyticEphemeris(load_body("moon"))
CAMERA = Camera("unk", "pinhole", 300, 200, 1500.0, (149.5, 99.5))
SENSOR = SensorSettings(psf_sigma_px=0.8, snr=50.0, read_noise_e=10.0, bits=12)


def scenario_with(**sections: object) -> Scenario:
    scenario = load_scenario(ROOT / "configs" / "scenarios" / "far_100000km.toml")
    assert isinstance(scenario, Scenario)
    return msgspec.structs.replace(scenario, **{"sensor": SENSOR, **sections})


def looking(direction_inertial: np.ndarray) -> Exposure:
    """A shot with the boresight along an inertial direction."""
    first = scenario_with().exposures(AnalyticEphemeris(MOTION.body))[0]
    z = MOTION.body_from_inertial(first.tdb_s) @ direction_inertial
    z = z / np.linalg.norm(z)
    x = np.cross(z, [0.4, 0.3, -0.8])
    x /= np.linalg.norm(x)
    return replace(
        first, camera_from_body=Rotation.from_matrix(np.stack([x, np.cross(z, x), z]))
    )  # fmt: skip


def radec(ra_deg: float, dec_deg: float) -> np.ndarray:
    ra, dec = np.radians([ra_deg, dec_deg])
    return np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])


SIRIUS = radec(101.2872, -16.7161)  # Hipparcos 32349, V -1.44


def test_the_star_list_holds_all_stars_of_the_naked_eye():
    """Names of the sky, from other catalogues: Sirius, Polaris and Vega, V -1.44, 1.97, 0.03."""
    stars = load_bright_stars()
    assert len(stars.magnitudes) == 9928
    assert np.count_nonzero(stars.magnitudes <= 6.5) == pytest.approx(8800, abs=100)
    for place, magnitude in ((SIRIUS, -1.44), (radec(37.95, 89.264), 1.97),
                             (radec(279.2347, 38.7837), 0.03)):  # fmt: skip
        off = np.arccos(np.clip(stars.directions @ place, -1.0, 1.0))
        found = int(np.argmin(off))
        assert np.degrees(off[found]) < 0.01
        assert stars.magnitudes[found] == pytest.approx(magnitude, abs=0.02)


def star_picture(
    to_magnitude: float, shot: Exposure, radiance: np.ndarray | None = None
) -> np.ndarray:
    sky = SkySettings(stars_to_magnitude=to_magnitude)
    around = Surroundings(scenario_with(sky=sky), CAMERA, MOTION)
    dark = np.zeros(CAMERA.shape, np.float32) if radiance is None else radiance
    counts = expose(dark, SENSOR, np.random.default_rng(3), around.besides(shot, dark))
    return counts.astype(float)


def test_a_star_stands_where_the_camera_projects_it_and_as_bright_as_stated():
    stars = load_bright_stars()
    # a lonely star of V 4: the pixels around it hold its light alone
    middle = radec(83.0, -2.0)  # Orion
    shot = looking(middle)
    inertial = shot.camera_from_body.as_matrix() @ MOTION.body_from_inertial(shot.tdb_s)
    pixels = CAMERA.project(stars.directions @ inertial.T)
    inside = (np.abs(pixels - [149.5, 99.5]) < [130.0, 85.0]).all(axis=1)
    inside &= stars.magnitudes < 3.0
    assert np.count_nonzero(inside) >= 3
    picture = star_picture(4.0, shot)
    picture -= np.median(picture)
    sigma = 1.4826 * np.median(np.abs(picture))
    for (x, y), magnitude in zip(pixels[inside], stars.magnitudes[inside], strict=True):
        r, c = round(y), round(x)
        patch = picture[r - 3 : r + 4, c - 3 : c + 4]
        rows, cols = np.mgrid[r - 3 : r + 4, c - 3 : c + 4]
        weight = np.maximum(patch, 0.0)
        centre = [(weight * cols).sum() / weight.sum(), (weight * rows).sum() / weight.sum()]
        # 250 and more electrons over a noise of 10 in 49 pixels
        np.testing.assert_allclose(centre, [x, y], atol=0.25)
        # a star off the pixel's middle peaks lower, by up to 0.4 here
        expected = 5.0 * 10.0 ** (-0.4 * (magnitude - 4.0))
        assert 0.45 * expected < patch.max() / sigma < 1.4 * expected


def test_stars_do_not_shine_through_the_body_or_the_ship():
    shot = looking(SIRIUS)
    lit = np.zeros(CAMERA.shape, np.float32)
    lit[:, :200] = 0.05
    bare = star_picture(4.0, shot)
    assert bare[95:105, 145:155].max() == 4095.0
    hidden = star_picture(4.0, shot, lit)
    assert hidden[95:105, 145:155].max() < 1.3 * np.median(hidden[:, :195])
    # nor through the body's night side, which has no light of its own
    inertial = MOTION.body_from_inertial(shot.tdb_s) @ SIRIUS
    aside = np.cross(inertial, [0.0, 0.0, 1.0])
    aside /= np.linalg.norm(aside)
    behind = replace(shot, position_m=-1e7 * inertial + 1.6e6 * aside)
    assert star_picture(4.0, behind)[95:105, 145:155].max() < 0.05 * 4095
    beside = replace(shot, position_m=-1e7 * inertial + 1.9e6 * aside)
    assert star_picture(4.0, beside)[95:105, 145:155].max() == 4095.0
    scenario = scenario_with(
        sky=SkySettings(stars_to_magnitude=4.0),
        structure=(StructureSettings(outline_px=((100.0, 0.0), (100.0, 199.0)), width_px=120.0),),
    )
    around = Surroundings(scenario, CAMERA, MOTION)
    dark = np.zeros(CAMERA.shape, np.float32)
    covered = expose(dark, SENSOR, np.random.default_rng(3), around.besides(shot, dark))
    assert covered[95:105, 145:155].max() < 0.05 * 4095


def test_the_earth_has_its_size_its_place_and_its_phase():
    first = looking(SIRIUS)
    t = first.tdb_s
    to_earth = MOTION.position_m("earth", t) - MOTION.body_from_inertial(t).T @ first.position_m
    shot = looking(to_earth)
    around = Surroundings(scenario_with(sky=SkySettings(earth=True)), CAMERA, MOTION)
    radiance = np.zeros(CAMERA.shape, np.float32)
    radiance[:, :148] = 0.02  # the body's limb runs over the Earth
    around.besides(shot, radiance)
    assert (radiance[:, :148] == np.float32(0.02)).all()
    radiance = np.zeros(CAMERA.shape, np.float32)
    sun = shot.sun_body
    side = shot.camera_from_body.inv().apply([0.0, 0.0, 1.0])
    full = replace(shot, sun_body=-side)
    around.besides(full, radiance)
    distance = float(np.linalg.norm(to_earth))
    radius_px = 1500.0 * np.tan(np.arcsin(6371000.0 / distance))
    area = np.count_nonzero(radiance > 0.0)
    assert area == pytest.approx(np.pi * radius_px**2, rel=0.15)
    rows, cols = np.mgrid[:200, :300]
    for axis, middle in ((cols, 149.5), (rows, 99.5)):
        assert (radiance * axis).sum() / radiance.sum() == pytest.approx(middle, abs=0.05)
    # a Lambert sphere's mean at full phase is two thirds of its middle
    assert radiance.max() == pytest.approx(0.3, rel=0.01)
    assert radiance.sum() / (np.pi * radius_px**2) == pytest.approx(0.2, rel=0.02)
    half = np.zeros(CAMERA.shape, np.float32)
    across = shot.camera_from_body.inv().apply([1.0, 0.0, 0.0])
    around.besides(replace(shot, sun_body=across), half)
    # at quadrature the disc's mean is 1/pi of the full one's, and its light is on the Sun's side
    assert half.sum() / radiance.sum() == pytest.approx(1.0 / np.pi, rel=0.03)
    assert (half * cols).sum() / half.sum() > 149.5 + 0.3 * radius_px
    assert sun @ sun == pytest.approx(1.0)


def test_the_earth_far_off_the_axis_of_a_fisheye_is_whole():
    """At 115 deg a fisheye stretches the disc across by the angle over its sine, 2.2 times."""
    first = looking(SIRIUS)
    t = first.tdb_s
    there = MOTION.body_from_inertial(t) @ MOTION.position_m("earth", t) - first.position_m
    distance = float(np.linalg.norm(there))
    camera = Camera("wide", "equidistant", 1000, 400, 220.0, (499.5, 199.5))
    angle = np.radians(115.0)
    seen = np.array([np.sin(angle), 0.0, np.cos(angle)])
    side = np.cross(there, [1.0, 2.0, 3.0])
    turn, _ = Rotation.align_vectors([seen, [0.0, 1.0, 0.0]], [there / distance, side])
    lit = replace(first, camera_from_body=turn, sun_body=-there / distance)
    radiance = np.zeros(camera.shape, np.float32)
    Surroundings(scenario_with(sky=SkySettings(earth=True)), camera, MOTION).besides(lit, radiance)
    rows, cols = np.nonzero(radiance > 0.01)
    across_px = 2.0 * 220.0 * np.arcsin(6371000.0 / distance)
    assert np.ptp(cols) + 1 == pytest.approx(across_px, abs=1.6)
    assert np.ptp(rows) + 1 == pytest.approx(across_px * angle / np.sin(angle), abs=1.6)


def test_parts_of_the_ship_cover_what_their_outlines_say():
    parts = (
        StructureSettings(((20.0, 30.0), (119.0, 30.0), (119.0, 79.0), (20.0, 79.0))),
        StructureSettings(((200.0, 0.0), (200.0, 199.0)), width_px=10.0, brightness=1.0),
        StructureSettings(((0.0, 150.0), (299.0, 150.0)), width_px=10.0, camera="another"),
    )
    scenario = scenario_with(structure=parts)
    lit = np.full(CAMERA.shape, 0.04, np.float32)
    pictures = []
    for camera in (CAMERA, replace(CAMERA, name="another")):
        around = Surroundings(scenario, camera, MOTION)
        found = around.besides(looking(SIRIUS), lit)
        assert found is not None
        assert found.cover is not None
        pictures.append(expose(lit, SENSOR, np.random.default_rng(1), found).astype(float))
    bias = 0.01 * 4095
    panel = pictures[0][35:75, 25:115] - bias
    ground = pictures[0][90:140, 20:150] - bias
    rod = pictures[0][90:140, 197:203] - bias
    assert abs(panel.mean()) < 0.02 * ground.mean()
    assert rod.mean() == pytest.approx(ground.mean(), rel=0.25)
    dark = np.count_nonzero(pictures[0][:, :180] - bias < 0.5 * ground.mean())
    assert dark == pytest.approx(100 * 50, rel=0.03)
    # the third part is black, and only the other camera sees it
    assert pictures[0][148:152, 250].mean() - bias > 0.8 * ground.mean()
    assert pictures[1][148:152, 250].mean() - bias < 0.1 * ground.mean()


def test_glare_falls_off_from_the_side_of_the_sun():
    shot = looking(SIRIUS)
    right = shot.camera_from_body.inv().apply([1.0, 0.0, 0.2])
    shot = replace(shot, sun_body=right / np.linalg.norm(right))
    glare = GlareSettings(strength=0.3, falloff_deg=5.0)
    around = Surroundings(scenario_with(glare=glare), CAMERA, MOTION)
    found = around.besides(shot, np.zeros(CAMERA.shape, np.float32))
    assert found is not None
    assert found.veil is not None
    assert found.veil.max() == pytest.approx(0.3, rel=1e-3)
    along = found.veil[100]
    assert (np.diff(along) > 0.0).all()
    # 299 px of 1500 px focal length are 11.4 deg
    assert along[-1] / along[0] == pytest.approx(np.exp(11.4 / 5.0), rel=0.03)
    assert np.abs(np.diff(along, 2)).max() < 1e-4


def test_hot_pixels_are_the_same_ones_in_all_pictures_of_a_camera():
    sensor = msgspec.structs.replace(SENSOR, hot_pixels=25)
    scenario = scenario_with(sensor=sensor)
    found = []
    for camera in (CAMERA, CAMERA, replace(CAMERA, name="shnk")):
        counts = np.zeros(CAMERA.shape, np.uint16)
        hot = Surroundings(scenario, camera, MOTION).with_hot_pixels(counts)
        found.append(np.flatnonzero(hot))
        assert hot.max() > 2000
    assert len(found[0]) == 25
    np.testing.assert_array_equal(found[0], found[1])
    assert not np.array_equal(found[0], found[2])


def test_nothing_besides_the_body_changes_no_count():
    rng = np.random.default_rng(0)
    light = rng.uniform(0.0, 0.1, CAMERA.shape).astype(np.float32)
    plain = expose(light, SENSOR, np.random.default_rng(2))
    empty = expose(light, SENSOR, np.random.default_rng(2), Besides())
    np.testing.assert_array_equal(plain, empty)
    assert Surroundings(scenario_with(), CAMERA, MOTION).besides(looking(SIRIUS), light) is None
