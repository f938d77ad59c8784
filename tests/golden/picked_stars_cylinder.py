"""Pictures of picked points, stars and a cylinder for the README, by the commands it shows."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from optnav_cli.frames.tables import ATTITUDES, CYLINDER, CYLINDER_TRUTH
from optnav_cli.output.canvas import compute_shrink_factor, resize_picture
from optnav_cli.output.overlay import overlay_path
from optnav_cli.output.run_folder import read_run
from tests.golden import sketch
from tests.golden.flights import optnav

STAR_FRAME, STARS_PX = "frame_0005.png", 900


def drawn(work: Path, readme: Path) -> Iterator[tuple[Path, str]]:
    """Each picture with its caption."""
    picked, run = work / "picked", work / "picked-run"
    shutil.rmtree(picked, ignore_errors=True)  # a template is written into no folder that has files
    optnav("config", "template", "points", "-o", str(picked))
    optnav("navigate", str(picked), "-o", str(run))
    optnav("report", str(run), "-o", str(readme / "picked.svg"))
    yield readme / "picked.svg", _picked(run)
    sky, attitudes = work / "stars", work / "attitudes"
    optnav("simulate", "bundled:stars_10000km", "-o", str(sky))
    optnav("stars", str(sky), "-o", str(attitudes))
    overlay = cv2.imread(str(overlay_path(attitudes / "overlays", STAR_FRAME)))
    if overlay is None:
        raise FileNotFoundError(f"{attitudes}: no overlay of {STAR_FRAME}")
    height, width = overlay.shape[:2]
    small = resize_picture(
        np.asarray(overlay, np.uint8), compute_shrink_factor(width, height, STARS_PX)
    )
    sketch.write(small, readme / "stars.jpg")
    yield readme / "stars.jpg", _stars(attitudes)
    lamp, run = work / "lamp", work / "lamp-run"
    optnav("simulate", "bundled:cylinder_circle", "-o", str(lamp))
    optnav("cylinder", str(lamp), "-o", str(run))
    optnav("report", str(run), "-o", str(readme / "cylinder.svg"))
    yield readme / "cylinder.svg", _cylinder(lamp, run)


def _picked(folder: Path) -> str:
    run = read_run(folder)
    used = sum(match.used for match in run.matches)
    sigmas = [
        float(np.sqrt(np.linalg.eigvalsh(s.covariance_m2)[-1]))
        for s in run.solutions
        if s.covariance_m2 is not None
    ]
    return (
        f"Three pictures of the Earth from 418 km with {len(run.matches)} picked points, {used} of "
        "them used, with residuals and 3 stated sigmas of the position. The "
        f"lens, known to 0.5 %, leaves {min(sigmas) / 1e3:.1f} to {max(sigmas) / 1e3:.1f} km (1 "
        "sigma) along the line of sight."
    )


def _stars(folder: Path) -> str:
    rows = ATTITUDES.rows(folder / "attitudes.csv")
    row = next(row for row in rows if row["file"] == STAR_FRAME)
    across, about = (row.number(f"sigma_{axis}_arcsec") or 0.0 for axis in "xz")
    return (
        f"Stars beside the lit Moon, drawn from 10 000 km: {row['n_used']} of {row['n_spots']} "
        f"spots are named, and the attitude is known to {across:.1f}″ across and {about:.1f}″ "
        "about the axis."
    )


def _cylinder(pictures: Path, folder: Path) -> str:
    rows = CYLINDER.rows(folder / "cylinder.csv")
    truths = CYLINDER_TRUTH.rows(pictures / "truth.csv")
    d_off, theta_off = [], []
    for row, truth in zip(rows, truths, strict=True):
        if row["status"] != "solved" or row["zone"] == "glare":
            continue
        d_off.append((row.number("d_m") or 0.0) - (truth.number("d_m") or 0.0))
        off = (row.number("theta_deg") or 0.0) - (truth.number("theta_deg") or 0.0)
        theta_off.append((off + 180.0) % 360.0 - 180.0)
    d_mm, theta = 1e3 * np.abs(d_off).max(), np.abs(theta_off).max()
    return (
        f"A craft that circles a lit cylinder: {len(d_off)} of {len(rows)} pictures, those in the "
        f"glare left out, give the distance to {d_mm:.1f} mm and the angle of the light to "
        f"{theta:.1f}° at worst. Zones other than ok are shaded."
    )
