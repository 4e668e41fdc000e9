"""English for the numbers and codes of stored results: one phrase for one fact.

Stages, the report, the lab, gates and the command line take their sentences from here.
"""
