"""All sessions of a lab side by side: one data set, and how the device changed over time."""
