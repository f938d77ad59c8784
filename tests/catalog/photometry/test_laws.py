"""The simple laws: limits, reversibility, and McEwen's numbers."""

import math

import numpy as np
import pytest

from catalog.errors import ConfigError
from catalog.photometry.laws import (
    LAWS,
    find_law,
    lambert,
    lambert_scalar,
    lommel_seeliger,
    lommel_seeliger_scalar,
    lunar_lambert,
    lunar_lambert_scalar,
)

RNG = np.random.default_rng(11)
MU0, MU = RNG.uniform(0.01, 1.0, (2, 2000))
COS_G = MU0 * MU + np.sqrt((1 - MU0**2) * (1 - MU**2)) * np.cos(RNG.uniform(0, np.pi, 2000))


@pytest.mark.parametrize("name", LAWS)
def test_every_law_is_reversible_positive_and_dark_at_night(name):
    law = find_law(name)
    values = law(MU0, MU, COS_G)
    assert (values >= 0.0).all()
    assert values.shape == MU0.shape
    np.testing.assert_allclose(values / MU0, law(MU, MU0, COS_G) / MU, rtol=1e-10)
    assert (law([-0.1, 0.0, 0.4], [0.5, 0.5, -1e-3], 0.1) == 0.0).all()


@pytest.mark.parametrize("law", [lommel_seeliger, lunar_lambert, lambert])
def test_the_albedo_is_the_brightness_from_above_at_noon(law):
    assert law(1.0, 1.0, 1.0, 0.2) == pytest.approx(0.2)


@pytest.mark.parametrize(
    ("law", "scalar", "takes_phase"),
    [
        (lommel_seeliger, lommel_seeliger_scalar, 0),
        (lunar_lambert, lunar_lambert_scalar, 1),
        (lambert, lambert_scalar, 0),
    ],
)
def test_arrays_and_single_values_agree(law, scalar, takes_phase):
    for mu0, mu, cos_g in zip(MU0[:50], MU[:50], COS_G[:50], strict=True):
        arguments = (mu0, mu, cos_g, 0.12) if takes_phase else (mu0, mu, 0.12)
        single = scalar(*(float(a) for a in arguments))
        assert float(law(mu0, mu, cos_g, 0.12)) == pytest.approx(single, rel=1e-14)


def test_lunar_lambert_is_lommel_seeliger_at_full_moon():
    np.testing.assert_allclose(lunar_lambert(MU0, MU, 1.0), lommel_seeliger(MU0, MU, 1.0))


def test_lunar_lambert_at_thirty_degrees_is_what_isis_normalises_by():
    """ISIS: L(30) = 1 - 0.019*30 + 0.000242*30^2 - 0.00000146*30^3; i = 30 deg, e = 0."""
    cos30 = math.cos(math.radians(30.0))
    weight = 0.60838
    expected = 2 * weight * cos30 / (1 + cos30) + (1 - weight) * cos30
    assert lunar_lambert(cos30, 1.0, cos30, 1.0) == pytest.approx(expected, rel=1e-6)


def test_a_law_that_does_not_exist_is_named_with_those_that_do():
    with pytest.raises(ConfigError, match=r"'lunar'.*hapke.*lambert"):
        find_law("lunar")
