"""Which stars the spots of a picture are, and the attitude that shows them so.

Three bright spots have the angles of three stars: two angles list pairs of stars, joined on the
common one; the third angle and the sense of the triple decide, with one scale for all three angles,
since a lens is known to a per cent. Each such triple gives an attitude (Wahba's problem), under
which the catalog's stars are counted among the spots. It stands when chance, over all triples that
were tried, would have given as many so rarely.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import islice

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from scipy.special import bdtrc

from catalog.arrays import FloatArray, IntArray
from catalog.bodies.stars import (
    BrightStars,
    list_star_pairs,
    load_bright_stars,
)
from catalog.errors import NoSolutionError
from catalog.geometry.rotations import cross_matrix
from catalog.geometry.vectors import angle_between
from optnav_cli.camera.camera import Camera
from optnav_cli.reasons import ReasonCode, describe_length
from optnav_cli.stars.spots import StarSpots, list_compact_triples, list_triples

MAX_PAIR_DEG = 25.0
WANTED_IN_VIEW = 30.0  # stars of the catalog in a frame, as far as it goes so faint
MIN_STARS = 4
MAX_TRIPLES, MAX_TRIED = 220, 1500
SCALE_ERROR = 0.012  # of the focal length, unless the camera file states more
MAX_SCALE_OFF = 0.02  # beyond which a lens counts as another one than the camera file's
# Of a failed picture few triples are tried with other lenses, to say what is wrong.
FEW_TRIPLES, WRONG_FACTORS = 30, (0.95, 1.05, 0.975, 1.025, 0.925, 1.075, 0.9, 1.1)
SPOT_PX = 0.5  # of a spot against its star, for the angles of a triple; distortion is in the lens
MATCH_PX = 2.5
MAX_RMS_PX = 0.7  # a coordinate; places that fill a gate of 2.5 px evenly have 1.25
MAX_COARSE_CHANCE = 1e-3  # of a triple's matches before they are refined
MAX_CHANCE = 1e-5  # expected false attitudes of a picture
SKY_SQUARE_DEG = 41_253.0
# A catalog so large is indexed; its triples of equal angles are many, and sifted at once.
LARGE_CATALOG, MANY_TRIPLES, MANY_TRIED, WIDE_GATE = 20_000, 80, 50_000, 1.6
COMPACT = 0.4  # of a field's diagonal: two sides of a triple are looked up, so long at most
MIN_LARGE_SIDE_PX = 80.0  # shorter sides have the angles of too many triples
MAX_PAIRS = 20_000_000  # of stars, half a gigabyte: 250,000 stars in fields of 2 deg
MAX_STEPS = 6
GATE_SIGMAS = 4.0  # of a match's distance from its star
K1_STARS, SCALE_STARS = 15, 6
FLOOR_PX = 0.03  # of a centroid, by what its model leaves out
PRIOR_K1 = 0.05


@dataclass(frozen=True, eq=False)
class StarFix:
    """An attitude from stars.

    camera_from_sky  from the axes of the given directions to the camera's
    covariance       (3, 3) of a rotation vector in the camera frame, rad^2
    spots, stars     (n,) matched ones, by index; used (n,) those that the attitude rests on
    predicted_px     (n, 2) where the attitude and lens put these stars
    focal_scale      of the lens, against its file; 1 where it is not solved for
    chance           expected number of attitudes that chance gives so well
    """

    camera_from_sky: Rotation
    covariance: FloatArray
    spots: IntArray
    stars: IntArray
    used: FloatArray
    predicted_px: FloatArray
    residuals_px: FloatArray
    focal_scale: float
    chance: float

    @property
    def residual_rms_px(self) -> float:
        """Root mean square of the residuals of the stars used, per coordinate."""
        some = self.residuals_px[self.used > 0.0]
        return float(np.sqrt((some**2).mean()))


@dataclass(frozen=True, eq=False)
class StarIdentifier:
    """Identification of stars in pictures of one camera.

    directions  (n, 3) of the catalog's stars as the camera sees them, the brightest first
    catalog     the stars themselves
    """

    camera: Camera
    directions: FloatArray
    catalog: BrightStars = field(default_factory=load_bright_stars)

    def identify(self, spots: StarSpots) -> StarFix:
        """Find the attitude under which the spots are stars.

        Raises NoSolutionError where there are too few spots or no attitude stands against chance;
        it says where the mirrored picture, or a lens some per cent off, would give one.
        """
        fit_of_stars = self.attempt(spots)
        off = max(MAX_SCALE_OFF, 3.0 * self.camera.focal_length_error)
        if fit_of_stars is not None and abs(fit_of_stars.focal_scale - 1.0) > off:
            raise _explain_wrong_lens(fit_of_stars.focal_scale)
        if fit_of_stars is not None:
            return fit_of_stars
        if len(spots) < MIN_STARS or spots.n_trails > len(spots):
            raise NoSolutionError(_explain_too_few(spots), ReasonCode.FEW_STARS)
        mirrored = replace(
            spots, pixels=np.array([self.camera.width_px - 1, 0.0]) - spots.pixels * [1.0, -1.0]
        )
        if self._identify(mirrored, FEW_TRIPLES) is not None:
            text = "the picture is mirrored: its stars fit the sky seen in a mirror"
            raise NoSolutionError(text, ReasonCode.MIRRORED)
        for factor in WRONG_FACTORS:
            other = replace(self, camera=self.camera.with_focal_factor(factor))
            fit = other._identify(spots, FEW_TRIPLES)
            if fit is not None:
                raise _explain_wrong_lens(factor * fit.focal_scale)
        raise NoSolutionError(
            f"{len(spots)} spots are no stars of the catalog, or too few of them"
            f"{spots.describe_rejects()}",
            ReasonCode.NO_STARS,
        )

    def attempt(self, spots: StarSpots) -> StarFix | None:
        """Find the attitude without a look at why there is none."""
        return self._identify(spots, MAX_TRIPLES)

    def _identify(self, spots: StarSpots, most: int) -> StarFix | None:
        """Find the attitude by the first so many triples; None without one."""
        if len(spots) < MIN_STARS:
            return None
        rays = self.camera.unproject(spots.pixels)
        seen = np.flatnonzero(np.isfinite(rays).all(axis=1))
        tried, last = 0, MAX_TRIED
        triples = list_triples(seen, rays, self._compute_widest_angle())
        if self._is_large:
            most, last = min(most, MANY_TRIPLES), MANY_TRIED
            shortest = MIN_LARGE_SIDE_PX / self.camera.focal_length_px
            triples = list_compact_triples(seen, rays, shortest, self._compute_pair_reach())
        for three in islice(triples, most):
            candidates = self._find_candidates(rays[list(three)])
            for number in self._select_promising(spots, rays, three, candidates):
                fit = self._verify(spots, rays, three, candidates[number], tried + number + 1)
                if fit is not None:
                    return fit
                if tried + number + 1 >= last:
                    return None
            tried += len(candidates)
            if tried >= last:
                return None
        return None

    @property
    def _is_large(self) -> bool:
        """Whether the catalog has so many stars that a triple fits many of its own by chance."""
        return len(self.directions) > LARGE_CATALOG

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.directions)

    def _select_promising(
        self, spots: StarSpots, rays: FloatArray, three: tuple[int, ...], candidates: list[IntArray]
    ) -> IntArray:
        """Select the candidates under which as many other spots are stars as it takes.

        All of them with a small catalog. With a large one every other spot is looked up in the sky
        by the attitude of each triple at once, in a gate wider than that of the matches.
        """
        if not self._is_large or not candidates:
            return np.arange(len(candidates))
        others = np.setdiff1d(np.flatnonzero(np.isfinite(rays).all(axis=1)), three)
        stars = np.array(candidates)
        u, _, vt = np.linalg.svd(
            np.einsum("ia,mib->mab", rays[list(three)], self.directions[stars])
        )
        u[:, :, 2] *= np.linalg.det(u @ vt)[:, None]
        scales = np.array([self._estimate_scale(rays[list(three)], row) for row in stars])
        straight = np.repeat(rays[others][None], len(stars), axis=0)
        straight[:, :, 2] *= scales[:, None]
        sky = straight @ (u @ vt)
        sky /= np.linalg.norm(sky, axis=2, keepdims=True)
        gate = WIDE_GATE * 2.0 * MATCH_PX / self.camera.focal_length_px
        distances, _ = self._tree.query(sky, distance_upper_bound=gate)
        wanted = self._count_needed(len(spots)) - 3
        return np.flatnonzero(np.isfinite(distances).sum(axis=1) >= wanted)

    def _count_needed(self, spots: int) -> int:
        """Count the matches needed to stand against chance where the sky is half as full."""
        camera = self.camera
        area = camera.width_px * camera.height_px * np.degrees(camera.angular_resolution) ** 2
        in_view = max(round(0.5 * len(self.directions) * area / SKY_SQUARE_DEG), 1)
        agreeing = MIN_STARS
        while agreeing < spots and (
            self._estimate_chance(spots, agreeing, in_view, MATCH_PX) >= MAX_CHANCE
        ):
            agreeing += 1
        return agreeing

    def _count_in_view(self) -> int:
        """Count the brightest stars of the catalog to search, so that a frame shows enough."""
        camera = self.camera
        area = camera.width_px * camera.height_px * np.degrees(camera.angular_resolution) ** 2
        wanted = WANTED_IN_VIEW * SKY_SQUARE_DEG / min(area, SKY_SQUARE_DEG / 2.0)
        # so many stars have MAX_PAIRS within the widest angle
        share = np.pi * np.degrees(self._compute_pair_reach()) ** 2 / SKY_SQUARE_DEG
        affordable = np.sqrt(2.0 * MAX_PAIRS / share)
        return int(np.clip(min(wanted, affordable), 300, max(len(self.directions), 300)))

    def _compute_widest_angle(self) -> float:
        half = np.hypot(self.camera.width_px, self.camera.height_px) / 2.0
        across = 2.0 * np.arctan(half / self.camera.coarse_focal_px)
        return float(min(across * 1.05, np.radians(MAX_PAIR_DEG)))

    def _compute_pair_reach(self) -> float:
        """Compute the widest angle between two stars that are looked up as a pair."""
        return self._compute_widest_angle() * (COMPACT if self._is_large else 1.0)

    def _find_candidates(self, rays: FloatArray) -> list[IntArray]:
        """Find triples of stars (3,) with the angles and the sense of three rays (3, 3)."""
        pairs = list_star_pairs(
            self.catalog, self._count_in_view(), round(self._compute_pair_reach(), 6)
        )
        ab, ac, bc = angle_between(rays[[0, 0, 1]], rays[[1, 2, 2]]).tolist()
        if (
            max(ab, ac, bc) > self._compute_widest_angle()
            or min(ab, ac, bc) < 10.0 / self.camera.focal_length_px
        ):
            return []
        noise = SPOT_PX * np.sqrt(2.0) / self.camera.focal_length_px
        error = max(SCALE_ERROR, 3.0 * self.camera.focal_length_error)
        first, second = pairs.select_near(ab, error * ab + 2.0 * noise)
        common, third = pairs.select_near(ac, error * ac + 2.0 * noise)
        order = np.argsort(common, kind="stable")
        common, third = common[order], third[order]
        low, high = np.searchsorted(common, first), np.searchsorted(common, first, side="right")
        repeats = high - low
        if not repeats.sum():
            return []
        index = np.repeat(np.arange(len(first)), repeats)
        offset = np.arange(repeats.sum()) - np.repeat(np.cumsum(repeats) - repeats, repeats)
        a, b, c = first[index], second[index], third[low[index] + offset]
        stars = self.directions
        scales = [
            _compute_angles(stars[p], stars[q]) / angle
            for p, q, angle in ((a, b, ab), (a, c, ac), (b, c, bc))
        ]
        off = [
            np.abs(first_scale - second_scale) < 2.0 * noise * np.hypot(1.0 / x, 1.0 / y)
            for first_scale, second_scale, x, y in (
                (scales[0], scales[1], ab, ac),
                (scales[1], scales[2], ac, bc),
                (scales[0], scales[2], ab, bc),
            )
        ]
        sense = np.sign(np.linalg.det(rays))
        volume = np.einsum("ni,ni->n", stars[a], np.cross(stars[b], stars[c]))
        good = off[0] & off[1] & off[2] & (np.sign(volume) == sense) & (b != c)
        worst = np.abs(scales[0] - 1.0) + np.abs(scales[1] - 1.0) + np.abs(scales[2] - 1.0)
        chosen = np.flatnonzero(good)
        chosen = chosen[np.argsort(worst[chosen], kind="stable")]
        return [np.array([a[i], b[i], c[i]]) for i in chosen]

    def _verify(
        self,
        spots: StarSpots,
        rays: FloatArray,
        three: tuple[int, ...],
        stars: IntArray,
        tried: int,
    ) -> StarFix | None:
        """Refine the attitude of a triple; None where chance explains it."""
        turn = solve_wahba(rays[list(three)], self.directions[stars])
        scale = self._estimate_scale(rays[list(three)], stars)
        match = self._match(spots, turn, scale, 0.0, 2.0 * MATCH_PX)
        if len(match[0]) < MIN_STARS:
            return None
        in_view = self._select_in_view(turn)[0].size
        if (
            self._estimate_chance(len(spots), len(match[0]), in_view, 2.0 * MATCH_PX)
            > MAX_COARSE_CHANCE
        ):
            return None
        fit = self._refine(spots, turn, scale, match)
        # matches by chance fill the gate evenly; so do those of an attitude near the right one
        if fit is None or fit.residual_rms_px > MAX_RMS_PX:
            return None
        chance = tried * self._estimate_chance(len(spots), int(fit.used.sum()), in_view, MATCH_PX)
        return replace(fit, chance=chance) if chance < MAX_CHANCE else None

    def _estimate_chance(self, spots: int, agreeing: int, in_view: int, gate_px: float) -> float:
        """Estimate how probably random spots agree so with an attitude that three of them gave."""
        if agreeing < MIN_STARS:
            return 1.0
        area = self.camera.width_px * self.camera.height_px
        share = min(in_view * np.pi * gate_px**2 / area, 1.0)
        return float(bdtrc(agreeing - 4, spots - 3, share))

    def _estimate_scale(self, rays: FloatArray, stars: IntArray) -> float:
        """Estimate the focal length's factor that the angles of a triple ask for."""
        sky = self.directions[stars]
        ours, theirs = (
            _compute_angles(directions, np.roll(directions, 1, axis=0)).sum()
            for directions in (rays, sky)
        )
        return float(ours / theirs)

    def _select_in_view(self, turn: Rotation) -> tuple[IntArray, FloatArray]:
        """Select stars in the picture, with their pixels (n, 2) by the stated lens."""
        axis = turn.inv().apply((0.0, 0.0, 1.0))
        half = np.hypot(self.camera.width_px, self.camera.height_px) / 2.0
        reach = min(float(np.arctan(half / self.camera.coarse_focal_px)) * 1.3, np.pi)
        near = np.flatnonzero(self.directions @ axis > np.cos(reach))
        pixels = self.camera.project(turn.apply(self.directions[near]))
        seen = np.flatnonzero(np.isfinite(pixels).all(axis=1))
        seen = seen[self.camera.contains(pixels[seen])]
        return near[seen], pixels[seen]

    def _project(
        self, stars: IntArray, turn: Rotation, scale: float, k1: float
    ) -> tuple[FloatArray, FloatArray]:
        """Project stars through a lens longer by a factor and with k1.
        5) by a rotation vector, the factor and k1."""
        camera = self.camera
        points = turn.apply(self.directions[stars])
        pixels, by_point = camera.project_with_jacobian(points)
        middle = np.array(camera.principal_point_px)
        out = pixels - middle
        squared = ((out / camera.focal_length_px) ** 2).sum(axis=1)[:, None]
        bent = scale * (1.0 + k1 * squared)
        by_turn = -by_point @ cross_matrix(points) * bent[:, :, None]
        columns = [by_turn, (out * (1.0 + k1 * squared))[:, :, None]]
        columns.append((out * scale * squared)[:, :, None])
        return middle + bent * out, np.concatenate(columns, axis=2)

    def _match(
        self, spots: StarSpots, turn: Rotation, scale: float, k1: float, gate_px: float
    ) -> tuple[IntArray, IntArray]:
        """Match spots and stars that are each other's nearest within a gate."""
        stars, pixels = self._select_in_view(turn)
        if not stars.size:
            return np.empty(0, np.int64), np.empty(0, np.int64)
        out = pixels - self.camera.principal_point_px
        squared = ((out / self.camera.focal_length_px) ** 2).sum(axis=1, keepdims=True)
        pixels = self.camera.principal_point_px + scale * (1.0 + k1 * squared) * out
        distances, nearest = cKDTree(pixels).query(spots.pixels, distance_upper_bound=gate_px)
        ours = np.flatnonzero(np.isfinite(distances))
        order = ours[np.argsort(distances[ours], kind="stable")]
        _, first = np.unique(nearest[order], return_index=True)
        kept = np.sort(order[first])
        return kept, stars[nearest[kept]]

    def _refine(
        self, spots: StarSpots, turn: Rotation, scale: float, match: tuple[IntArray, IntArray]
    ) -> StarFix | None:
        """Refine the rotation, and with enough stars the lens, by robust least squares."""
        k1 = 0.0
        prior = max(SCALE_ERROR, self.camera.focal_length_error)
        for step in range(MAX_STEPS):
            ours, stars = match
            if len(ours) < MIN_STARS:
                return None
            pixels, jacobian = self._project(stars, turn, scale, k1)
            residuals = spots.pixels[ours] - pixels
            size = np.linalg.norm(residuals, axis=1)
            noise = np.hypot(spots.sigma_px[ours], FLOOR_PX)
            spread = max(1.4826 * float(np.median(size / noise)) / 1.55, 1.0)
            # a gate, not a bell: weights below 1 would make the scatter look smaller than it is
            weights = (size < GATE_SIGMAS * spread * noise).astype(np.float64)
            if (weights > 0.0).sum() < MIN_STARS:
                return None
            solved = [0, 1, 2]
            solved += [3] if len(ours) >= SCALE_STARS else []
            solved += [4] if len(ours) >= K1_STARS else []
            rows = (jacobian[:, :, solved] * np.sqrt(weights / noise**2)[:, None, None]).reshape(
                -1, len(solved)
            )
            right = (residuals * np.sqrt(weights / noise**2)[:, None]).ravel()
            normal = rows.T @ rows
            known = np.array([np.inf, np.inf, np.inf, prior, PRIOR_K1])[solved]
            normal += np.diag(spread**-2 * known**-2.0)
            expected = np.array([0.0, 0.0, 0.0, 1.0 - scale, -k1])[solved]
            gradient = rows.T @ right + spread**-2 * known**-2.0 * expected
            move = np.zeros(5)
            move[solved] = np.linalg.solve(normal, gradient)
            turn = Rotation.from_rotvec(move[:3]) * turn
            scale, k1 = scale + float(move[3]), k1 + float(move[4])
            last = step == MAX_STEPS - 1 or float(np.abs(move[:3]).max()) < 1e-9
            if last:
                break
            match = self._match(spots, turn, scale, k1, MATCH_PX)
        pixels, _ = self._project(stars, turn, scale, k1)
        used = weights
        freedom = max(2.0 * float(used.sum()) - len(solved), 1.0)
        squares = float((weights * (size / noise) ** 2).sum()) / freedom
        # few stars say little of their own scatter: the stated one counts as eight numbers
        factor = max((squares * freedom + 8.0) / (freedom + 8.0), 0.5)
        covariance = np.linalg.inv(normal)[:3, :3] * factor
        return StarFix(
            turn, covariance, ours, stars, used, pixels, spots.pixels[ours] - pixels, scale, 1.0
        )


def solve_wahba(ours: FloatArray, theirs: FloatArray) -> Rotation:
    """Rotate directions (n, 3) nearest to ours (n, 3), by Markley's SVD (1988)."""
    u, _, vt = np.linalg.svd(ours.T @ theirs)
    return Rotation.from_matrix(u @ np.diag([1.0, 1.0, np.linalg.det(u) * np.linalg.det(vt)]) @ vt)


def _compute_angles(a: FloatArray, b: FloatArray) -> FloatArray:
    angles: FloatArray = 2.0 * np.arcsin(np.minimum(np.linalg.norm(a - b, axis=1) / 2.0, 1.0))
    return angles


def _explain_wrong_lens(scale: float) -> NoSolutionError:
    text = f"the focal length is wrong: the stars fit one {describe_length(scale - 1.0)}"
    return NoSolutionError(text, ReasonCode.WRONG_LENS)


def _explain_too_few(spots: StarSpots) -> str:
    if len(spots) >= MIN_STARS:
        return f"most spots are no points, {len(spots)} are{spots.describe_rejects()}"
    seen = "1 spot is" if len(spots) == 1 else f"{len(spots)} spots are"
    return f"{seen} fewer than the {MIN_STARS} stars wanted{spots.describe_rejects()}"
