"""Height and side velocity from two cameras that stand on a base."""
