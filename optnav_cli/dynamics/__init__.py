"""How a craft moves without thrust about a body."""
