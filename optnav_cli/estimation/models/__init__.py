"""Measurement models: residuals, Jacobian and weights of one kind of measurement each."""
