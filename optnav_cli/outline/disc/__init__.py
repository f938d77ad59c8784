"""The small disc: brightness centre and apparent size."""
