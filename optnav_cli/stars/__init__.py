"""Stars: spots, identification, attitude and zenith distances."""
