"""Small discs: their centre, size and phase in one picture."""
