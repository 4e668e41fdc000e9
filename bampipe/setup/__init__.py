"""Detection of mistakes in session and device files, before any physics is identified."""
