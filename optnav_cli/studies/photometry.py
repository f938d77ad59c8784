"""How far Hapke's law and the Lommel-Seeliger law differ for a navigator, by emission angle.

Zhukov (2025), ch. 3, holds that the two differ insignificantly at emission below 60-70 degrees, so
that the on-board reference may use the simple law. Here the same real ground (Tycho, 118 m) is drawn
by both under the same Suns and views, cast shadows included. Two numbers tell: the correlation of
the high-passed pictures, which is what a matcher sees, and what remains of the Hapke picture after
the best gain and offset, as a share of its contrast. A third is what navigation feels: how far the
correlation peak of a template moves because of the law alone.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from catalog.bodies.body import load_body
from catalog.config import resource
from catalog.correlation.ncc import high_pass, match_ncc
from catalog.geometry.grid import sample_bicubic
from catalog.geometry.projection import Stereographic, node_grid
from catalog.progress import Progress
from catalog.rendering.map_view import render_map
from catalog.terrain.source import DemSettings, DemSource

HeightGrid = NDArray[np.float32]

DEM = "data/tycho_gld100_256ppd.tif"
POSTING_M = 118.45
SIZE = 480
TEMPLATE, MARGIN = 64, 6  # nodes; templates tile the ground, each searched this far about its place
EMISSIONS_DEG = (0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0, 70.0)
SUN_ELEVATIONS_DEG = (10.0, 25.0, 45.0)
SUN_AZIMUTH_DEG = 60.0
# from the Sun's side (no phase), across, and against the Sun (the greatest phase)
VIEW_AZIMUTHS_DEG = (0.0, 90.0, 180.0)
# A picture has a brightest and a darkest node; outside 2-98 % single facets decide.
LEAST_LIT = 0.5


@dataclass(frozen=True)
class PhotometryRow:
    """One emission angle; over Suns and views, the mean and the worst.

    correlation  of the high-passed Hapke and Lommel-Seeliger pictures: mean, least
    remainder    rms of Hapke less the gain-fitted other, over Hapke's contrast: mean, greatest
    shift        rms displacement of the templates' peaks, nodes: mean, greatest
    """

    emission_deg: float
    correlation: tuple[float, float]
    remainder: tuple[float, float]
    shift: tuple[float, float]


def run(progress: Progress) -> list[PhotometryRow]:
    """Draw the ground by both laws at every emission, Sun and view, and compare."""
    ground, radius = tycho_ground()
    rows = []
    with progress.stage("photometry", len(EMISSIONS_DEG), "emission angles") as bar:
        for emission in EMISSIONS_DEG:
            results = [
                compare(ground, radius, sun_elevation, emission, view_azimuth)
                for sun_elevation in SUN_ELEVATIONS_DEG
                for view_azimuth in (VIEW_AZIMUTHS_DEG if emission > 0.0 else (0.0,))
            ]
            correlation, remainder, shift = np.array(results).T
            rows.append(
                PhotometryRow(
                    emission,
                    (float(correlation.mean()), float(correlation.min())),
                    (float(remainder.mean()), float(remainder.max())),
                    (float(shift.mean()), float(shift.max())),
                )
            )
            bar.advance()
    return rows


def tycho_ground(size: int = SIZE) -> tuple[HeightGrid, float]:
    """A map grid in the middle of the bundled DEM, and the radius of its reference sphere."""
    body = load_body("moon")
    path = resource(DEM)
    source = DemSource.open(DemSettings(path=path.name), path.parent, body)
    west, south, east, north = source.latlon_bounds()
    place = Stereographic((south + north) / 2.0, (west + east) / 2.0, body.radius_m)
    x, y = node_grid(size, POSTING_M)
    col, row = source.pixel_from_latlon(*place.latlon(x, y))
    top, left = int(row.min()) - 2, int(col.min()) - 2
    window = source.read_window(
        top, left, int(row.max()) - top + 4, int(col.max()) - left + 4
    )
    return sample_bicubic(window, row - top, col - left), body.radius_m


def compare(
    ground: HeightGrid,
    radius_m: float,
    sun_elevation_deg: float,
    emission_deg: float,
    view_from_sun_deg: float,
) -> tuple[float, float, float]:
    """Correlation, remainder and rms shift between the two laws for one Sun and one view."""
    sun = _direction(sun_elevation_deg, SUN_AZIMUTH_DEG)
    view = _direction(90.0 - emission_deg, SUN_AZIMUTH_DEG + view_from_sun_deg)
    hapke, simple = (
        render_map(ground, POSTING_M, sun, radius_m=radius_m, view_local=view, law=law)
        for law in ("hapke", "lommel_seeliger")
    )
    sharp, sharp_simple = high_pass(hapke), high_pass(simple)
    correlation = float(np.corrcoef(sharp.ravel(), sharp_simple.ravel())[0, 1])
    lit = simple > 0.0
    gain, offset = np.polyfit(simple[lit].astype(np.float64), hapke[lit].astype(np.float64), 1)
    left = hapke[lit] - (gain * simple[lit] + offset)
    remainder = float(np.sqrt((left**2).mean()) / hapke[lit].std())
    return correlation, remainder, _rms_shift(hapke, simple)


def _rms_shift(picture: HeightGrid, reference: HeightGrid) -> float:
    """Rms displacement (nodes, both coordinates) of the reference's templates in the picture."""
    squares = []
    for top in range(MARGIN, picture.shape[0] - TEMPLATE - MARGIN + 1, TEMPLATE):
        for left in range(MARGIN, picture.shape[1] - TEMPLATE - MARGIN + 1, TEMPLATE):
            template = reference[top : top + TEMPLATE, left : left + TEMPLATE]
            if (template > 0.0).mean() < LEAST_LIT:
                continue
            search = picture[
                top - MARGIN : top + TEMPLATE + MARGIN, left - MARGIN : left + TEMPLATE + MARGIN
            ]
            match = match_ncc(template, search)
            squares.append(match.dx**2 + match.dy**2)
    return float(np.sqrt(np.mean(squares)))


def _direction(elevation_deg: float, azimuth_deg: float) -> NDArray[np.float64]:
    elevation, azimuth = np.radians([elevation_deg, azimuth_deg])
    return np.array(
        [
            np.cos(elevation) * np.sin(azimuth),
            np.cos(elevation) * np.cos(azimuth),
            np.sin(elevation),
        ]
    )


def format_table(rows: list[PhotometryRow]) -> str:
    """A text table, one line an emission angle; mean and worst over Suns and views."""
    lines = [
        "Hapke against Lommel-Seeliger on Tycho's ground, Sun 10, 25 and 45° high (mean / worst)",
        "emission    correlation      remainder/contrast    shift of the peak, nodes",
    ]
    for row in rows:
        lines.append(
            f"{row.emission_deg:>7.0f}°  {row.correlation[0]:>7.4f} /{row.correlation[1]:>7.4f}"
            f"  {row.remainder[0]:>9.3f} /{row.remainder[1]:>6.3f}"
            f"  {row.shift[0]:>13.3f} /{row.shift[1]:>6.3f}"
        )
    below = [row for row in rows if row.emission_deg < 60.0]
    worst = min(row.correlation[1] for row in below)
    shift = max(row.shift[1] for row in below)
    lines.append(
        f"below 60° of emission: correlation at least {worst:.3f}, peaks moved by at most "
        f"{shift:.2f} nodes (rms)"
    )
    return "\n".join(lines)
