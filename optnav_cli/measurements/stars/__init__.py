"""Stars in a picture: spots, which stars they are, and the attitude that follows."""
