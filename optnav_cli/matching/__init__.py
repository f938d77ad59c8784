"""Control points against a picture: what is in view, what it should look like, where it is."""
