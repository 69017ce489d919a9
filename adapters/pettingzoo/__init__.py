"""PettingZoo both ways: its games of two players as tasks, and the suite's as its environments."""
