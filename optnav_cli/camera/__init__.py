"""Camera models: from a direction to a pixel and back."""
