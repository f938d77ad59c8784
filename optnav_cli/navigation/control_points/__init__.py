"""Navigation by control points: prediction, matching, resection, acceptance."""
