"""The only path from the samples of a trial to its residual, for all stages."""
