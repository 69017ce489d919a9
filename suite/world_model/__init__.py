"""The transformer world model, how it is trained, and dreams: the environment that it is."""
