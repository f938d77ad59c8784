"""Pictures of a body given as a closed mesh, from anywhere, under one Sun."""
