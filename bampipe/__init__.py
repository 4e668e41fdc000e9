"""bampipe: from raw trial logs of a manipulator to a mechanical model that people trust."""

__version__ = "0.1.0"
