"""Every registered task keeps the environment contract; and the check itself can fail."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import pytest

from suite.registry import tasks
from tests.contract import check_environment
from tests.tiny import Corridor, Pennies

STEPS = {"minatar/freeway": 2_510}  # its episodes all last 2,500
ELSEWHERE = {"craftax_classic", "craftax_full"}  # minutes to compile: where their rare events are prepared as well


@pytest.mark.parametrize("id", sorted(tasks()))
def test_a_registered_task_is_what_its_specification_says(id):
    environment = tasks()[id].make()()
    assert environment.spec == tasks()[id].spec()
    assert environment.spec.id == id


@pytest.mark.parametrize("id", sorted(tasks().keys() - ELSEWHERE))
def test_registered_task(id):
    environment = tasks()[id].make()()
    assert check_environment(environment, jax.random.key(0), steps=STEPS.get(id, 250)).ended.any()


@pytest.mark.parametrize("environment", [Corridor(), Pennies()], ids=["corridor", "pennies"])
def test_tiny(environment):
    assert check_environment(environment, jax.random.key(0), steps=40).ended.any()


class Rewards(Corridor):
    """Pays what belongs to no class."""

    def step(self, key, state, action):
        state, shown = super().step(key, state, action)
        return state, shown.replace(reward=shown.reward * 3)


class BothFlags(Corridor):
    def step(self, key, state, action):
        state, shown = super().step(key, state, action)
        return state, shown.replace(truncated=shown.truncated | shown.terminated)


class Weak(Corridor):
    """A step whose state has another type than a reset's."""

    def step(self, key, state, action):
        state, shown = super().step(key, state, action)
        return state.replace(time=state.time.astype(jnp.float32)), shown


class TooBright(Corridor):
    spec = dataclasses.replace(
        Corridor.spec, observation=dataclasses.replace(Corridor.spec.observation, high=1, kind="grid")
    )


class UntiledPatches(Corridor):
    spec = dataclasses.replace(Corridor.spec, observation=dataclasses.replace(Corridor.spec.observation, patch=(3, 3)))


class MissingStatistic(Corridor):
    spec = dataclasses.replace(Corridor.spec, statistics=Corridor.spec.statistics[:2])


class SelfResetting(Corridor):
    """Begins anew by itself, so that the last frame is lost."""

    def step(self, key, state, action):
        state, shown = super().step(key, state, action)
        return state, shown.replace(first=shown.terminated)


@pytest.mark.parametrize(
    "broken", [Rewards, BothFlags, Weak, TooBright, UntiledPatches, MissingStatistic, SelfResetting]
)
def test_broken_environments_are_found(broken):
    with pytest.raises(AssertionError):
        check_environment(broken(), jax.random.key(0), steps=40)
