"""Navigation by discs that are too small for a limb."""
