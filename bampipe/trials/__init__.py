"""Trials on their way from samples to residual, for every stage alike."""
