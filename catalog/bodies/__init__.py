"""What is known of a body as a whole: size, mass, how it turns, where its Sun stands."""
