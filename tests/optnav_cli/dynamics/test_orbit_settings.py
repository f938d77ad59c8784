"""[forces] as a file says it."""

import numpy as np
import pytest

from catalog.config import parse_toml
from catalog.errors import ConfigError
from optnav_cli.dynamics.orbit_settings import ForcesSettings, ThrustArc

ARC = """
[[thrust]]
start_utc = "2026-01-01T00:00:00Z"
end_utc = "{end}"
acceleration_m_s2 = [0.0, 2.0, 0.0]
size_sigma = 0.01
direction_sigma_deg = 0.5
"""


def test_a_thrust_arc_that_ends_before_it_begins_is_refused():
    good = parse_toml(ARC.format(end="2026-01-01T00:05:00Z"), ForcesSettings, "orbit.toml")
    good.check()
    start, end = good.thrust[0].times_s
    assert end - start == pytest.approx(300.0)
    for end, words in (("2025-12-31T00:00:00Z", "exchange them"), ("soon", "not understood")):
        bad = parse_toml(ARC.format(end=end), ForcesSettings, "orbit.toml")
        with pytest.raises(ConfigError, match=f"number 1.*{words}"):
            bad.check()


def test_the_errors_of_a_thrust_lie_along_and_across_it():
    arc = ThrustArc(start_utc="", end_utc="", acceleration_m_s2=(0.0, 2.0, 0.0))
    across = 2.0 * np.radians(0.5)
    assert np.allclose(arc.covariance, np.diag([across**2, 0.02**2, across**2]))
