"""Gymnasium both ways: its environments as tasks, and the suite's single-agent tasks as its environments.

Importing this package tells Gymnasium of those; it builds no game and imports no JAX.
"""

from adapters.gymnasium.export import register_all

register_all()
