"""The interface for programs and notebooks, exported lazily by :mod:`bampipe` itself."""
