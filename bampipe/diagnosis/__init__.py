"""The diagnosis: the effects that a model lacks, by one likelihood, one search and one rule."""
