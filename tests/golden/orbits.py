"""Pictures of orbits for the READMEs, drawn by the commands that the READMEs show."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from optnav_cli.frames.orbit_tables import DELIVERY_STAGES, LANDING, QSO
from optnav_cli.orbit.delivery.settings import STAGES_CSV
from optnav_cli.orbit.landing.settings import LANDING_CSV
from optnav_cli.orbit.qso.settings import QSO_CSV
from tests.golden.flights import optnav


def designs(work: Path, readme: Path) -> Iterator[tuple[Path, str]]:
    """Quasi-satellite orbit, landing and delivery; each picture with its caption."""
    captions = {
        "qso": ("qso_55km", _qso),
        "landing": ("landing_phobos", _landing),
        "delivery": ("delivery_moon", _delivery),
    }
    for name, (settings, caption) in captions.items():
        folder, path = work / name, readme / f"{name}.svg"
        optnav("orbit", name, f"bundled:{settings}", "-o", str(folder))
        optnav("report", str(folder), "-o", str(path))
        yield path, caption(folder)


def through_fixes(work: Path, readme: Path) -> tuple[Path, str]:
    """The orbit of the README's example and its caption."""
    catalog, pictures = work / "phobos.gpkg", work / "approach"
    run, orbit, path = work / "approach-run", work / "approach-orbit", readme / "orbit_fit.svg"
    optnav("build", "bundled:phobos", "-o", str(catalog))
    optnav("simulate", "bundled:phobos_approach", "-o", str(pictures))
    optnav("navigate", str(pictures), "--catalog", str(catalog), "-o", str(run))
    optnav("orbit", "fit", str(run), "-o", str(orbit))
    optnav("evaluate", str(orbit), "--truth", str(pictures / "truth.csv"))
    optnav("report", str(orbit), "-o", str(path))
    return path, fitted_caption(json.loads((orbit / "evaluation.json").read_text("utf-8")))


def fitted_caption(figures: dict[str, Any]) -> str:
    """Of an evaluated approach: what the fixes were off by, and the orbit through them."""
    axes = {"r": "range", "n": "along the motion", "b": "across"}
    parts = [
        f"{words} {before:.0f} and {figures[axis]['rms_m']:.0f} m"
        for (axis, words), before in zip(axes.items(), figures["fixes_rms_rnb_m"], strict=True)
    ]
    return (
        "An approach to Phobos from 300 to 20 km: errors of the fixes and of the orbit through "
        f"them, with 3 stated sigmas. Root mean squares of both: {', '.join(parts)}."
    )


def _qso(folder: Path) -> str:
    row = QSO.rows(folder / QSO_CSV)[0]
    theory, found = row.number("theory_spread_km") or 0.0, row.number("spread_km") or 0.0
    return (
        f"A quasi-satellite orbit {row['distance_km']} km from Phobos, in the frame that turns "
        "with it: left with the velocity of the averaged theory, right with that of least drift. "
        f"Passes of the longitude differ by {theory:.1f} and {found:.1f} km."
    )


def _landing(folder: Path) -> str:
    rows = LANDING.rows(folder / LANDING_CSV)
    landed = [row for row in rows if row["down_m_s"]]
    away = [
        abs(complex(row.number("east_m") or 0.0, row.number("north_m") or 0.0)) for row in landed
    ]
    fastest = max(row.number("down_m_s") or 0.0 for row in landed)
    return (
        "A landing on Phobos: the transfer in section with its beams, and where "
        f"{len(landed)} of {len(rows)} trials touch down: at most {max(away):.0f} m from the "
        f"target, at most {fastest:.1f} m/s down."
    )


def _delivery(folder: Path) -> str:
    *corrections, arrival = [
        row for row in DELIVERY_STAGES.rows(folder / STAGES_CSV) if row["stage"] != "injection"
    ]
    bounds = [row.number("bound_dv_m_s") or 0.0 for row in corrections]
    return (
        "The arrival at the Moon in the B-plane: boxes that hold all bounded errors, and trials. "
        f"{len(corrections)} corrections of at most {', '.join(f'{dv:.1f}' for dv in bounds)} m/s "
        f"leave xi within {arrival.number('bound_xi_km') or 0.0:.0f} km of the aim."
    )
