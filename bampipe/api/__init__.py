"""What programs and notebooks call; exported, as it is needed, by :mod:`bampipe` itself."""
