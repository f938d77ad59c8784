"""Pictures with known positions: a flight over terrain that is richer than a catalog's model."""
