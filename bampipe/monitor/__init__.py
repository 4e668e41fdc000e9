"""An identified model that watches its device while it runs."""
