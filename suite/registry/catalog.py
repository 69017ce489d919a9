"""The families, tasks, agents and presets of this distribution. Importing this imports neither JAX nor any game.

A task is registered here and nowhere else: its rules (an adapter), its scores, the sizes it is run with, its title and
its family. Everything else that knows tasks asks the registry.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from suite.registry.entries import AgentEntry, FamilyEntry, Lazy, Made, PresetEntry, TaskEntry

FAMILIES = (
    FamilyEntry("craftax_classic", "Craftax-classic", ("craftax_classic",), "reward_percent"),
    FamilyEntry("craftax_full", "Craftax (full)", ("craftax_full",), "reward_percent"),
    FamilyEntry(
        "minatar", "MinAtar", ("minatar/asterix", "minatar/breakout", "minatar/freeway", "minatar/space_invaders")
    ),
    FamilyEntry(
        "openspiel",
        "OpenSpiel",
        ("openspiel/tic_tac_toe", "openspiel/leduc", "openspiel/bargaining"),
        "normalized_return",
    ),
    FamilyEntry("gymnasium", "Gymnasium"),
    FamilyEntry("pettingzoo", "PettingZoo"),
)


def _presets(module: str, **functions: str) -> Mapping[str, Lazy]:
    """Functions of a module of `baselines.presets`, by the name of the preset that each of them makes."""
    return {name: Lazy(f"baselines.presets.{module}:{function}") for name, function in functions.items()}


def _game(name: str, summary: str = "", cost: str = "", small: str = "openspiel_small") -> TaskEntry:
    return TaskEntry(
        id=f"openspiel/{name}",
        family="openspiel",
        summary=summary or f"{name} of OpenSpiel against a uniform opponent, both seats",
        spec=Made("adapters.openspiel.task:spec", (name,)),
        make=Lazy("adapters.openspiel.task:make", (name,)),
        scores=Lazy("leaderboards.scoring:games"),
        presets=_presets("openspiel", paper="openspiel_paper", small=small, smoke="openspiel_smoke"),
        text=Lazy("adapters.openspiel.library:told", (name,)),
        cost=cost,
    )


def _minatar(
    name: str,
    summary: str,
    cost: str = "small on one CPU core: m6 7 to 10 min, m5 6 to 8, mfrl 1, 1.9 GiB",
    sizes: str = "minatar",
) -> TaskEntry:
    return TaskEntry(
        id=f"minatar/{name}",
        family="minatar",
        summary=summary,
        spec=Made("adapters.minatar:spec", (name,)),
        make=Lazy("adapters.minatar:make", (name,)),
        scores=Lazy("leaderboards.scoring:returns"),
        presets=_presets(
            "minatar", paper="minatar_paper", medium=f"{sizes}_medium", small=f"{sizes}_small", smoke="minatar_smoke"
        ),
        cost=cost,
    )


def _foreign(family: str, name: str, scores: str) -> TaskEntry:
    return TaskEntry(
        id=f"{family}/{name}",
        family=family,
        summary=f"{name} of {family}",
        spec=Made(f"adapters.{family}.task:spec", (name,)),
        make=Lazy(f"adapters.{family}.task:make", (name,)),
        scores=Lazy(f"leaderboards.scoring:{scores}"),
        presets=_presets("foreign", small="foreign_small", smoke="foreign_smoke"),
    )


# Families with more tasks than are listed: any game of the library by its id.
OPEN_FAMILIES: dict[str, Callable[[str], TaskEntry]] = {
    "openspiel": _game,
    "gymnasium": lambda name: _foreign("gymnasium", name, "returns"),
    "pettingzoo": lambda name: _foreign("pettingzoo", name, "games"),
}

TASKS = (
    _game(
        "tic_tac_toe",
        "tic-tac-toe against a uniform opponent, both seats: 27 symbols, 9 actions",
        "small on two CPU cores: m5 5 min, mfrl 0.1, 0.8 GiB",
    ),
    _game(
        "leduc",
        "Leduc poker against a uniform opponent, both seats: 16 symbols, 3 actions, 6 chance outcomes",
        "small on two CPU cores: m5 5 min, mfrl 0.4, 1.3 GiB",
    ),
    _game(
        "bargaining",
        "bargaining, uniform opponent, both seats: 93 symbols, 121 actions, 1002 chance outcomes",
        "small on two CPU cores: m5 4 min, mfrl 0.3, 1.6 GiB",
        small="bargaining_small",
    ),
    _minatar("asterix", "MinAtar's Asterix: gold and enemies; 10x10x4, 5 actions"),
    _minatar("breakout", "MinAtar's Breakout; 10x10x4, 3 actions"),
    _minatar("freeway", "MinAtar's Freeway: cross between cars; 10x10x7, 3 actions", sizes="freeway"),
    _minatar(
        "seaquest",
        "MinAtar's Seaquest, not among the paper's; 10x10x10, 6 actions",
        cost="small on one busy CPU core: m5 13 min, mfrl 6, 1.8 GiB",
    ),
    _minatar("space_invaders", "MinAtar's Space Invaders; 10x10x6, 4 actions"),
    TaskEntry(
        id="craftax_classic",
        family="craftax_classic",
        title="Craftax-classic",
        summary="Craftax-classic from 63x63 pixels: 17 actions, 22 achievements",
        spec=Lazy("adapters.craftax.task:CLASSIC_SPEC"),
        make=Lazy("adapters.craftax.task:make_classic"),
        scores=Lazy("leaderboards.scoring:craftax"),
        presets=_presets(
            "craftax",
            paper="paper",
            medium="craftax_classic_medium",
            small="craftax_classic_small",
            smoke="craftax_classic_smoke",
        ),
        own_auto_reset=Lazy("adapters.craftax.task:classic_built_in_auto_reset"),
        symbols=Lazy("adapters.craftax.symbols:classic_symbols"),
        symbol_values=17,
        cost="small on one CPU core: m5 7 min, m3, m4 9, m1, m2 20, mfrl 2, random 1, 2.3 GiB; paper: an accelerator",
    ),
    TaskEntry(
        id="craftax_full",
        family="craftax_full",
        title="Craftax (full)",
        summary="Craftax (full) from 130x110 pixels: 43 actions, 67 achievements worth 226",
        spec=Lazy("adapters.craftax.task:FULL_SPEC"),
        make=Lazy("adapters.craftax.task:make_full"),
        scores=Lazy("leaderboards.scoring:craftax"),
        presets=_presets(
            "craftax",
            paper="craftax_full_paper",
            medium="craftax_full_medium",
            small="craftax_full_small",
            smoke="craftax_full_smoke",
        ),
        own_auto_reset=Lazy("adapters.craftax.task:full_built_in_auto_reset"),
        cost="compiles for 1 min at first; small on one CPU core: m5 10 min, mfrl 5, 3.5 GiB; paper: an accelerator",
        paper_agent="m5_slow",
    ),
)

AGENTS = (
    AgentEntry("random", Lazy("baselines.random_policy:random"), "uniform over actions, learns nothing"),
    AgentEntry(
        "mfrl",
        Lazy("baselines.model_free:mfrl"),
        "PPO with a GRU on real play only",
        "Table 1, Our best MFRL",
        "reward 55.49 +- 1.33 %, score 16.77 +- 1.11 %",
        55.6,
    ),
    AgentEntry(
        "mfrl_no_rnn",
        Lazy("baselines.model_free:mfrl_no_rnn"),
        "mfrl without the GRU",
        "Table 2, Remove RNN",
        "reward 41.82 +- 0.97 %, score 8.33 +- 0.44 %",
    ),
    AgentEntry(
        "mfrl_small",
        Lazy("baselines.model_free:mfrl_small"),
        "mfrl with a smaller network",
        "Table 2, Smaller model",
        "reward 51.35 +- 0.80 %, score 12.93 +- 0.56 %",
    ),
    AgentEntry(
        "mfrl_prior",
        Lazy("baselines.model_free:mfrl_prior"),
        "the PPO of Moon et al. (2023), no memory",
        "Table 1, Previous best MFRL",
        "reward 47.40 +- 0.58 %, score 10.71 +- 0.29 %",
        4.0,
    ),
    AgentEntry(
        "m1",
        Lazy("baselines.ladder:m1"),
        "VQ-VAE, token by token, imagination only",
        "Table 1, M1: Baseline",
        "reward 31.93 +- 2.22 %, score 4.98 +- 0.50 %",
        60.0,
    ),
    AgentEntry(
        "m2",
        Lazy("baselines.ladder:m2"),
        "m1 that learns from real play too (Dyna)",
        "Table 1, M2: M1 + Dyna",
        "reward 43.36 +- 1.84 %, score 8.85 +- 0.63 %",
        60.0,
    ),
    AgentEntry(
        "m3",
        Lazy("baselines.ladder:m3"),
        "m2 with a VQ-VAE of patches",
        "Table 1, M3: M2 + patches",
        "reward 58.92 +- 1.03 %, score 19.36 +- 1.42 %",
        56.6,
    ),
    AgentEntry(
        "m4",
        Lazy("baselines.ladder:m4"),
        "m3 with nearest-neighbor tokens",
        "Table 1, M4: M3 + NNT",
        "reward 64.96 +- 1.13 %, score 25.55 +- 0.86 %",
        58.5,
    ),
    AgentEntry(
        "m5",
        Lazy("baselines.ladder:m5"),
        "m4 with block teacher forcing",
        "Table 1, M5: M4 + BTF (fast)",
        "reward 67.42 +- 0.55 %, score 27.91 +- 0.63 %",
        58.5,
    ),
    AgentEntry(
        "m5_slow",
        Lazy("baselines.ladder:m5_slow"),
        "m5 with eight times the world-model updates",
        "Table 1, M5: M4 + BTF (slow)",
        "reward 69.66 +- 1.20 %, score 31.77 +- 1.43 %",
        58.5,
    ),
    AgentEntry(
        "m5_patch5",
        Lazy("baselines.ablations:m5_patch5"),
        "m5 on patches of 5x5",
        "Table 2, 5x5 quantized",
        "reward 57.28 +- 1.14 %, score 18.26 +- 1.18 %",
    ),
    AgentEntry(
        "m5_patch9",
        Lazy("baselines.ablations:m5_patch9"),
        "m5 on patches of 9x9",
        "Table 2, 9x9 quantized",
        "reward 45.55 +- 0.88 %, score 10.12 +- 0.40 %",
    ),
    AgentEntry(
        "m5_continuous",
        Lazy("baselines.ablations:m5_continuous"),
        "m5 that regresses patches",
        "Table 2, 7x7 continuous",
        "reward 21.20 +- 0.55 %, score 2.43 +- 0.09 %",
    ),
    AgentEntry(
        "m5_no_dyna",
        Lazy("baselines.ablations:m5_no_dyna"),
        "m5 that learns from imagination only",
        "Table 2, Remove Dyna",
        "reward 55.02 +- 5.34 %, score 18.79 +- 2.14 %",
    ),
    AgentEntry(
        "m5_no_nnt",
        Lazy("baselines.ablations:m5_no_nnt"),
        "m5 with a VQ-VAE of patches",
        "Table 2, Remove NNT",
        "reward 60.66 +- 1.38 %, score 21.79 +- 1.33 %",
    ),
    AgentEntry(
        "m5_no_nnt_no_patches",
        Lazy("baselines.ablations:m5_no_nnt_no_patches"),
        "m5 with a VQ-VAE of frames",
        "Table 2, Remove NNT & patches",
        "reward 45.86 +- 1.42 %, score 10.36 +- 0.69 %",
    ),
    AgentEntry(
        "m5_no_btf",
        Lazy("baselines.ablations:m5_no_btf"),
        "the same as m4",
        "Table 2, Remove BTF",
        "reward 64.96 +- 1.13 %, score 25.55 +- 0.86 %",
    ),
    AgentEntry(
        "m5_tbp0",
        Lazy("baselines.ablations:m5_tbp0"),
        "m5 that imagines from the start",
        "Table 2, Use T_BP = 0",
        "reward 33.54 +- 10.09 %, score 12.86 +- 4.05 %",
    ),
    AgentEntry(
        "m5_annealed",
        Lazy("baselines.ablations:m5_annealed"),
        "m5 whose imagined updates grow linearly",
        "Appendix C, annealing",
        "reward 65.71 +- 1.11 %",
    ),
    AgentEntry("m6", Lazy("baselines.beyond:m6"), "beyond the paper: m5 whose world model copies and looks around"),
    *(
        AgentEntry(f"m6_no_{part}", Lazy("baselines.beyond:m6_without", (part,)), f"m6 {without}")
        for part, without in (
            ("correspondence", "that makes every token anew"),
            ("grid", "with positions along the stream, as in m5"),
            ("local", "that embeds each token alone"),
            ("contents", "that knows MinAtar's codes by their names alone, and not what they stand for"),
            ("action", "whose action is a token and nothing more"),
            ("min_p", "whose dreams of games of two players hold improbable tokens too"),
            ("places", "that reads rewards and ends off the action's token alone"),
            ("ages", "that does not know how long anything has been where it is"),
            ("muon", "whose world model learns by Adam, as in m5"),
            ("games", "whose world model learns games of two players as fast as all else"),
            ("average", "that dreams with the newest parameters"),
            ("codes", "with the codebook of m5 on Craftax"),
            ("events", "that learns of Craftax's rewards as seldom as they come"),
            ("paid", "that does not know what a Craftax episode has paid already"),
            ("noise", "whose world model reads only true frames of Craftax in training"),
            ("trust", "that dreams whatever its model knows of rewards"),
        )
    ),
    AgentEntry(
        "oracle",
        Lazy("baselines.beyond:oracle"),
        "m5 that dreams in the true game: a bound, not ranked",
        uses_simulator=True,
    ),
)

PRESETS = (
    PresetEntry(
        "paper", "the paper's Appendix A; only these compare with the paper's results (default on an accelerator)"
    ),
    PresetEntry(
        "medium",
        "an hour on one CPU core, in MinAtar less than half of that: the most steps, and the longest dreams, that it "
        "has time for; not of OpenSpiel, where small has the paper's budget",
    ),
    PresetEntry("small", "scaled down so that two CPU cores learn something in minutes (default on a CPU)"),
    PresetEntry(
        "smoke",
        "two iterations, for tests: a minute or more to compile, then seconds; too short to learn or to end an episode",
    ),
)
