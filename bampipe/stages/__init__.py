"""The stages: one file is one stage; see :mod:`bampipe.stages.base` for the contract."""
