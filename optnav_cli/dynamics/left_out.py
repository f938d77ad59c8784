"""What the forces of an orbit leave out, and what size that has: in words, for people."""

import logging

import numpy as np

from catalog.arrays import FloatArray
from catalog.bodies.body import Body
from optnav_cli.dynamics.forces import NEIGHBOURS, Forces
from optnav_cli.dynamics.gravity_field import even_field
from optnav_cli.dynamics.orbit_integrator import AU_M, SUNLIGHT_N_M2
from optnav_cli.dynamics.orbit_settings import ForcesSettings, SunlightSettings

TYPICAL_M2_KG = SunlightSettings().strength_m2_kg  # of a craft without sails
# A fluid body of density growing inward has J2 of a third of its spin's pull over gravity at the
# equator: 1/3.2 on the Earth, 1/2.3 on Mars, 1/6 on Jupiter.
SLOW_J2 = 2e-4  # the Moon's, which its spin does not explain; Mercury has 5e-5, Venus 4e-6
J2_OF_SPIN = 1.0 / 3.0
DAYS_S = 86400.0


log = logging.getLogger(__name__)


def gravity_remark(body: Body, settings: ForcesSettings | None = None) -> str:
    """Say that a body has no known gravity field beside its mass; empty where one is known.

    settings  [forces], which may name a field; None: the motion is about a point mass
    """
    if body.gravity is not None or (settings is not None and settings.field is not None):
        return ""
    stands = f"its ellipsoid at even density stands for it, with J2 = {even_field(body).j2:.2g}"
    if settings is None:
        stands = "it is taken for a point mass"
    return (
        f"{body.name}: its body file has no [gravity], so no field of it is known; {stands}, and "
        f"its J2 may be wrong by as much as {unknown_j2(body):.2g}"
    )


def warn_of_unknown_gravity(body: Body, settings: ForcesSettings | None = None) -> None:
    """Warn where `gravity_remark` has something to say."""
    remark = gravity_remark(body, settings)
    if remark:
        log.warning("%s: add [gravity] to it, or name a field in [forces]", remark)


def unknown_j2(body: Body) -> float:
    """Bound J2 of a body without a known field: by shape, spin, or what slow bodies have."""
    shape = abs(even_field(body).j2)
    rate = float(np.radians(abs(body.rotation.meridian_deg_by_day[1]))) / DAYS_S
    spin = J2_OF_SPIN * rate**2 * body.radius_m**3 / body.gm_m3_s2
    return max(shape, spin, SLOW_J2)


def forces_left_out(forces: Forces, state: FloatArray, tdb_s: float, span_s: float) -> list[str]:
    """List what moves a craft and is not in the forces, each with its size over an arc.

    state  (6,) inertial at a time;  span_s  length of the arc

    Accelerations that turn with the motion move a craft for a radian of it, and then by the speed
    that they gave: half a t^2 at first, a t / rate later.
    """
    body, position = forces.motion.body, state[:3]
    distance = float(np.linalg.norm(position))
    rate = float(np.sqrt(forces.gm / distance**3))

    def sized(what: str, acceleration: float) -> str:
        moved = 0.5 * acceleration * min(span_s, 2.0 / rate) * span_s
        length = f"{moved / 1e3:.3g} km" if moved >= 1e3 else f"{moved:.2g} m"
        return f"{what}, {acceleration:.1g} m/s2 or {length} over the arc"

    remarks = []
    if gravity_remark(body, forces.settings):
        pull = 1.5 * forces.gm * body.radius_m**2 / distance**4
        remarks.append(
            sized(f"J2 of {body.name}, of which no field is known", unknown_j2(body) * pull)
        )
    beyond = f"the field beyond degree {forces.field.degree}"
    remarks.append(sized(beyond, forces.unmodelled(position).sigma_m_s2))
    if forces.settings.sunlight is None:
        sun = float(np.linalg.norm(forces.motion.position_m("sun", tdb_s)))
        pressure = TYPICAL_M2_KG * SUNLIGHT_N_M2 * (AU_M / sun) ** 2
        remarks.append(sized(f"sunlight on {TYPICAL_M2_KG:g} m2/kg", pressure))
    if body.atmosphere is not None:
        remarks.append(f"the drag of {body.name}'s air")
    planets = () if body.orbit is None else (body.orbit.around,)
    known = (*NEIGHBOURS.get(body.name, ()), *planets, "Sun")
    remarks.append(f"bodies other than {', '.join(dict.fromkeys(known))}")
    return remarks
