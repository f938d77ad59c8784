"""Drawings of a run's page: the map, residuals and scores; for errors see `error_plots`."""

import numpy as np

from catalog.arrays import FloatArray
from catalog.geometry.latlon import latlon_from_xyz
from catalog.geometry.sphere import distance_to_sphere
from optnav_cli.output.report.ground import GroundMap
from optnav_cli.output.report.page import figure
from optnav_cli.output.report.svg import HALF, Plot, span
from optnav_cli.output.run_folder import RunFolder
from optnav_cli.solution import Solution

MOST_FOOTPRINTS = 60
MOST_DOTS = 4000
BORDER_POINTS = 12  # of a footprint, along each side of the picture
HISTOGRAM_BINS = 24


def ground_plot(run: RunFolder) -> str:
    """Footprints of the solved frames, the places below the camera and the control points."""
    body = run.attitude.body
    solved = [s for s in run.solutions if s.position_m is not None]
    lat, lon, _ = latlon_from_xyz(np.array([s.position_m for s in solved]))
    points = {(m.catalog, m.cp_id): m for m in sorted(run.matches, key=lambda match: match.used)}
    cp_lat, cp_lon, _ = latlon_from_xyz(
        np.array([m.cp_position_m for m in points.values()]).reshape(-1, 3)
    )
    step = -(-len(solved) // MOST_FOOTPRINTS)
    borders = [border for s in solved[::step] if (border := _footprint(run, s)) is not None]
    all_lat = np.degrees(np.concatenate([lat, cp_lat, *(b[0] for b in borders)]))
    all_lon = np.degrees(np.concatenate([lon, cp_lon, *(b[1] for b in borders)]))
    finite = np.isfinite(all_lat)
    ground = GroundMap.about(all_lat[finite], all_lon[finite], body.radius_m)
    plot = ground.plot(*ground.places(all_lat[finite], all_lon[finite]), height=620)
    for b_lat, b_lon in borders:
        x, y = ground.places(np.degrees(b_lat), np.degrees(b_lon))
        plot.line(x, y, "s1 thin", closed=ground.regional)
    x, y = ground.places(np.degrees(cp_lat), np.degrees(cp_lon))
    used = np.array([m.used for m in points.values()], dtype=np.bool_)
    names = np.array([f"control point {cp_id}" for _, cp_id in points])
    for choice, series, radius in ((~used, "s4", 2.2), (used, "s3", 2.6)):
        few = slice(None, None, -(-max(int(choice.sum()), 1) // MOST_DOTS))
        plot.dots(x[choice][few], y[choice][few], series, radius, list(names[choice][few]))
    x, y = ground.places(np.degrees(lat), np.degrees(lon))
    plot.line(x, y, "s2 thin")
    plot.dots(x, y, "s2", 3.2, [s.file for s in solved])
    keys = {
        "k2": "below the camera",
        "k1": "footprint",
        "k3": "control point used",
        "k4": "tried, never used",
    }
    some = "" if step == 1 else f" Footprints of every {step}th frame."
    return figure(plot.svg("Map of the run"), f"Where the camera looked.{some}", keys)


def residual_plots(run: RunFolder) -> list[str]:
    """Residuals of the kept matches as a cloud, and the scores of kept and refused ones."""
    used = [m for m in run.matches if m.used and m.residual_px is not None]
    drawings = []
    if used:
        residual = np.array([m.residual_px for m in used])
        rms = float(np.sqrt(np.mean(residual**2)))
        reach = max(3.2 * rms, float(np.percentile(np.abs(residual), 99.5)))
        plot = Plot(
            (-reach, reach), (-reach, reach), x_label="x, px", y_label="y, px",
            width=HALF, height=420, equal=True,
        )  # fmt: skip
        few = residual[:: -(-len(residual) // MOST_DOTS)]
        plot.dots(few[:, 0], few[:, 1], "s1", 1.8)
        turn = np.linspace(0.0, 2.0 * np.pi, 73)
        plot.line(rms * np.cos(turn), rms * np.sin(turn), "s2", closed=True)
        drawings.append(
            figure(
                plot.svg("Residuals of the control points used, px"),
                f"Residuals of {len(used)} matches used; rms {rms:.2f} px a coordinate",
                {"k2": "the rms"},
            )
        )
    scores = [(m.score, m.used) for m in run.matches if m.score is not None]
    if scores:
        values = np.array([score for score, _ in scores])
        kept = np.array([flag for _, flag in scores], dtype=np.bool_)
        edges = np.linspace(*span(values, 0.0), HISTOGRAM_BINS + 1)
        edges = edges if edges[-1] > edges[0] else edges[0] + np.linspace(-0.5, 0.5, 25)
        below, above = (np.histogram(values[c], edges)[0] for c in (~kept, kept))
        plot = Plot(
            (edges[0], edges[-1]), (0.0, 1.05 * float((below + above).max())),
            x_label="score", y_label="matches", width=HALF, height=420,
        )  # fmt: skip
        plot.bars(edges, below, "s4")
        plot.bars(edges, above, "s3", below)
        drawings.append(
            figure(plot.svg("Scores of matches"), "Scores.", {"k3": "used", "k4": "not used"})
        )
    return [f'<div class="pair">{"".join(drawings)}</div>']


def _footprint(run: RunFolder, solution: Solution) -> tuple[FloatArray, FloatArray] | None:
    """Latitudes and longitudes (rad) of the picture's border on the ground, NaN in the sky."""
    camera = run.cameras.get(solution.file)
    if camera is None or solution.position_m is None or solution.camera_from_body is None:
        return None
    side = np.linspace(0.0, 1.0, BORDER_POINTS, endpoint=False)
    zero, one = np.zeros_like(side), np.ones_like(side)
    x = np.concatenate([side, one, 1.0 - side, zero]) * camera.width_px - 0.5
    y = np.concatenate([zero, side, one, 1.0 - side]) * camera.height_px - 0.5
    rays = camera.unproject(np.column_stack([x, y]))
    rays_body = rays @ solution.camera_from_body.as_matrix()
    distance = distance_to_sphere(solution.position_m, rays_body, run.attitude.body.radius_m)
    lat, lon, _ = latlon_from_xyz(solution.position_m + distance[:, None] * rays_body)
    return lat, lon
