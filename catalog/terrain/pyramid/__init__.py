"""A terrain model's averaged overviews, and windows of them."""
