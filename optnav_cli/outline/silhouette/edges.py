"""The drawn silhouette of a shape: where its occluding edges stand, and where a picture shows them.

Ours. The shape is traced on a grid of pixels. Edges are where it ends before the sky (outer ones)
and where near ground hides far ground (inner ones). Only edges of sunlit ground before something
dark count: so the side of the terminator is left out, and shadows that fall across the shape too.
"""

from typing import NamedTuple

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import BoolArray, Float32Array, FloatArray, IndexArray
from catalog.photometry.sets import HapkeParameters
from catalog.rendering.mesh_scene import LIFT, select_sunward, shade_faces
from catalog.terrain.mesh.rays import MeshRays
from optnav_cli.camera.camera import Camera

INSIDE, OUTSIDE = (2.0, 3.5), (2.0, 3.0)  # steps from an edge where light and dark are looked at
MIN_LIGHT = 0.25  # of the middle brightness: darker ground makes no edge to rely on
PROFILE_STEP = 0.5  # px
LEVEL_PX = (1.0, 4.0)  # beside an edge, where its two levels are measured
# Pieces of the drawn light that are matched, steps of the grid, and when one is taken.
PIECE, PIECE_STEP, BLUR = 12, 8, 1.0
MIN_LIT, MIN_CONTRAST, MIN_SCORE = 0.6, 0.12, 0.65


class LitShape(NamedTuple):
    """A shape and Hapke's parameters of its ground."""

    mesh: MeshRays
    surface: HapkeParameters

    @property
    def reach_m(self) -> float:
        """Largest distance of its ground from the centre, m."""
        return self.mesh.reach_m


class DrawnShape(NamedTuple):
    """A shape as it should look, on a grid of pixels, and its edges.

    pixels   (rows, cols, 2) of the grid;  light (rows, cols) brightness, 0 in shadow and sky
    step     pixels between nodes
    surface  (rows, cols, 3) m, body frame, of the ground that is seen; not finite in the sky
    edges    (n, 2) px of edge points;  outward (n, 2) unit, from the ground that ends there
    places   (n, 3) m, body frame, of that ground;  outer (n,) whether sky is behind
    """

    pixels: FloatArray
    light: Float32Array
    step: float
    surface: FloatArray
    edges: FloatArray
    outward: FloatArray
    places: FloatArray
    outer: BoolArray


def draw_shape(
    ground: LitShape,
    camera: Camera,
    camera_from_body: Rotation,
    position: FloatArray,
    sun_body: FloatArray,
    box: tuple[float, float, float],
    nodes: int,
) -> DrawnShape:
    """Trace a shape from a position (3,) m about a place of the picture.

    box    centre x, y and half a side, px;  nodes  a side of the grid
    """
    x, y, half = box
    mesh = ground.mesh
    step = 2.0 * half / (nodes - 1)
    offsets = (np.arange(nodes) - (nodes - 1) / 2.0) * step
    pixels = np.stack(np.meshgrid(x + offsets, y + offsets), axis=-1)
    rays = camera.unproject(pixels.reshape(-1, 2))
    seen: BoolArray = np.asarray(np.isfinite(rays).all(axis=1))
    rays = np.ascontiguousarray(np.where(seen[:, None], rays, 0.0) @ camera_from_body.as_matrix())
    faces, depth = mesh.find_first_hits(position, rays)
    faces[~seen] = -1
    lift = LIFT * mesh.reach_m
    numbers, starts = select_sunward(mesh.corners, faces, position, rays, depth, sun_body, lift)
    flat = np.zeros(len(rays), np.float32)
    lit = numbers[~mesh.are_blocked(starts, sun_body)]
    shade_faces(mesh.corners, faces, rays, lit, sun_body, ground.surface, flat)
    shown: BoolArray = (faces >= 0).reshape(nodes, nodes)
    light = flat.reshape(nodes, nodes)
    distance = np.where(shown, depth.reshape(nodes, nodes), np.inf)
    rows, cols, shift, outward, outer = _find_drawn_edges(
        shown, distance, light, step / camera.focal_length_px
    )
    at = rows * nodes + cols
    places = position + depth[at, None] * rays[at]
    edges = pixels[rows, cols] + step * shift
    met = np.where(np.isfinite(depth), depth, np.nan)
    surface = (position + met[:, None] * rays).reshape(nodes, nodes, 3)
    return DrawnShape(pixels, light, step, surface, edges, outward, places, outer)


