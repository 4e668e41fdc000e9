"""Files in and out: the session, the trial readers, the quality rules, the store."""
