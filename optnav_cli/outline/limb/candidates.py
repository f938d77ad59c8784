"""From rises of brightness to the candidates that lie on the lit limb.

Source: Zhukov 2025, ch. 2: rises along rows and columns, stars and structure rejected, the
terminator by the Sun's direction, the sector test about the found centre.
"""

from dataclasses import dataclass

import numpy as np

from catalog.arrays import BoolArray, Float32Array, FloatArray, IntArray
from catalog.geometry.kernel import kernel
from optnav_cli.camera.camera import Camera
from optnav_cli.frames.segmentation import Blobs, Levels
from optnav_cli.outline.limb.cone import Cone, PixelRays, find_agreeing, measure_distances

RUN_PX = 3  # dark pixels before a rise and bright ones after it
MAX_CANDIDATES = 200_000  # a picture full of texture has no limb worth finding in it


@dataclass(frozen=True, eq=False)
class Candidates:
    """Rises from dark to bright.

    pixels    (n, 2)  x, y where the threshold is crossed
    scan      (n, 2)  unit vector of the scan, from dark to bright
    gradient  (n, 2)  of brightness over 5 x 5 pixels, counts / px
    """

    pixels: FloatArray
    scan: FloatArray
    gradient: FloatArray

    def __len__(self) -> int:
        return len(self.pixels)

    def subset(self, kept: BoolArray | IntArray) -> "Candidates":
        """Select by a mask or an index array."""
        return Candidates(self.pixels[kept], self.scan[kept], self.gradient[kept])


