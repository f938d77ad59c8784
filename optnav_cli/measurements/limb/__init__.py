"""The lit limb of a body in one picture."""
