"""Settings to the accuracy of a delivery in a folder, as `optnav orbit delivery` does."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from catalog.arrays import FloatArray
from catalog.bodies.epochs import DAY_S, utc_from_tdb_s
from catalog.config import resolve_config
from catalog.errors import NoSolutionError, NothingToDoError
from catalog.files import hash_file
from catalog.progress import Progress
from optnav_cli.frames.orbit_tables import DELIVERY_ARRIVALS, DELIVERY_BOXES, DELIVERY_STAGES
from optnav_cli.orbit.delivery.boxes import (
    BoxStage,
    DeliveryTask,
    TrialStages,
    cover,
    delivery_task,
    fly_deliveries,
)
from optnav_cli.orbit.delivery.settings import (
    ARRIVALS_CSV,
    BOXES_CSV,
    DELIVERY_KIND,
    STAGES_CSV,
    load_delivery_settings,
)
from optnav_cli.orbit.qso.settings import FOLDER, moon_of
from optnav_cli.output.manifest import output_folder
from optnav_cli.output.wording import align_table

STAGE = "orbit delivery"
SHARE = 99.73  # percent of trials: 3 sigma of one normal number
MAX_ARRIVALS = 5000  # rows of arrivals.csv
KM = np.array([1e-3, 1e-3, 1.0])  # of (xi, eta, tau)
AXES = ("xi_km", "eta_km", "tau_s")


@dataclass(frozen=True, eq=False)
class DeliveryResult:
    """Boxes and trials of a delivery."""

    task: DeliveryTask
    boxes: list[BoxStage]
    trials: TrialStages

    @property
    def bound_m_s(self) -> float:
        """Sum of all corrections by the boxes, m/s."""
        return float(self.boxes[-1].spent.max())

    @property
    def total_m_s(self) -> float:
        """Sum of all corrections, 99.73 % of the trials, m/s."""
        return float(np.percentile(self.trials.total, SHARE))

    def stages(self) -> list[dict[str, object]]:
        """Rows of stages.csv: each correction, and the arrival."""
        rows: list[dict[str, object]] = []
        path, corrections = self.task.path, self.task.corrections
        arrival_day = (path.pericentre_s - float(path.tdb_s[0])) / DAY_S
        for number, (box, errors) in enumerate(zip(self.boxes, self.trials.errors, strict=True)):
            row: dict[str, object] = {"stage": "arrival", "day": arrival_day}
            if number < len(corrections):
                correction = corrections[number]
                row = {"stage": f"correction {number + 1}", "day": correction.day}
                row["condition"] = correction.condition
                row |= _axes("navigation_", np.sqrt(np.diag(correction.errors)))
                dv = self.trials.dv_m_s[number]
                row["bound_dv_m_s"] = self.boxes[number + 1].dv_m_s
                row["trials_dv_m_s"] = float(np.percentile(dv, SHARE))
                row["largest_dv_m_s"] = float(dv.max())
            row |= _axes("bound_", box.reach)
            row |= _axes("trials_", np.percentile(np.abs(errors), SHARE, axis=0))
            row["boxes"] = int(box.filled.sum())
            rows.append(row)
        return rows


def _axes(prefix: str, values: FloatArray) -> dict[str, object]:
    scaled = (values * KM).tolist()
    return {f"{prefix}{name}": value for name, value in zip(AXES, scaled, strict=True)}


def delivery_folder(settings_path: Path, output: Path, progress: Progress) -> DeliveryResult:
    """Work out the delivery of the settings and write the folder.

    Raises ConfigError for wrong settings, NothingToDoError where no path leads to the target.
    """
    path = resolve_config(settings_path, FOLDER)
    settings = load_delivery_settings(settings_path)
    section = settings.delivery
    with (
        output_folder(output, DELIVERY_KIND, "orbit delivery", [path], STAGE) as out,
        progress.stage(STAGE, 3, "step") as bar,
    ):
        target = moon_of(section.target, path)
        try:
            task = delivery_task(settings, target, str(settings_path))
            bar.advance()
            boxes = cover(task)
        except NoSolutionError as error:
            raise NothingToDoError(f"{settings_path}: {error}") from None
        bar.advance()
        trials = fly_deliveries(task, section.trials, section.seed, cut=False)
        bar.advance()
        result = DeliveryResult(task, boxes, trials)
        DELIVERY_STAGES.write(out.path / STAGES_CSV, result.stages())
        DELIVERY_BOXES.write(out.path / BOXES_CSV, _box_cells(result))
        DELIVERY_ARRIVALS.write(out.path / ARRIVALS_CSV, _arrival_cells(result))
        plane = task.path.plane
        out.options = msgspec.to_builtins(settings)
        out.inputs = {"settings": path, "settings_sha256": hash_file(path)}
        out.results = {
            "bound_dv_m_s": result.bound_m_s,
            "trials_dv_m_s": result.total_m_s,
            "largest_dv_m_s": float(trials.total.max()),
            "xi_km": float(plane.aim[0]) / 1e3,
            "eta_km": float(plane.aim[1]) / 1e3,
            "pericentre_utc": utc_from_tdb_s(task.path.pericentre_s, 3),
            "pericentre_km": plane.pericentre_m / 1e3,
            "arrival_m_s": plane.speed_m_s,
            "impact_km": _impact_m(task) / 1e3,
            "radius_km": target.radius_m / 1e3,
        }
    return result


def _impact_m(task: DeliveryTask) -> float:
    """The largest B at which a path of this speed meets the target's sphere."""
    target, speed = task.path.motion.target, task.path.plane.speed_m_s
    radius = target.radius_m
    return float(radius * np.sqrt(1.0 + 2.0 * target.gm_m3_s2 / (radius * speed**2)))


