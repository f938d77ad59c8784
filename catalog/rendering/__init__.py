"""Pictures of terrain: shading, cast shadows, the Suns that can occur."""
