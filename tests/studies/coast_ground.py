"""A procedural coast with fields and forest, in seasons, under clouds: what a satellite sees of it.

Ours, for pictures of the Earth where no imagery may travel along. What stays from season to season
is where borders run: the coast, rivers, the edges of parcels and forest. How bright a parcel is
does not stay: most fields are drawn anew, so that a border may turn from dark-bright to
bright-dark. Clouds hide a share of the ground and throw shadows.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from catalog.arrays import Float32Array, FloatArray

SEA, FOREST, FIELD = 0, 1, 2
CROPS = 6  # kinds of field, each of one brightness in a season
# Brightness (0..1): of water and forest by season, and the range of fields.
WATER, WOOD, CROP_RANGE = (0.05, 0.08), (0.12, 0.26), (0.15, 0.6)
KEPT_FIELDS = 0.3  # share of parcels whose brightness stays from one season to the next

COARSE = 4  # pixels to a node on which waves of so many nodes are drawn
MIN_NODES = 8.0


def draw_fractal(
    seed: int,
    shape: tuple[int, int],
    largest_px: float,
    slope: float,
    smallest_px: float = 4.0,
) -> Float32Array:
    """Draw a random field (rows, cols), mean 0 and variance 1, of a power law of wavelength.

    largest_px, smallest_px  longest and shortest wave;  slope  of the amplitude over the wavelength
    """
    rng = np.random.default_rng(seed)
    coarse = tuple(-(-side // COARSE) + 1 for side in shape)
    total = np.zeros(coarse, np.float32)
    wave, step = largest_px, COARSE
    while wave >= smallest_px:
        if step > 1 and wave < MIN_NODES * COARSE:
            total, step = _enlarge(total, shape), 1
        total += np.float32(wave**slope) * _draw_waves(rng, total.shape, wave / step)
        wave /= 2.0
    if step > 1:
        total = _enlarge(total, shape)
    field: Float32Array = ((total - total.mean()) / total.std()).astype(np.float32)
    return field


def _draw_waves(rng: np.random.Generator, shape: tuple[int, ...], wave: float) -> Float32Array:
    noise = rng.standard_normal([int(side / wave) + 4 for side in shape]).astype(np.float32)
    offset = rng.uniform(0.0, 1.0, 2)
    matrix = np.array([[wave, 0.0, -wave * offset[0]], [0.0, wave, -wave * offset[1]]])
    waves = cv2.warpAffine(noise, matrix, shape[::-1], flags=cv2.INTER_CUBIC)
    return waves.astype(np.float32)


def _enlarge(field: Float32Array, shape: tuple[int, int]) -> Float32Array:
    matrix = np.array([[COARSE, 0.0, 0.0], [0.0, COARSE, 0.0]])
    wide = cv2.warpAffine(field, matrix, shape[::-1], flags=cv2.INTER_CUBIC)
    return wide.astype(np.float32)


@dataclass(frozen=True, eq=False)
class CoastGround:
    """Ground as classes of pixels.

    kind    (rows, cols) uint8: SEA, FOREST or FIELD
    parcel  (rows, cols) int32 number of the parcel
    grain   (rows, cols) what varies inside parcels and stays
    """

    seed: int
    kind: np.ndarray
    parcel: np.ndarray
    grain: Float32Array

    @classmethod
    def draw(cls, seed: int, shape: tuple[int, int], posting_m: float) -> "CoastGround":
        """Draw ground of pixels of posting_m."""
        coast = draw_fractal(seed, shape, 250e3 / posting_m, 0.9)
        wood = draw_fractal(seed + 1000, shape, 25e3 / posting_m, 0.8)
        parcel = _draw_parcels(seed + 2000, shape, posting_m)
        kind = np.where(wood > 0.4, FOREST, FIELD).astype(np.uint8)
        river = np.abs(draw_fractal(seed + 3000, shape, 120e3 / posting_m, 0.9)) < 0.012
        kind[(coast < -0.45) | river] = SEA
        return cls(seed, kind, parcel, draw_fractal(seed + 4000, shape, 4e3 / posting_m, 0.3))

    def show(self, season: int) -> Float32Array:
        """Brightness (rows, cols), 0 to 1, in a season; 0 is that of the mosaic."""
        rng = np.random.default_rng([self.seed, 17])
        many = int(self.parcel.max()) + 1
        crops = rng.integers(0, CROPS, many)
        kept = rng.uniform(size=many) < KEPT_FIELDS
        tone = rng.uniform(*CROP_RANGE, CROPS)
        if season:
            again = np.random.default_rng([self.seed, 18, season])
            other = again.integers(0, CROPS, many)
            crops = np.where(kept, crops, other)
            tone = np.where(
                again.uniform(size=CROPS) < 0.3, tone, again.uniform(*CROP_RANGE, CROPS)
            )
        draw = np.random.default_rng([self.seed, 19, season])
        water, wood = draw.uniform(*WATER), draw.uniform(*WOOD)
        bright = tone.astype(np.float32)[crops[self.parcel]]
        bright = np.where(self.kind == FOREST, np.float32(wood), bright)
        bright = bright * (1.0 + 0.06 * self.grain)
        return np.where(self.kind == SEA, np.float32(water), bright).astype(np.float32)


def _draw_parcels(seed: int, shape: tuple[int, int], posting_m: float) -> np.ndarray:
    """Number parcels of 1 to 4 km, in blocks of one orientation each."""
    rng = np.random.default_rng(seed)
    rows, cols = np.mgrid[: shape[0], : shape[1]].astype(np.float32)
    # the blocks' borders and directions change slowly over the ground
    turn = draw_fractal(seed + 1, shape, 60e3 / posting_m, 1.0)
    block = np.floor(turn * 1.5).astype(np.int32) + 8
    out = np.zeros(shape, np.int32)
    for number in np.unique(block):
        angle, across = rng.uniform(0.0, np.pi), rng.uniform(1.0e3, 4.0e3, 2) / posting_m
        u = (cols * np.cos(angle) + rows * np.sin(angle)) / across[0]
        strip = np.floor(u).astype(np.int64)
        shift = np.random.default_rng([seed, int(number)]).uniform(0.0, 1.0, 65536)
        v = (rows * np.cos(angle) - cols * np.sin(angle)) / across[1] + shift[strip % 65536]
        key = (
            strip * 7919 + np.floor(v).astype(np.int64) * 104729 + int(number) * 1299709
        ) % 200003
        here = block == number
        out[here] = key[here]
    return out


def add_clouds(
    brightness: Float32Array, seed: int, share: float, posting_m: float
) -> tuple[Float32Array, FloatArray]:
    """Lay clouds over brightness (rows, cols); return it and the cover (rows, cols), 0 to 1.

    share  of the ground that is covered
    """
    shape = brightness.shape[0], brightness.shape[1]
    field = draw_fractal(seed, shape, 150e3 / posting_m, 0.8, MIN_NODES * COARSE)
    edge = float(np.quantile(field[::8, ::8], 1.0 - share))
    cover = np.clip((field - edge) / 0.15 + 0.5, 0.0, 1.0)
    white = 0.75 + 0.1 * draw_fractal(seed + 1, shape, 20e3 / posting_m, 0.5, MIN_NODES * COARSE)
    shift = max(1, round(3e3 / posting_m))  # a cloud 3 km high under a Sun of 45 deg
    shadow = np.roll(cover, (shift, shift // 2), axis=(0, 1)) * (1.0 - cover)
    shown = brightness * (1.0 - 0.5 * shadow)
    shown = shown * (1.0 - cover) + np.clip(white, 0.4, 1.0) * cover
    return shown.astype(np.float32), cover
