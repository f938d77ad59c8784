"""Cases of archives' files as missions ship them: position and attitude against their labels."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from catalog.geometry.vectors import unit
from optnav_cli.frames.folder import Folder, read_folder
from tests.cases.command import Outcome, Run, judge_solution, navigate, run_command

# A check of an imported folder: what is off, and whether that is little enough
Check = Callable[[Folder], tuple[bool, str]]


def import_files(out: Path, *words: object) -> tuple[Run, Folder | None]:
    """Import files into a folder; None where that failed."""
    folder = out / "folder"
    run = run_command("import", *words, "-o", folder)
    return run, read_folder(folder) if run.code == 0 else None


def judge_import(checks: tuple[Check, ...], words: tuple[object, ...], out: Path) -> Outcome:
    """Import files, and judge the first frame by some checks."""
    run, folder = import_files(out, *words)
    if folder is None or "Traceback" in run.text:
        return Outcome("wrong", run.error[:160])
    try:
        judged = [check(folder) for check in checks]
    except MissingError as error:
        return Outcome("wrong", str(error))
    verdict = "right" if all(good for good, _ in judged) else "wrong"
    return Outcome(verdict, "; ".join(shown for _, shown in judged))


def expect_reason(words: tuple[object, ...], reasons: tuple[str, ...], out: Path) -> Outcome:
    """Import a file that states no geometry: refused, or imported, with what is missing named."""
    run = run_command("import", *words, "-o", out / "folder")
    named = any(reason in run.text for reason in reasons) and "Traceback" not in run.text
    return Outcome("refused" if named and run.code in (0, 3) else "wrong", run.error[:160])


class MissingError(Exception):
    """An imported frame lacks what a check needs."""


def _ray(folder: Folder, pixel: tuple[float, float]) -> np.ndarray:
    """Find the direction of a pixel of the first frame, body axes."""
    frame = folder.frames[0]
    if frame.camera_from_body is None:
        raise MissingError("no attitude")
    ray = folder.cameras[frame.camera].unproject(np.array([pixel]))[0]
    return np.asarray(frame.camera_from_body.inv().apply(unit(ray)))


def _position(folder: Folder) -> np.ndarray:
    position = folder.frames[0].position_m
    if position is None:
        raise MissingError("no position")
    return np.asarray(position)


def sees(
    pixel: tuple[float, float],
    lat_deg: float,
    lon_deg: float,
    slant_km: float,
    tolerance: float = 1e-3,
) -> Check:
    """Check the point of the body's ellipsoid in a pixel, and its distance.

    tolerance  of the distance, relative; a point may be off by 50 deg times it
    """

    def check(folder: Folder) -> tuple[bool, str]:
        radii = np.array(folder.body.radii_m)
        start, ray = _position(folder) / radii, _ray(folder, pixel) / radii
        half = start @ ray
        root = half**2 - (ray @ ray) * (start @ start - 1.0)
        if root < 0.0:
            return False, "looks past the body"
        distance = (-half - np.sqrt(root)) / (ray @ ray)
        point = unit((start + distance * ray) * radii)
        lat, lon = np.degrees([np.arcsin(point[2]), np.arctan2(point[1], point[0])])
        off = max(abs(lat - lat_deg), abs((lon - lon_deg + 180.0) % 360.0 - 180.0))
        km = distance / 1e3
        shown = f"({lat:.3f}, {lon:.3f}) deg from {km:.1f} km"
        good = off < 50.0 * tolerance and abs(km / slant_km - 1.0) < tolerance
        return good, shown

    return check


def is_far(distance_km: float, tolerance: float = 1e-3) -> Check:
    """Check the distance from the body's centre."""

    def check(folder: Folder) -> tuple[bool, str]:
        km = float(np.linalg.norm(_position(folder))) / 1e3
        return abs(km / distance_km - 1.0) < tolerance, f"{km:.1f} km of {distance_km:g}"

    return check


def stands_at(position_m: tuple[float, float, float], tolerance_m: float) -> Check:
    """Check the position, body axes."""

    def check(folder: Folder) -> tuple[bool, str]:
        off = float(np.linalg.norm(_position(folder) - position_m))
        return off < tolerance_m, f"position off by {off:.0f} m"

    return check


def is_turned(quaternion: tuple[float, float, float, float], tolerance_deg: float) -> Check:
    """Check the attitude: camera_from_body, scalar first."""

    def check(folder: Folder) -> tuple[bool, str]:
        turn = folder.frames[0].camera_from_body
        assert turn is not None
        right = Rotation.from_quat(quaternion, scalar_first=True)
        off = float(np.degrees((turn * right.inv()).magnitude()))
        return off < tolerance_deg, f"attitude off by {off:.3f} deg"

    return check


def points_to(ra_deg: float, dec_deg: float, off_deg: float) -> Check:
    """Check the boresight's direction against the stars."""

    def check(folder: Folder) -> tuple[bool, str]:
        frame = folder.frames[0]
        assert frame.tdb_s is not None
        camera = folder.cameras[frame.camera]
        pixel = camera.principal_point_px
        ray = folder.motion.body_from_inertial(frame.tdb_s).T @ _ray(folder, pixel)
        ra, dec = np.radians([ra_deg, dec_deg])
        right = [np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)]
        off = float(np.degrees(np.arccos(min(float(ray @ right), 1.0))))
        return off < off_deg, f"boresight off by {off:.3f} deg"

    return check


