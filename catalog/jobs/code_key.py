"""What makes results differ beside their settings: this package's code, and the libraries'."""

import hashlib
import platform
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from importlib.resources import files
from pathlib import Path

import catalog

# Another version of one of these may round or choose otherwise.
LIBRARIES = (
    "numpy",
    "scipy",
    "numba",
    "opencv-python-headless",
    "rasterio",
    "pyproj",
    "zstandard",
    "trimesh",
    "manifold3d",
    "embreex",
)


@cache
def code_key() -> str:
    """Hash of the package's own code: results of other code are not taken for ours.

    Read once: a process goes on with the code that it has loaded, whatever is installed meanwhile.
    """
    whole = hashlib.sha256(catalog.__version__.encode())
    package = Path(str(files("catalog")))
    for path in sorted(package.rglob("*.py")):
        whole.update(path.relative_to(package).as_posix().encode())
        whole.update(path.read_bytes())
    return whole.hexdigest()


@cache
def surroundings() -> tuple[tuple[str, str], ...]:
    """Name and version of what the same bytes need beside the code."""
    found = [("python", ".".join(platform.python_version_tuple()[:2]))]
    found.append(("processor", platform.machine()))
    for name in LIBRARIES:
        try:
            found.append((name, version(name)))
        except PackageNotFoundError:  # built from source under another name: cannot be compared
            found.append((name, "unknown"))
    return tuple(found)
