"""Sessions of a simulated device, with a hidden effect where one is wanted."""
