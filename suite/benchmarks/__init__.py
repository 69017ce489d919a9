"""What `suite bench` measures: each phase's time and rate, and comparisons between two ways of doing the same."""
