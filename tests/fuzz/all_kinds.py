"""Imports every module of kinds, which registers them."""

from tests.fuzz.kinds import (
    catalogs,
    command_lines,
    configs,
    designs,
    faults,
    kernels,
    labels,
    landings,
    map_words,
    meshes,
    orbits,
    pictures,
    places,
    rasters,
    readers,
    runs,
    sights,
    surroundings,
    tables,
)

MODULES = (
    catalogs, command_lines, configs, designs, faults, kernels, labels, landings, map_words, meshes,
    orbits, pictures, places, rasters, readers, runs, sights, surroundings, tables,
)  # fmt: skip
