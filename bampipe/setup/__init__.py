"""Mistakes in session and device files: found before any physics, and named as what they are."""