def _find_drawn_edges(
    ground: BoolArray, distance: FloatArray, light: Float32Array, angle: float
) -> tuple[IndexArray, IndexArray, FloatArray, FloatArray, BoolArray]:
    """Find edge nodes: rows, columns, shifts (n, 2), outward directions, which are outer.

    angle  of a step of the grid, rad
    """
    nearest = float(distance.min(initial=np.inf))
    if not np.isfinite(nearest):
        none, two = np.empty(0, np.intp), np.empty((0, 2))
        return none, none, two, two, np.empty(0, bool)
    far = np.pad(distance, 1, constant_values=np.inf)
    around = np.maximum.reduce([far[:-2, 1:-1], far[2:, 1:-1], far[1:-1, :-2], far[1:-1, 2:]])
    # A jump in depth of 8 grid steps on the ground makes an inner edge.
    jump = 8.0 * angle * nearest
    is_edge = ground & (around > distance + jump)
    is_edge[[0, -1]] = is_edge[:, [0, -1]] = False
    is_edge[1], is_edge[-2], is_edge[:, 1], is_edge[:, -2] = False, False, False, False
    rows, cols = np.nonzero(is_edge)
    # near ground in the 5 x 5 nodes about each edge node: the edge runs across its lean
    window = np.arange(-2, 3)
    down, along = np.meshgrid(window, window, indexing="ij")
    about = distance[rows[:, None, None] + down, cols[:, None, None] + along]
    near = about < distance[rows, cols][:, None, None] + jump
    lean = np.stack([(near * along).sum(axis=(1, 2)), (near * down).sum(axis=(1, 2))], axis=1)
    length = np.linalg.norm(lean, axis=1)
    directed = length > 2.0  # thin spikes have no direction
    rows, cols, outward = rows[directed], cols[directed], -lean[directed] / length[directed, None]
    behind = np.isinf(np.where(near[directed], np.inf, about[directed]))
    outer: BoolArray = np.asarray(behind.all(axis=(1, 2)))
    shift = np.full((len(rows), 2), 0.5) * outward
    # The outline is smoothed over 1.2 grid steps to place it between pixels.
    smooth = cv2.GaussianBlur(ground.astype(np.float32), (0, 0), 1.2)
    slope = (
        np.stack(
            [cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1)], axis=-1
        )
        / 8.0
    )[rows, cols]
    square = np.maximum((slope**2).sum(axis=1), 1e-6)
    beside = -((smooth[rows, cols] - 0.5) / square)[:, None] * slope
    good = outer & (np.linalg.norm(beside, axis=1) < 1.5)
    shift[good] = beside[good]
    outward[good] = -slope[good] / np.sqrt(square[good])[:, None]
    start = np.stack([cols, rows], axis=1).astype(np.float64)

    def sample_light(steps: tuple[float, float], sign: float) -> FloatArray:
        values = [_sample(light, start + sign * far_off * outward) for far_off in steps]
        return np.array(values)

    inside, outside = sample_light(INSIDE, -1.0), sample_light(OUTSIDE, 1.0)
    bright = light[light > 0.0]
    middle = float(np.median(bright)) if bright.size else np.inf
    # Across an edge half of the brightness inside is lost.
    use: BoolArray = np.asarray(
        (inside.min(axis=0) > MIN_LIGHT * middle)
        & (outside.max(axis=0) < 0.5 * inside.mean(axis=0))
    )
    return rows[use], cols[use], shift[use], outward[use], outer[use]


