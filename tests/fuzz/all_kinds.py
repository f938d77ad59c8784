"""Imports every module of kinds, which registers them."""

from tests.fuzz.kinds import (
    catalogs,
    command_lines,
    configs,
    faults,
    kernels,
    meshes,
    pictures,
    places,
    rasters,
    runs,
    tables,
)

MODULES = (
    catalogs, command_lines, configs, faults, kernels, meshes, pictures, places, rasters, runs,
    tables,
)  # fmt: skip
