"""A benchmark of naming missing effects: recipes of sessions, their generator, and a scorer."""
