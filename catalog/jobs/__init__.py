"""Long work in pieces: work folders, chunks, workers, clusters; nothing here knows terrain."""

MAX_WORKERS = 1024  # processes of a build; more are a slip of the hand
