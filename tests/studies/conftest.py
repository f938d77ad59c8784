"""Worlds and fields of the observer's tests, for the studies' tests too."""

from tests.optnav_cli.conftest import field_of, layer_of, rough_world  # noqa: F401 -- fixtures
