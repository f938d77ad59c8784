"""The brightness laws by name."""

from collections.abc import Callable

from catalog.arrays import FloatArray
from catalog.errors import ConfigError
from catalog.photometry import hapke, lambert, lommel_seeliger, lunar_lambert

Law = Callable[..., FloatArray]

LAWS: dict[str, Law] = {
    "hapke": hapke.reflectance,
    "lommel_seeliger": lommel_seeliger.reflectance,
    "lunar_lambert": lunar_lambert.reflectance,
    "lambert": lambert.reflectance,
}


def law_by_name(name: str) -> Law:
    """The function reflectance(mu0, mu, cos_phase) of a law.

    Raises ConfigError for a name that is no law.
    """
    if name not in LAWS:
        raise ConfigError(f"photometry: no law is called '{name}'; use one of {', '.join(LAWS)}")
    return LAWS[name]
