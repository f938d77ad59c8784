"""Settings of quasi-satellite orbits, landings and deliveries, and folders that are damaged."""

from optnav_cli.orbit.delivery.settings import DeliverySettings
from optnav_cli.orbit.landing.settings import LandingSettings
from optnav_cli.orbit.qso.settings import QsoSettings
from tests.fuzz.cases import DATA, NOTHING, Case, Place, kind
from tests.fuzz.kinds.configs import ConfigKind

# Distances alone: whole tables of orbits would take minutes.
DESIGNS = {
    "qso": ConfigKind(QsoSettings, "qso.toml", "qso.toml"),
    "landing": ConfigKind(LandingSettings, "landing.toml", "landing.toml"),
    "delivery": ConfigKind(DeliverySettings, "delivery.toml", "delivery.toml"),
}


def _design(
    place: Place,
    name: str,
    written: frozenset[int] = frozenset({0}),
    leaves: tuple[str, ...] = (),
) -> Case:
    text, codes, note = DESIGNS[name].text(place)
    place.write(f"{name}.toml", text)
    args = ("-q", "orbit", name, f"{name}.toml", "-o", "new")
    return Case(args, codes | {DATA, NOTHING}, "new", written, leaves, note=note)


@kind("design-qso", 0.6)
def qso(place: Place) -> Case:
    """Quasi-satellite orbits by other settings."""
    return _design(place, "qso", frozenset({0, NOTHING}))


@kind("design-landing", 0.4)
def landing(place: Place) -> Case:
    """A landing by other settings; the trials are written also where none lands."""
    return _design(place, "landing", leaves=("new",))


@kind("design-delivery", 0.6)
def delivery(place: Place) -> Case:
    """A delivery by other settings."""
    return _design(place, "delivery")
