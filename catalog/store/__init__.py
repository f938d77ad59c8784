"""The catalog file: one GeoPackage of control points and their height pyramids."""
