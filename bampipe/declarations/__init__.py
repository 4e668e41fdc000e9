"""Reading and checks of device, effect, model and pipeline files, and exports of models."""
