"""The trial to record next: designs that a person can follow, tried on the fitted model."""
