"""What tasks and tokenizers are to an agent: environments, batches of them, turns and tokens. It knows no game."""
