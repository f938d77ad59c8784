"""Long work in pieces: work folders, chunks, workers, clusters; nothing here knows terrain."""
