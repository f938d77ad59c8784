"""Pure geometry: no files, no bodies, no cameras."""
