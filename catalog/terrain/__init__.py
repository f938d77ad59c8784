"""Terrain models: files read and averaged, heights sampled, skylines and ray casts."""