def _names(result: DeliveryResult) -> list[str]:
    return [str(row["stage"]) for row in result.stages()]


def _box_cells(result: DeliveryResult) -> Iterator[dict[str, object]]:
    """The boxes at the arrival: those of earlier sets are many and say no more than stages.csv."""
    name, box = _names(result)[-1], result.boxes[-1]
    cells = np.argwhere(box.filled)
    # columns of boxes along tau as one
    for xi, eta in np.unique(cells[:, :2], axis=0).tolist():
        ends = cells[(cells[:, 0] == xi) & (cells[:, 1] == eta), 2]
        low = box.low + np.array([xi, eta, ends.min()]) * box.step
        high = box.low + np.array([xi + 1, eta + 1, ends.max() + 1]) * box.step
        sides = {f"{axis}_from": v for axis, v in zip(AXES, (low * KM).tolist(), strict=True)}
        sides |= {f"{axis}_to": v for axis, v in zip(AXES, (high * KM).tolist(), strict=True)}
        yield {"stage": name, "spent_m_s": float(box.spent[xi, eta].max()), **sides}


def _arrival_cells(result: DeliveryResult) -> Iterator[dict[str, object]]:
    points, total = result.trials.errors[-1] * KM, result.trials.total
    for number, (point, dv) in enumerate(zip(points[:MAX_ARRIVALS], total), start=1):
        axes = dict(zip(AXES, point.tolist(), strict=True))
        yield {"trial": number, "dv_m_s": float(dv), **axes}


def delivery_lines(result: DeliveryResult) -> list[str]:
    """A summary for people."""
    head = (
        "",
        "day",
        "dv, m/s: bound",
        "99.73 %",
        "xi, km: bound",
        "99.73 %",
        "eta, km",
        "99.73 %",
    )
    table: list[tuple[str, ...]] = [head]

    def shown(row: dict[str, object], name: str) -> str:
        value = row.get(name)
        return f"{value:.4g}" if isinstance(value, float) else ""

    for row in result.stages():
        names = ("bound_dv_m_s", "trials_dv_m_s", "bound_xi_km", "trials_xi_km")
        more = ("bound_eta_km", "trials_eta_km")
        cells = (shown(row, name) for name in (*names, *more))
        table.append((str(row["stage"]), shown(row, "day"), *cells))
    both = (
        f"{result.bound_m_s:.4g} m/s at most, {result.total_m_s:.4g} m/s in 99.73 % of the trials"
    )
    return [f"all corrections: {both}", *align_table(table, left=(0,))]
