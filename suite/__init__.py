"""The suite: `cli` starts it, each folder says in its first line what lives there."""
