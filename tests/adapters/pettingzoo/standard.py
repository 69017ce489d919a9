"""PettingZoo's own tests of an environment."""

from __future__ import annotations

import warnings

from adapters.pettingzoo import export

with warnings.catch_warnings():
    warnings.simplefilter("ignore", DeprecationWarning)  # it makes environments in its own old way
    from pettingzoo.test import api_test, seed_test


def check(task):
    with warnings.catch_warnings():
        # It knows by name which games observe a dictionary; a mask or an observation may be all zeros.
        warnings.filterwarnings("ignore", ".*should be gymnasium.spaces.box or|.*not a NumPy array|.*is all zeros")
        api_test(export.env(task, render_mode="ansi"), num_cycles=20)
    seed_test(lambda: export.env(task), num_cycles=10)
