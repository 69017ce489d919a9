"""The actor-critic, its networks and PPO."""