def equals_spice(kernels: list[Path]) -> Check:
    """Check position and attitude against spiceypy's own, of the same kernels.

    The position is apparent, as pictures show the body: light time and stellar aberration.
    """

    def check(folder: Folder) -> tuple[bool, str]:
        import spiceypy

        frame = folder.frames[0]
        try:
            for kernel in kernels:
                spiceypy.furnsh(str(kernel))
            et = frame.tdb_s
            body, _ = spiceypy.spkpos("602", et, "IAU_ENCELADUS", "LT+S", "-82")
            turn = spiceypy.pxform("J2000", "CASSINI_ISS_NAC", et)
        finally:
            spiceypy.kclear()
        off_m = float(np.linalg.norm(_position(folder) + 1e3 * np.array(body)))
        ray = folder.motion.body_from_inertial(et).T @ _ray(folder, (511.5, 511.5))
        off = float(np.degrees(np.arccos(min(float(ray @ turn[2]), 1.0))))
        return off_m < 1.0 and off < 0.01, f"off by {off_m:.0f} m, boresight by {off:.4f} deg"

    return check


def solve(folder: Path, out: Path, *reasons: str) -> Outcome:
    """Navigate a picture folder of a real picture with its truth."""
    run, row = navigate(folder, out / "run")
    return judge_solution(run, row, folder / "truth.csv", *reasons)


def cases(archives: Path) -> dict[str, Callable[[Path], Outcome]]:
    """List the cases of a folder by their names: functions of the folder for outputs."""
    cubes, labels, orex = (archives / name for name in ("galileo_cubes", "labels", "osirisrex"))
    cassini = archives / "cassini_crescent"
    kernels = sorted((cassini / "kernels").glob("*"))
    old = [path for path in kernels if path.name != "modern.bc"]
    named = [word for path in old for word in ("--kernel", path)]
    io = cubes / "6300R_IO_GREEN_1999-11-26.cub"
    mdis = labels / "EN1072174528M_pds3.lbl"
    mdis_at = (-629496.0, -1582946.0, 1783953.0)
    mdis_turn = (0.356761, 0.934184, 0.001448, -0.004494)
    imports: dict[str, tuple[tuple[Check, ...], tuple[object, ...]]] = {
        # by the label; the cube's later kernels have the craft 11 s further on its way
        "galileo/io.cub": ((sees((399.0, 399.0), -22.153, -157.972, 20273.0, 5e-3),), (io,)),
        "galileo/io.lbl": (
            (sees((399.0, 399.0), -22.153, -157.972, 20273.0),),
            (cubes / "6300r.lbl", "--picture", io),
        ),
        "galileo/europa.cub": ((), (cubes / "5165r.cub", "--camera", "galileo_ssi")),
        "galileo/ganymede.img": (
            (is_far(665796.0),),
            (archives / "galileo_ganymede/original/2100r.img",),
        ),
        "near/msi_square.fit": (
            (is_far(36.4, 5e-3),),
            (archives / "near_msi_square/m0157063318f4_2p_iof_gbl.fit",),
        ),
        "near/msi_square.lbl": (
            (points_to(282.8846290083658, -22.18670161032236, 0.2),),
            (archives / "near_msi_square/m0157063318f4_2p_iof_gbl.lbl",),
        ),
        "messenger/mdis.lbl": (
            (stands_at(mdis_at, 2000.0), is_turned(mdis_turn, 0.1)),
            (mdis, "--picture", labels / "blank512.png"),
        ),
        "messenger/mdis.cub": ((), (labels / "EW0131773041G.cal.crop.cub",)),
        "osirisrex/mapcam.cub": ((), (orex / "20190425T211232S312_map_iofL2pan-crop.cub",)),
        "osirisrex/navcam.cub": (
            (points_to(332.519870715891, 68.7116470700655, 0.2),),
            (orex / "20200303T213031S138_ncm_L0-reduced.cub",),
        ),
        "osirisrex/navcam_touch.cub": (
            (points_to(208.903477375357, 16.5614025290341, 0.2),),
            (orex / "20201020T214241S004_nft_L0-reduced.cub",),
        ),
        "cassini/enceladus": (
            (equals_spice(old),),
            (
                cassini / "original/times.csv",
                *("--table", cassini / "original/casnac_times_180.toml", *named),
            ),
        ),
    }
    silent: dict[str, tuple[tuple[object, ...], tuple[str, ...]]] = {
        "dawn/fc.lbl": (
            (labels / "FC21A0038582_15170161546F6F_pds3.lbl", "--body", "ceres"),
            ("is cut short", "no position"),  # the label alone, without its picture
        ),
        "hayabusa2/onc.fit": (
            (next((archives / "hayabusa2_fits").glob("*.fit"), archives), "--body", "earth"),
            ("no position",),
        ),
        "voyager2/miranda.vic": (
            (archives / "voyager2_miranda/original/mirandab.vio.vic", "--body", "miranda"),
            ("no import table", "not state", "attitude"),
        ),
        "voyager2/c4400436.cub": (
            (labels / "c4400436.cub", "--body", "enceladus"),
            ("spiceinit", "no import table", "no table"),
        ),
        "osirisrex/mapcam.xml": (
            (orex / "20181201T100711S900_map_L0pan.xml", "--body", "bennu"),
            ("there is no such file", "no position"),
        ),
    }
    listed: dict[str, Callable[[Path], Outcome]] = {
        name: partial(judge_import, checks, words) for name, (checks, words) in imports.items()
    }
    listed |= {name: partial(expect_reason, *words) for name, words in silent.items()}
    return listed | {
        "limb/ganymede": partial(solve, archives / "galileo_ganymede/folder"),
        "limb/miranda": partial(solve, archives / "voyager2_miranda/folder"),
    }
