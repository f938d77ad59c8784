"""Terms that the rotation study finds, in a made difference and in a real one."""

import tomllib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from catalog.bodies.body import CorrectionTerm, RotationCorrection
from catalog.bodies.rotation import body_from_inertial
from catalog.progress import SilentProgress
from tests.studies import rotation
from tests.studies.rotation import RotationFit, format_toml, report, run

MADE = RotationCorrection(
    years=(2000.0, 2010.0),
    error_m=0.0,
    x_arcsec_by_century=(3.0, 0.0, 0.0),
    y_arcsec_by_century=(0.0, 20.0, 0.0),
    z_arcsec_by_century=(0.0, 0.0, 100.0),
    terms=(
        # one of no combination of the Moon's arguments, and 2F - 2D
        CorrectionTerm((10.0, 36525.0 * 360.0 / 41.3, 0.0), (2.0, 0.0, 1.0), (0.0, -1.0, 0.0)),
        CorrectionTerm((278.9, 75870.16, 0.0), (0.0, 0.0, 4.0), (0.0, 0.5, 0.0)),
    ),
)


class MadeKernels:
    """Stands for kernels: the published series turned by a correction that is known."""

    def __init__(self, body, kernels):
        self.body, self.name = replace(body, rotation_correction=MADE), "made"

    def body_from_inertial(self, tdb_s):
        return body_from_inertial(self.body, tdb_s)


@pytest.fixture(scope="module")
def fit() -> RotationFit:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rotation, "SpiceEphemeris", MadeKernels)
        return run(SilentProgress(), "moon", [], (2000.0, 2010.0), 2)


def test_known_terms_are_found_again(fit: RotationFit) -> None:
    assert fit.before_m[0] > 30.0
    # a frequency is found to 1e-3 turns in the span: 1/300 of an amplitude of 2" (18 m), twice
    assert fit.after_m[1] < 0.12
    strongest, other = fit.lines
    assert strongest.name == (0, 0, 2, -2, 0)
    assert other.name is None
    assert 360.0 * 36525.0 / other.angle[1] == pytest.approx(41.3, rel=2e-5)


def test_what_is_printed_is_a_section_of_a_body_file(fit: RotationFit) -> None:
    section = tomllib.loads(format_toml(fit))["rotation_correction"]
    assert msgspec.convert(section, RotationCorrection) == fit.correction
    assert "# 2F - 2D, 173.3" in format_toml(fit)
    assert "from 2000" in report(fit).to_text()


def test_thirty_terms_tell_most_of_the_moons_real_difference(
    shared_data: Callable[[str], Path],
) -> None:
    pytest.importorskip("spiceypy", reason="needs spiceypy")
    names = ("moon_080317.tf", "moon_pa_de421_1900-2050.bpc")
    kernels = [shared_data(f"spice/{name}") for name in names]
    fit = run(SilentProgress(), "moon", kernels, (1995.0, 2015.0), 30)
    assert 70.0 < fit.before_m[0] < 90.0
    assert fit.after_m[0] < fit.before_m[0] / 12.0  # 120 terms over 150 years: a hundredth
    assert fit.correction.error_m >= np.max(fit.axes_m)
