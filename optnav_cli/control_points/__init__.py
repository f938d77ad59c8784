"""Control points in pictures: match, error model, acceptance."""
