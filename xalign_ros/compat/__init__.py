"""Other programs' names for what the core does."""
