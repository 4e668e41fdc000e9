"""A session: what ``session.toml`` says about the channels and the trials, checked.

Everything that can be known from the session file alone is checked here, and a mistake raises
:class:`bampipe.errors.InputError` naming file, field, what was found and what is expected. What
is wrong with one trial's file is the reader's and the quality rules' business.
"""

from bampipe.data.session.channels import (
    SECONDS,
    Brake,
    Channel,
    Clock,
    Encoder,
    Force,
    Velocity,
)
from bampipe.data.session.file import read_session, session_from
from bampipe.data.session.places import inside, is_device_path, lexically_inside
from bampipe.data.session.records import FILE_NAME, Session, TrialEntry

__all__ = [
    "FILE_NAME",
    "SECONDS",
    "Brake",
    "Channel",
    "Clock",
    "Encoder",
    "Force",
    "Session",
    "TrialEntry",
    "Velocity",
    "inside",
    "is_device_path",
    "lexically_inside",
    "read_session",
    "session_from",
]
