"""A session: what ``session.toml`` says about the channels and the trials, checked.

Everything that can be known from the session file alone is checked here, and a mistake raises
:class:`bampipe.errors.InputError` naming file, field, what was found and what is expected. What
is wrong with one trial's file is the reader's and the quality rules' business.
"""

from bampipe.data.session.channels import SECONDS, Channel, Clock, Encoder, Register
from bampipe.data.session.file import Part, Session, TrialEntry, inside, read_session, session_from

__all__ = [
    "SECONDS",
    "Channel",
    "Clock",
    "Encoder",
    "Part",
    "Register",
    "Session",
    "TrialEntry",
    "inside",
    "read_session",
    "session_from",
]
