"""Device, effect and model files read and checked."""
