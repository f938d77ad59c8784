"""All that a camera's pictures show besides the body, as a scenario says."""

import numpy as np

from catalog.arrays import Float32Array
from catalog.bodies.motion import BodyMotion
from optnav_cli.camera.camera import Camera
from optnav_cli.simulation.scenario import AnyScenario
from optnav_cli.simulation.sensor import Besides, Counts, add_hot_pixels
from optnav_cli.simulation.ship import glare_veil, structure_cover
from optnav_cli.simulation.shot import Shot
from optnav_cli.simulation.sky import add_earth, star_light

HOT, STRUCTURE = 23, 29  # streams of random numbers, apart from those of noise and trajectory


class Surroundings:
    """Sky, ship and faults of one camera; `motion` says where the stars and the Earth stand."""

    def __init__(self, scenario: AnyScenario, camera: Camera, motion: BodyMotion) -> None:
        self._scenario, self._camera, self._motion = scenario, camera, motion
        seed = scenario.seed * 1000 + STRUCTURE
        self._cover = (
            structure_cover(scenario.structure, camera, seed) if scenario.structure else None
        )
        self._rays = None
        if scenario.glare.strength > 0.0:
            x, y = np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px))
            self._rays = camera.unproject(np.stack([x, y], axis=-1).astype(np.float64))

    def besides(self, shot: Shot, radiance: Float32Array) -> Besides | None:
        """What to expose beside the radiance of a shot, None for nothing.

        The Earth, where it is wanted and in view, is put into the radiance, in place.
        """
        sky = self._scenario.sky
        if sky.earth:
            add_earth(radiance, shot, self._camera, self._motion)
        veil, stars = None, None
        if self._rays is not None:
            veil = glare_veil(shot, self._rays, self._scenario.glare)
        if sky.stars_to_magnitude > 0.0:
            stars = star_light(
                shot, self._camera, self._motion, sky.stars_to_magnitude, self._scenario.sensor
            )
        if self._cover is None and veil is None and stars is None:
            return None
        cover, brightness = self._cover or (None, None)
        return Besides(cover, brightness, veil, stars)

    def with_hot_pixels(self, counts: Counts) -> Counts:
        """The counts with the camera's hot pixels, the same ones every time."""
        sensor = self._scenario.sensor
        if sensor.hot_pixels:
            rng = np.random.default_rng([self._scenario.seed, HOT, *self._camera.name.encode()])
            add_hot_pixels(counts, sensor.hot_pixels, sensor.bits, rng)
        return counts
