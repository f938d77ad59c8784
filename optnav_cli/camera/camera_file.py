"""Camera files: TOML in, checked, and out again."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import msgspec

from catalog.config import load_toml, nearest_name, resource
from catalog.errors import ConfigError
from catalog.inputs import check_input
from optnav_cli.camera.camera import Camera, Coding, Distortion, LineOrder, Model

# Focal length, pitch and their ratio are each printed with about four digits.
AGREEMENT = 1e-3
# Of the longer side: a pinhole of 179.9 deg, and a picture of 0.2" across.
FOCAL_SIDES = (1e-3, 1e6)
MAX_PIXELS = 100_000_000  # of a picture: its values and what is made of them take some GB
MAX_PSF_PX = 50.0  # beyond any lens: the key is not in pixels
Side = Annotated[int, msgspec.Meta(ge=1, le=100_000)]
Length = Annotated[float, msgspec.Meta(ge=1e-3, le=1e9)]
Arcsec = Annotated[float, msgspec.Meta(ge=0.0, le=180.0 * 3600.0)]
Turned = Annotated[float, msgspec.Meta(ge=-36_000.0, le=36_000.0)]  # arcsec: 10 deg
Pixels = Annotated[float, msgspec.Meta(ge=-1e6, le=1e6)]
Edge = Annotated[int, msgspec.Meta(ge=0, le=100_000)]
_OPENCV = "k1, k2, p1, p2[, k3[, k4, k5, k6[, s1, s2, s3, s4[, tau_x, tau_y]]]]"
# how many coefficients there may be, by what uses them, and their names
_TERMS = {
    "brown": ((5,), "[k1, k2, p1, p2, k3]"),
    "opencv": ((4, 5, 8, 12, 14), f"4, 5, 8, 12 or 14 of [{_OPENCV}]"),
    "kannala_brandt": ((4,), "[k1, k2, k3, k4]"),
}
MAX_TILT = 1.0  # rad: no sensor is turned so far
MAX_ASPECT = 100.0  # of a pixel's sides


class CameraFileSettings(msgspec.Struct, forbid_unknown_fields=True, omit_defaults=True):
    """A camera file as it is written."""

    name: str
    model: Model
    width_px: Side
    height_px: Side
    principal_point_px: tuple[Pixels, Pixels]
    focal_length_px: Length | None = None
    focal_length_mm: Length | None = None
    pixel_pitch_um: Length | None = None
    distortion: Distortion = "none"
    coefficients: tuple[Pixels, ...] = ()
    image_circle_radius_px: Length | None = None
    psf_sigma_px: float | None = None
    psf_error_px: float | None = None
    focal_length_y_px: Length | None = None
    pixel_pitch_y_um: Length | None = None
    boresight_sigma_arcsec: Arcsec = 0.0
    boresight_arcsec: tuple[Turned, Turned, Turned] | None = None
    focal_length_error: Annotated[float, msgspec.Meta(ge=0.0, le=0.5)] = 0.0
    principal_point_error_px: Annotated[float, msgspec.Meta(ge=0.0, le=1e5)] = 0.0
    saturation_counts: Annotated[float, msgspec.Meta(gt=0.0, le=1e30)] | None = None
    valid_area_px: tuple[Edge, Edge, Edge, Edge] | None = None
    valid_mask: str | None = None
    channel: Literal["red", "green", "blue", "luminance"] | None = None
    exif_orientation: Literal["apply", "ignore"] | None = None
    line_order: LineOrder = "top_first"
    extension: int | str = ""
    coding: Coding | None = None


def load_camera(path: str | Path) -> Camera:
    """The camera that a TOML file describes.

    Raises ConfigError, naming file and key, for a file that is missing, wrong or inconsistent.
    """
    settings = load_toml(Path(path), CameraFileSettings)
    where = str(path)
    _check_picture(settings, where)
    _check_lens(settings, where)
    _check_blur(settings, where)
    focal_px = _find_focal_length_px(settings, where)
    values = msgspec.structs.asdict(settings) | {
        "focal_length_px": focal_px,
        "focal_length_y_px": _find_focal_length_y_px(settings, focal_px, where),
        "extension": str(settings.extension),
        "coding": settings.coding,
    }
    if settings.valid_mask is not None:
        values["valid_mask"] = str((Path(path).parent / settings.valid_mask).absolute())
    del values["focal_length_mm"], values["pixel_pitch_y_um"]
    return Camera(**values)


def is_plain_name(name: str) -> bool:
    """Whether a camera may be called so: the name of its file, and a cell of tables."""
    return name != "" and not set(name) & set('"\\\n,/\0')


def preset_camera(name: str) -> Camera:
    """A camera that ships with optnav. Raises ConfigError, naming the nearest, for another name."""
    folder = resource("configs/cameras/unk.toml").parent
    known = sorted(path.stem for path in folder.glob("*.toml"))
    if name not in known:
        near = nearest_name(name, known)
        hint = f"did you mean '{near}'?" if near else f"there are {', '.join(known)}"
        raise ConfigError(f"no camera '{name}' ships with optnav; {hint}")
    return load_camera(folder / f"{name}.toml")


def write_camera(folder: Path, camera: Camera) -> Path:
    """Write NAME.toml into a folder, and beside it a copy of the camera's mask; return its path.

    The file names the copy alone, so that the folder can be moved. Raises DataError for a mask
    that is missing.
    """
    file = folder / f"{camera.name}.toml"
    if camera.valid_mask is not None:
        mask = Path(camera.valid_mask)
        check_input(mask, "mask picture", "correct valid_mask of the camera file")
        name = f"{camera.name}_mask{mask.suffix}"
        shutil.copyfile(mask, folder / name)
        camera = replace(camera, valid_mask=name)
    file.write_text(camera_toml(camera), encoding="utf-8")
    return file


def camera_toml(camera: Camera) -> str:
    """The text of a camera file that `load_camera` reads back to the same camera."""
    x, y = camera.principal_point_px
    lines = [
        f'name = "{camera.name}"',
        f'model = "{camera.model}"',
        f"width_px = {camera.width_px}",
        f"height_px = {camera.height_px}",
        f"focal_length_px = {float(camera.focal_length_px)!r}",
        f"principal_point_px = [{float(x)!r}, {float(y)!r}]",
    ]
    if camera.pixel_pitch_um is not None:
        focal_mm = camera.focal_length_px * camera.pixel_pitch_um * 1e-3
        lines += [f"focal_length_mm = {focal_mm!r}", f"pixel_pitch_um = {camera.pixel_pitch_um!r}"]
    if camera.focal_length_y_px is not None:
        lines.append(f"focal_length_y_px = {float(camera.focal_length_y_px)!r}")
    if camera.distortion != "none":
        lines.append(f'distortion = "{camera.distortion}"')
    if camera.coefficients:
        lines.append(f"coefficients = [{', '.join(repr(float(c)) for c in camera.coefficients)}]")
    for key in ("image_circle_radius_px", "psf_sigma_px", "psf_error_px"):
        if (value := getattr(camera, key)) is not None:
            lines.append(f"{key} = {float(value)!r}")
    for key in ("boresight_sigma_arcsec", "focal_length_error", "principal_point_error_px"):
        if value := getattr(camera, key):
            lines.append(f"{key} = {float(value)!r}")
    if camera.boresight_arcsec is not None:
        turns = ", ".join(repr(float(angle)) for angle in camera.boresight_arcsec)
        lines.append(f"boresight_arcsec = [{turns}]")
    return "\n".join([*lines, *_format_picture_keys(camera)]) + "\n" + _format_coding(camera)


def _format_picture_keys(camera: Camera) -> list[str]:
    """Keys of how a camera's pictures are to be read."""
    lines = []
    if camera.saturation_counts is not None:
        lines.append(f"saturation_counts = {float(camera.saturation_counts)!r}")
    if camera.valid_area_px is not None:
        lines.append(f"valid_area_px = {list(camera.valid_area_px)}")
    for key in ("valid_mask", "channel", "exif_orientation", "extension"):
        if text := getattr(camera, key):
            lines.append(f"{key} = {msgspec.json.encode(text).decode()}")
    if camera.line_order != "top_first":
        lines.append(f'line_order = "{camera.line_order}"')
    return lines


