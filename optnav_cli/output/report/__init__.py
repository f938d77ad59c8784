"""One HTML page, with everything in it, about a run or a catalog."""
