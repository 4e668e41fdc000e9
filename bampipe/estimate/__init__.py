"""Estimators, which depend only on arrays and callables, not on physics or data files."""
