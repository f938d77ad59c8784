"""Coordinate systems of rasters, brought to east longitudes from the body's own meridian.

A projected map's x is an easting whatever its longitudes count: under a label of west longitudes
the picture still has east on the right, and only the central meridian is a west longitude (USGS
ISIS, TProjection.cpp, PositiveWest). The x of a map in degrees is a longitude itself.
"""

import math
from typing import Any

import pyproj

from catalog.terrain.dem.georeference import Steps

GEOIDS = ("geoid", "selenoid", "gravity", "mean sea level", "egm", "orthometric")


def orient_eastward(wkt: str, affine: Steps, west: bool) -> tuple[str, Steps, float]:
    """Bring a coordinate system to east longitudes from 0, without its vertical part.

    affine  the raster's steps and corner, in the unit of the coordinate system
    west    the longitudes that the file states count westward
    Returns WKT, steps, and -1 where x itself counts westward, else 1.
    Raises ValueError for heights above a geoid, depths, westings and meridians that cannot be
    turned.
    """
    stated = pyproj.CRS.from_wkt(wkt)
    crs = _extract_horizontal(stated)
    directions = [axis.direction for axis in crs.axis_info]
    if crs.is_projected and "west" in directions:
        raise ValueError("its x counts westward; reproject it to eastings with gdalwarp")
    west = west or (crs.is_geographic and "west" in directions)
    meridian = crs.prime_meridian
    turn = 0.0
    if meridian is not None:
        turn = float(meridian.longitude) * float(meridian.unit_conversion_factor)
    if not west and turn == 0.0:
        return (wkt if crs == stated else crs.to_wkt()), affine, 1.0
    turned = pyproj.CRS.from_json_dict(
        _rotate_longitudes(crs.to_json_dict(), math.degrees(turn), west)
    )
    if not crs.is_geographic:
        return turned.to_wkt(), affine, 1.0
    sign = -1.0 if west else 1.0
    a, b, c, d, e, f = affine
    return turned.to_wkt(), (a, b, c + sign * turn / _get_radians_per_unit(crs), d, e, f), sign


def _extract_horizontal(crs: pyproj.CRS) -> pyproj.CRS:
    """The part of a system that says where a pixel lies; the vertical one must be plain heights."""
    if crs.is_compound and len(crs.sub_crs_list) > 1:
        crs, vertical = crs.sub_crs_list[:2]
        if any(word in vertical.name.lower() for word in GEOIDS):
            raise ValueError(f"its heights count from a geoid, '{vertical.name}'; convert them")
        if [axis.direction for axis in vertical.axis_info] == ["down"]:
            raise ValueError(f"its values are depths, '{vertical.name}'; negate them")
    if crs.is_bound and crs.source_crs is not None:
        crs = crs.source_crs
    return crs.to_2d() if crs.is_geographic and len(crs.axis_info) > 2 else crs


def _get_radians_per_unit(crs: pyproj.CRS) -> float:
    """Radians in a unit of a map in degrees."""
    return float(crs.axis_info[0].unit_conversion_factor)


def _rotate_longitudes(crs: dict[str, Any], turn_deg: float, west: bool) -> dict[str, Any]:
    """A system in PROJJSON with its longitudes eastward from 0."""
    base = crs.get("base_crs", crs)
    for datum in (base.get("datum"), base.get("datum_ensemble")):
        if datum is not None:
            datum.pop("prime_meridian", None)
    for axis in crs["coordinate_system"]["axis"]:
        axis["direction"] = axis["direction"].replace("west", "east")
    longitudes = [
        parameter
        for parameter in crs.get("conversion", {}).get("parameters", [])
        if parameter["name"].startswith("Longitude of")
    ]
    if "base_crs" in crs and not longitudes:
        raise ValueError("its projection has no central meridian; reproject it with gdalwarp")
    for parameter in longitudes:
        unit = parameter.get("unit", "degree")
        per_deg = 1.0 if unit == "degree" else 1.0 / math.degrees(unit["conversion_factor"])
        east = -parameter["value"] if west else parameter["value"]
        parameter["value"] = east + turn_deg * per_deg
    crs.pop("id", None)
    return crs
