"""One file, one section: its ``TITLE``, and ``list_blocks(results)``, no block where irrelevant."""

SECTIONS: tuple[str, ...] = (
    "summary",
    "trials",
    "stiffness",
    "identification",
    "equations",
    "trust",
    "viscous",
    "device",
    "validation",
    "diagnosis",
    "drafts",
    "next_trial",
    "effects",
    "ladder",
    "published",
    "provenance",
)
"""The sections, in the order in which they are printed."""
