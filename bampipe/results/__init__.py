"""Every JSON file that bampipe writes, declared once: one module per file.

A record (:mod:`bampipe.results.record`) is what a stage builds, what ``RunFolder.read`` returns,
and what the JSON Schema in ``schemas/`` is generated from (``python .ci/write_schemas.py``).
The records are pydantic's, rather than msgspec's or dataclasses: pydantic reports every fault of
a file at once, with its place, and writes JSON Schema. It takes a tenth of a second to import, so
the command line imports these modules only where a result is read.
"""
