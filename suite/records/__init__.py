"""A run's record: its files, their schema and tables, checkpoints, and what it ran on."""
