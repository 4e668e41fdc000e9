"""Drafts of formulas for a residual that no effect of the library explains."""
