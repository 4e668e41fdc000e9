"""The report: stored results in words, tables and figures; nothing is computed here."""
