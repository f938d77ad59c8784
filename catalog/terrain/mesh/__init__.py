"""Bodies given as closed triangle meshes: reading, mending, checking, rays and heights."""
