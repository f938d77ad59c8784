"""Imports every module of kinds, which registers them."""

from tests.fuzz.kinds import command_lines, configs, faults, pictures, places, tables

MODULES = (command_lines, configs, faults, pictures, places, tables)
