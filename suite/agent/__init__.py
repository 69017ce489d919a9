"""The agent: its parts and phases, the order of Algorithm 1, the one rollout and the replay buffer.

It may import policies, world models, tokenizers and the interface, and knows no game, no baseline and no leaderboard.
"""
