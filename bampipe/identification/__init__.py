"""Parameters of a model from its trials: estimators, sensor noise, identifiability."""
