"""What people do with a catalog: compare, export, draw and summarise it."""