def _format_coding(camera: Camera) -> str:
    return "" if camera.coding is None else camera.coding.format_toml()


def _check_picture(settings: CameraFileSettings, where: str) -> None:
    if settings.width_px * settings.height_px > MAX_PIXELS:
        raise ConfigError(
            f"{where}: width_px x height_px are {settings.width_px} x {settings.height_px}; wanted "
            f"pictures of at most {MAX_PIXELS:,} pixels"
        )
    if not is_plain_name(settings.name):
        raise ConfigError(f"{where}: name is '{settings.name}'; wanted a plain word")
    if settings.coding is not None and (problem := settings.coding.find_problem()):
        raise ConfigError(f"{where}: [coding]: {problem}")
    if settings.valid_area_px is not None:
        left, top, right, bottom = settings.valid_area_px
        if not (left < right < settings.width_px and top < bottom < settings.height_px):
            raise ConfigError(
                f"{where}: valid_area_px is {list(settings.valid_area_px)}; wanted [left, top, "
                f"right, bottom] in a picture of {settings.width_px} x {settings.height_px}"
            )


def _check_lens(settings: CameraFileSettings, where: str) -> None:
    model, distortion, given = settings.model, settings.distortion, settings.coefficients
    if distortion != "none" and model != "pinhole":
        raise ConfigError(
            f'{where}: distortion "{distortion}" belongs to model "pinhole", not "{model}"; '
            'a fisheye\'s distortion is the model "kannala_brandt"'
        )
    user = distortion if distortion != "none" else model
    if user not in _TERMS and given:
        remedy = 'write distortion = "brown"' if model == "pinhole" else 'use "kannala_brandt"'
        raise ConfigError(f"{where}: coefficients are given but nothing uses them; {remedy}")
    counts, names = _TERMS.get(user, ((0,), ""))
    if len(given) not in counts:
        key = "model" if user == model else "distortion"
        wanted = f"{counts[0]}: coefficients = {names}" if len(counts) == 1 else names
        raise ConfigError(f'{where}: {len(given)} coefficients; {key} "{user}" wants {wanted}')
    if any(abs(tau) > MAX_TILT for tau in given[12:]):
        raise ConfigError(
            f"{where}: tau_x, tau_y are {list(given[12:])}; wanted radians, at most {MAX_TILT:g}"
        )