@kernel
def _find_rises(
    picture: Float32Array,
    threshold: float,
    least_rise: float,
    row_step: int,
    places: FloatArray,
    directions: IntArray,
) -> int:
    """Find rises along rows (row_step 0) or columns (1), both ways; return their number."""
    height, width = picture.shape
    dy, dx = row_step, 1 - row_step
    forward = 2 * row_step
    count = 0
    first, last = RUN_PX * dx, width - RUN_PX * dx
    crosses = np.empty(last - first + 8, np.uint8)
    eight = crosses[: 8 * (crosses.size // 8)].view(np.uint64)
    for y in range(RUN_PX * dy, height - RUN_PX * dy):
        here, there = picture[y, first:last], picture[y + dy, first + dx : last + dx]
        # a loop of its own, of no branches: the processor takes many pixels at once
        for k in range(last - first):
            crosses[k] = (here[k] < threshold) != (there[k] < threshold)
        crosses[last - first :] = 0
        for block in range(eight.size):
            if eight[block] == 0:
                continue
            for x in range(first + 8 * block, first + 8 * block + 8):
                if crosses[x - first] == 0:
                    continue
                up = picture[y, x] < threshold
                # `step` walks from the dark pixel of the pair to the bright one
                step = 1 if up else -1
                y0, x0 = (y, x) if up else (y + dy, x + dx)
                # asked so that pixels without a value, NaN, are neither dark nor bright
                clean = True
                for k in range(RUN_PX):
                    dark = picture[y0 - k * step * dy, x0 - k * step * dx]
                    lit = picture[y0 + (k + 1) * step * dy, x0 + (k + 1) * step * dx]
                    if not (dark < threshold and lit >= threshold):
                        clean = False
                        break
                if not clean:
                    continue
                far = picture[y0 + 3 * step * dy, x0 + 3 * step * dx]
                if not far - picture[y0 - step * dy, x0 - step * dx] >= least_rise:
                    continue
                if count == places.shape[0]:
                    return count
                low, high = picture[y0, x0], picture[y0 + step * dy, x0 + step * dx]
                part = (threshold - low) / (high - low)
                places[count, 0] = x0 + part * step * dx
                places[count, 1] = y0 + part * step * dy
                directions[count] = forward + (0 if up else 1)
                count += 1
    return count


@kernel
def _compute_gradients(picture: Float32Array, places: FloatArray, gradients: FloatArray) -> None:
    """Brightness gradient by differences three pixels apart, averaged over five lines."""
    height, width = picture.shape
    for i in range(places.shape[0]):
        x = min(max(round(places[i, 0]), 2), width - 3)
        y = min(max(round(places[i, 1]), 2), height - 3)
        gx, gy = 0.0, 0.0
        for k in range(-2, 3):
            gx += picture[y + k, x + 2] - picture[y + k, x - 2]
            gx += picture[y + k, x + 1] - picture[y + k, x - 1]
            gy += picture[y + 2, x + k] - picture[y - 2, x + k]
            gy += picture[y + 1, x + k] - picture[y - 1, x + k]
        gradients[i, 0], gradients[i, 1] = gx / 30.0, gy / 30.0


def scan_edges(picture: Float32Array, threshold: float, least_rise: float) -> Candidates:
    """Rises of a picture (h, w) through a threshold that gain least_rise within four pixels.

    None reaches over pixels without a value, which are NaN.
    """
    picture = np.ascontiguousarray(picture, dtype=np.float32)
    scans = []
    for row_step in (0, 1):
        room, ways = np.empty((MAX_CANDIDATES, 2)), np.empty(MAX_CANDIDATES, dtype=np.int64)
        count = _find_rises(picture, threshold, least_rise, row_step, room, ways)
        scans.append((room[:count], ways[:count]))
    pixels, directions = (np.concatenate(parts) for parts in zip(*scans, strict=True))
    gradient = np.empty_like(pixels)
    _compute_gradients(picture, pixels, gradient)
    # Unit vectors of the four scan directions.
    rises = Candidates(
        pixels, np.array(((1, 0), (-1, 0), (0, 1), (0, -1)), dtype=np.float64)[directions], gradient
    )
    # no gradient beside pixels without a value
    known = np.isfinite(gradient).all(axis=1)
    return rises if known.all() else rises.subset(known)


MIN_BLOB_PIXELS = 25  # a star, even a bright one through a wide blur, is smaller
BORDER_PX = 4  # from the picture's edge and the image circle: no rise there is a limb
SKY_STEPS_PX = (6.0, 12.0, 24.0, 48.0)  # outside the limb there is no ground


def find_candidates(
    picture: Float32Array, camera: Camera, levels: Levels, blobs: Blobs
) -> Candidates:
    """Rises at the rim of lit areas that are larger than stars, inside the lens's picture."""
    # A limb gains 10 % of the lit ground's level within four pixels, a terminator less; the rise
    # must also stand 6 sigmas out of the noise.
    rise = max(6.0 * levels.noise, 0.10 * (levels.bright - levels.sky))
    edges = scan_edges(picture, levels.threshold, rise)
    lit = np.rint(edges.pixels + 1.5 * edges.scan).astype(np.int64)
    label = blobs.labels[lit[:, 1], lit[:, 0]]
    large = np.zeros(int(blobs.labels.max()) + 1, dtype=bool)
    large[blobs.label[blobs.area >= MIN_BLOB_PIXELS]] = True
    kept = large[label] & camera.contains(edges.pixels, BORDER_PX)
    if camera.image_circle_radius_px is not None:
        kept &= camera.radius_px(edges.pixels) < camera.image_circle_radius_px - BORDER_PX
    return edges.subset(kept)


def compute_outward_normals(
    where: PixelRays, gradient: FloatArray, stretch: FloatArray
) -> FloatArray:
    """Surface normals (n, 3), camera frame, if rises with these gradients (n, 2) are limbs.

    At a limb the ray touches the surface, so the normal is square to the ray and, in the picture,
    against the rise: with brightness as a function of direction it is its falling gradient.
    """
    # by_x, by_y span the picture's tangent plane; the gradient there by its reciprocal basis
    xx = (where.by_x**2).sum(axis=1)
    xy = (where.by_x * where.by_y).sum(axis=1)
    yy = (where.by_y**2).sum(axis=1)
    determinant = xx * yy - xy * xy
    u = (yy * gradient[:, 0] - xy * gradient[:, 1]) / determinant
    v = (xx * gradient[:, 1] - xy * gradient[:, 0]) / determinant
    rising = where.by_x * u[:, None] + where.by_y * v[:, None]
    # a normal is a covector: back from the stretched space by the transpose
    normal: FloatArray = -rising @ stretch
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    return normal


def is_sunlit(
    where: PixelRays, gradient: FloatArray, stretch: FloatArray, sun_camera: FloatArray
) -> BoolArray:
    """Whether the Sun can light each rise (n,) as a limb; terminators face away from it."""
    cosine = compute_outward_normals(where, gradient, stretch) @ sun_camera
    towards = np.linalg.solve(stretch, where.rays.T).T @ sun_camera
    sine = np.sqrt(np.maximum(1.0 - (towards * np.linalg.norm(stretch, 2)) ** 2, 0.0))
    # Below a cosine of incidence of 0.03 the edge is half terminator. At larger phases the cusps
    # have the terminator close by in each profile; they are left out up to 0.1.
    return cosine > 0.03 + 0.07 * sine


def measure_sharpness(picture: Float32Array, candidates: Candidates) -> FloatArray:
    """Measure the share of a rise (n,) that is reached after three pixels of ten.

    About 1 at a limb, a third at a terminator, whose brightness grows evenly.
    """
    near = _sample(picture, candidates.pixels + 3.0 * candidates.scan)
    far = _sample(picture, candidates.pixels + 10.0 * candidates.scan)
    before = _sample(picture, candidates.pixels - 3.0 * candidates.scan)
    return (near - before) / np.maximum(far - before, 1e-3)


def select_limb_candidates(
    candidates: Candidates, where: PixelRays, cone: Cone, relief: float
) -> tuple[Candidates, PixelRays]:
    """Candidates on a cone's curve: rising inward, scanned within 45 deg of it.

    Of several on one row or column the outermost is the limb: ridges and shadows lie behind it.
    """
    near = find_agreeing(cone, where, candidates.gradient, relief)
    distance, inward = measure_distances(cone, where)
    # a point on a diagonal is found by its row and by its column: the nearer direction keeps it
    near &= (candidates.scan * inward).sum(axis=1) > np.cos(np.radians(45.0))
    index = np.flatnonzero(near)
    along_row = candidates.scan[index, 0] != 0.0
    line = np.where(along_row, candidates.pixels[index, 1], candidates.pixels[index, 0])
    way = candidates.scan[index].sum(axis=1) + 4.0 * along_row
    order = np.lexsort((distance[index], line, way))
    first = np.ones(len(order), dtype=bool)
    first[1:] = (np.diff(line[order]) != 0.0) | (np.diff(way[order]) != 0.0)
    # a line may cross the curve twice in one direction only far apart, on a lens that bends it
    crossings = candidates.pixels[index[order]]
    first[1:] |= np.linalg.norm(np.diff(crossings, axis=0), axis=1) > 30.0
    kept = np.sort(index[order[first]])
    chosen = candidates.subset(kept)
    return chosen, where.subset(kept)


def is_bounded_by_sky(
    picture: Float32Array,
    camera: Camera,
    pixels: FloatArray,
    gradient: FloatArray,
    threshold: float,
) -> BoolArray:
    """Whether each rise (n,) at pixels (n, 2) has mostly sky and no lit ground on its dark side.

    Outside the picture and where there is no value nothing is known, which counts as sky.
    """
    inward = gradient / np.maximum(np.linalg.norm(gradient, axis=1, keepdims=True), 1e-12)
    dark = np.zeros(len(pixels))
    for step in SKY_STEPS_PX:
        places = pixels - step * inward
        dark += ~(_sample(picture, places) >= threshold) | ~camera.contains(places)
    return dark >= len(SKY_STEPS_PX) - 1


def _sample(picture: Float32Array, pixels: FloatArray) -> FloatArray:
    """Values at the nearest pixels (n, 2), those outside taken from the picture's edge."""
    height, width = picture.shape
    rounded = np.nan_to_num(np.rint(pixels)).astype(np.int64)
    x, y = np.clip(rounded[:, 0], 0, width - 1), np.clip(rounded[:, 1], 0, height - 1)
    return picture[y, x].astype(np.float64)
