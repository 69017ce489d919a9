"""What `suite bench` measures: each phase's time and rate, and races between two ways of doing the same."""
