"""Two map grids against each other: no cameras, no files."""
