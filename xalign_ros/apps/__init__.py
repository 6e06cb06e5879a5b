"""The command line and the live node: they wire io to core."""
