"""Which effects a model lacks: one likelihood, one search over sets, one rule."""
