"""One training run from start to end, its evaluation, many runs in a sweep, and policies from outside."""