def _check_blur(settings: CameraFileSettings, where: str) -> None:
    sigma, error = settings.psf_sigma_px, settings.psf_error_px
    if (sigma is None) != (error is None):
        missing = "psf_error_px" if error is None else "psf_sigma_px"
        raise ConfigError(f"{where}: psf_sigma_px and psf_error_px belong together; add {missing}")
    if sigma is None or error is None:
        return
    if not 0.0 <= sigma <= MAX_PSF_PX:
        raise ConfigError(f"{where}: psf_sigma_px is {sigma}; wanted 0 to {MAX_PSF_PX:g}")
    if not 0.0 < error <= MAX_PSF_PX:
        raise ConfigError(
            f"{where}: psf_error_px is {error}; wanted the 1-sigma error of psf_sigma_px, over 0 "
            f"and up to {MAX_PSF_PX:g}"
        )


def _find_focal_length_px(settings: CameraFileSettings, where: str) -> float:
    pixels, length_mm = settings.focal_length_px, settings.focal_length_mm
    pitch_um = settings.pixel_pitch_um
    if (length_mm is None) != (pitch_um is None):
        missing = "pixel_pitch_um" if pitch_um is None else "focal_length_mm"
        raise ConfigError(
            f"{where}: focal_length_mm and pixel_pitch_um belong together; add {missing}"
        )
    from_length = pixels
    if length_mm is not None and pitch_um is not None:
        from_length = length_mm * 1e3 / pitch_um
    if from_length is None:
        raise ConfigError(
            f"{where}: no focal length; add focal_length_px, or focal_length_mm with pixel_pitch_um"
        )
    side = max(settings.width_px, settings.height_px)
    if not FOCAL_SIDES[0] * side <= from_length <= FOCAL_SIDES[1] * side:
        raise ConfigError(
            f"{where}: the focal length is {from_length:g} px; wanted {FOCAL_SIDES[0]:g} to "
            f"{FOCAL_SIDES[1]:g} of the longer side, {side} px"
        )
    if pixels is not None and abs(pixels / from_length - 1.0) > AGREEMENT:
        raise ConfigError(
            f"{where}: focal_length_px is {pixels}, but focal_length_mm / pixel_pitch_um gives "
            f"{from_length:.2f}; correct one of them"
        )
    return from_length if pixels is None else pixels


def _find_focal_length_y_px(
    settings: CameraFileSettings, focal_px: float, where: str
) -> float | None:
    """The focal length along y; None where pixels are square."""
    along_y, pitch, pitch_y = (
        settings.focal_length_y_px,
        settings.pixel_pitch_um,
        settings.pixel_pitch_y_um,
    )
    if pitch_y is not None:
        if pitch is None:
            raise ConfigError(f"{where}: pixel_pitch_y_um belongs to pixel_pitch_um; add that")
        by_pitch = focal_px * pitch / pitch_y
        if along_y is not None and abs(along_y / by_pitch - 1.0) > AGREEMENT:
            raise ConfigError(
                f"{where}: focal_length_y_px is {along_y}, but the pitches give {by_pitch:.2f}; "
                "correct one of them"
            )
        along_y = by_pitch if along_y is None else along_y
    if along_y is not None and not 1.0 / MAX_ASPECT <= along_y / focal_px <= MAX_ASPECT:
        raise ConfigError(
            f"{where}: the focal length is {focal_px:g} px along x and {along_y:g} along y; wanted "
            f"pixels whose sides differ at most by {MAX_ASPECT:g} times"
        )
    return along_y
