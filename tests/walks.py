"""A random walk on the host, whose environment remembers its engines."""

from __future__ import annotations

import numpy as np

from suite.interface.environment import EnvironmentSpec, ObservationSpec
from suite.interface.host import HostEnvironment, HostStep

WALK = EnvironmentSpec(
    id="walk",
    observation=ObservationSpec(shape=(2,), high=9, kind="symbols"),
    num_actions=2,
    reward_classes=(0.0, 1.0),
)


class Walk:
    """From 4 to 0 or 9: up or down as the action says, by 0, 1 or 2 as the seed says. 9 pays."""

    def __init__(self):
        self.resets = 0

    def reset(self, seed):
        self.resets += 1
        self.random = np.random.default_rng(seed)
        self.position = 4
        return self._show()

    def step(self, action):
        distance = self.random.integers(3) * (1 if action else -1)
        self.position = int(np.clip(self.position + distance, 0, 9))
        return self._show()

    def _show(self):
        observation = np.array([self.position, self.random.bit_generator.state["state"]["state"] % 10], np.uint8)
        return HostStep(observation, float(self.position == 9), self.position in (0, 9), False)


class Walks(HostEnvironment):
    """Remembers its engines."""

    def __init__(self, limit=20):
        self.engines = []

        def make_engine():
            self.engines.append(Walk())
            return self.engines[-1]

        super().__init__(WALK, make_engine, limit)

    @property
    def resets(self):
        return sum(engine.resets for engine in self.engines)
