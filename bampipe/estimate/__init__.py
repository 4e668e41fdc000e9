"""Estimators: they see callables and arrays only, never the physics or the data."""
