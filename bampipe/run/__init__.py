"""The runner: order, cache by content, provenance, quality gates, several sessions at once."""
