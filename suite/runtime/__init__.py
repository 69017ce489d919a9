"""What every other folder may use: errors, progress on the terminal, compilation and the cache folder."""
