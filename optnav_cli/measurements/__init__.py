"""What one picture shows by itself: the body's edge and its lit side, in pixels."""