def _sample(values: Float32Array, places: FloatArray) -> FloatArray:
    """Interpolate values (n,) at pixels (n, 2), x and y; beyond the border the nearest value."""
    x, y = (np.ascontiguousarray(places[:, k], np.float32)[None] for k in range(2))
    row = cv2.remap(values, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    sampled: FloatArray = row[0].astype(np.float64)
    return sampled


def find_edges(
    picture: Float32Array, drawn: DrawnShape, reach_px: float, sky: float, threshold: float
) -> FloatArray:
    """Measure how far (n,) outward of its drawn position each edge lies, px; NaN where unseen.

    picture  counts, blurred as a gradient wants it;  reach_px  searched on either side
    sky, threshold  counts of the sky, and above which a pixel is lit
    """
    n = len(drawn.edges)
    count = int(np.ceil(reach_px / PROFILE_STEP))
    room = int(LEVEL_PX[1] / PROFILE_STEP)
    offsets = np.arange(-count - room, count + room + 1) * PROFILE_STEP
    at = drawn.edges[:, None, :] + offsets[None, :, None] * drawn.outward[:, None, :]
    last = np.array([picture.shape[1] - 1.0, picture.shape[0] - 1.0])
    outside: BoolArray = np.asarray(((at < 0.0) | (at > last)).any(axis=2))
    profile = np.empty((n, offsets.size))
    rows = 8192  # remap takes no wider picture than 32767
    for first in range(0, n, rows):
        part = slice(first, first + rows)
        x, y = (np.ascontiguousarray(at[part, :, k], np.float32) for k in range(2))
        profile[part] = cv2.remap(picture, x, y, cv2.INTER_LINEAR)
    profile[outside] = np.nan
    least, most = (round(px / PROFILE_STEP) for px in LEVEL_PX)
    sums = np.cumsum(np.pad(profile, ((0, 0), (1, 0))), axis=1)
    middle = np.arange(room, offsets.size - room)
    width = most - least
    inside = (sums[:, middle - least + 1] - sums[:, middle - most + 1]) / width
    beyond = (sums[:, middle + most] - sums[:, middle + least]) / width
    fall = inside - beyond
    lit = inside > threshold
    # the last fall to the sky of an outer edge; of an inner one the greatest, nearer ones first
    strong = lit & (fall > 0.5 * (inside - sky)) & (beyond < threshold)
    distance = np.abs(offsets[middle]) / max(reach_px, 1.0)
    score = np.where(lit, fall * (1.0 - 0.5 * distance**2), -np.inf)
    top = np.nanmax(np.where(strong & drawn.outer[:, None], fall, np.nan), axis=1, initial=-np.inf)
    outermost = strong & (fall > 0.7 * top[:, None]) & drawn.outer[:, None]
    last = middle.size - 1 - outermost[:, ::-1].argmax(axis=1)
    greatest = np.where(np.isfinite(score), score, -np.inf).argmax(axis=1)
    chosen = np.where(drawn.outer, last, greatest)
    every = np.arange(n)
    has_edge = np.where(
        drawn.outer,
        outermost.any(axis=1),
        fall[every, chosen] > 0.3 * (inside[every, chosen] - sky),
    )
    level = np.asarray(0.5 * (inside[every, chosen] + beyond[every, chosen]), dtype=np.float64)
    steps = np.asarray(offsets, dtype=np.float64)
    return _find_crossings(profile, steps, middle[chosen], level, has_edge, most)


def _find_crossings(
    profile: FloatArray,
    offsets: FloatArray,
    chosen: IndexArray,
    level: FloatArray,
    has_edge: BoolArray,
    room: int,
) -> FloatArray:
    """Find where profiles (n, m) fall through levels (n,) nearest to chosen nodes (n,), or NaN."""
    best = np.full(len(profile), np.nan)
    steps_off = np.full(len(profile), np.inf)
    every = np.arange(len(profile))
    for k in range(-room, room):
        here, after = profile[every, chosen + k], profile[every, chosen + k + 1]
        through = has_edge & (here >= level) & (after < level) & (abs(k + 0.5) < steps_off)
        share = (here - level) / np.where(through, here - after, 1.0)
        best = np.where(through, offsets[chosen + k] + PROFILE_STEP * share, best)
        steps_off = np.where(through, abs(k + 0.5), steps_off)
    return best


def match_light(
    picture: Float32Array, drawn: DrawnShape, reach: int
) -> tuple[FloatArray, FloatArray]:
    """Match pieces of the shape: surface points (n, 3), m, and their offsets (n, 2), px.

    picture  counts;  reach  steps of the grid that each piece is searched to all sides

    What the shape hides or shades tells where it stands in depth, which its outline hardly does.
    """
    x, y = (np.ascontiguousarray(drawn.pixels[..., k], np.float32) for k in range(2))
    shown = cv2.GaussianBlur(cv2.remap(picture, x, y, cv2.INTER_LINEAR), (0, 0), 0.5)
    # a picture is blurred by its optics, a drawing is not
    wanted = cv2.GaussianBlur(drawn.light, (0, 0), BLUR)
    border = PIECE + reach
    middle = float(np.median(wanted[wanted > 0.0])) if (wanted > 0.0).any() else np.inf
    places, moves = [], []
    for row in range(border, len(wanted) - border, PIECE_STEP):
        for col in range(border, len(wanted) - border, PIECE_STEP):
            point = drawn.surface[row, col]
            piece = wanted[row - PIECE : row + PIECE + 1, col - PIECE : col + PIECE + 1]
            lit = (piece > MIN_LIGHT * middle).mean()
            if not np.isfinite(point).all() or lit < MIN_LIT:
                continue
            if piece.std() < MIN_CONTRAST * middle:
                continue
            window = shown[row - border : row + border + 1, col - border : col + border + 1]
            scores = cv2.matchTemplate(window, piece, cv2.TM_CCOEFF_NORMED)
            _, best, _, (u, v) = cv2.minMaxLoc(scores)
            if best < MIN_SCORE or not (0 < u < 2 * reach and 0 < v < 2 * reach):
                continue
            across = np.asarray(scores[v, u - 1 : u + 2], dtype=np.float64)
            down = np.asarray(scores[v - 1 : v + 2, u], dtype=np.float64)
            moves.append([u - reach + _find_vertex(across), v - reach + _find_vertex(down)])
            places.append(point)
    return np.reshape(places, (-1, 3)), drawn.step * np.reshape(moves, (-1, 2))


def _find_vertex(three: FloatArray) -> float:
    """Find the maximum of the parabola through three scores, the middle one the highest."""
    before, here, after = (float(value) for value in three)
    bend = before - 2.0 * here + after
    return 0.5 * (before - after) / bend if bend < 0.0 else 0.0
