"""The ground that pictures of a small body are taken of: its shape model, refined and roughened."""

from pathlib import Path

import numpy as np

from catalog.bodies.body import Body
from catalog.errors import ConfigError
from catalog.terrain.mesh.rays import MeshRays
from catalog.terrain.mesh.refine import FINEST_FACES, refined, roughened
from catalog.terrain.mesh.shape import load_shape
from catalog.terrain.synthetic.relief import SyntheticRelief
from optnav_cli.simulation.scenario import ShapeScenario


class TruthMesh:
    """The meshes of a scenario, one a seed; the last one asked for is kept.

    Raises ConfigError or DataError for a shape model that cannot be used.
    """

    def __init__(self, scenario: ShapeScenario, body: Body) -> None:
        self._scenario, self._body = scenario, body
        model = load_shape(scenario.mesh, Path.cwd(), body)
        smallest = scenario.detail.smallest_m
        # halved until there are about two edges to the finest relief
        halvings = max(0, round(float(np.log2(2.0 * model.posting_m / smallest))))
        if len(model.faces) * 4**halvings > FINEST_FACES:
            raise ConfigError(
                f"[detail] smallest_m is {smallest:g}, for which the {len(model.faces)} faces of "
                f"{Path(scenario.mesh.path).name} would become {len(model.faces) * 4**halvings}; "
                f"up to {FINEST_FACES} are possible: raise it"
            )
        self._model_posting_m = model.posting_m
        self._shape = refined(model, halvings)
        self.posting_m = self._shape.posting_m
        self._kept: tuple[int | None, MeshRays] | None = None

    def ground(self, seed: int | None) -> MeshRays:
        """The mesh of a seed, with its relief; without any for None."""
        if self._kept is None or self._kept[0] != seed:
            self._kept = None  # let go of the old one before the new one is made
            shape = self._shape
            if seed is not None:
                shape = roughened(shape, self._detail(seed))
            self._kept = seed, MeshRays(shape.vertices[shape.faces])
        return self._kept[1]

    def _detail(self, seed: int) -> SyntheticRelief:
        settings = self._scenario.detail
        return SyntheticRelief(
            seed, self._model_posting_m, self._body.radius_m,
            smallest_m=min(settings.smallest_m, self._model_posting_m),
            rms_slope_deg=settings.rms_slope_deg, saturation=settings.saturation,
        )  # fmt: skip
