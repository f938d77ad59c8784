"""Seeded relief below a model's posting: craters and fractal ground."""
