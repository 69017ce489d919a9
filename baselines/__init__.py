"""The agents, as changes of the configuration, and the presets, which scale sizes and counts to a machine."""
