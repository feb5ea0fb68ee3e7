"""Uses of what is public that are refused, each with what its message must hold, and odd ones that are accepted.

Run as a script, it prints what is otherwise.  A script, because tests check the types of all calls: there a wrong type
would not reach the code that refuses it.
"""

from __future__ import annotations

import os
import pickle
import re
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

import icrl_dist
from icrl_dist import Adversary, Task, Variation
from icrl_dist.problems import registry

ROOM: dict[str, Any] = {"goal": (1, 2), "size": 4, "horizon": 3}
CHEETAH = Variation(Task.of("dmc-cheetah-run", horizon=3))
NETWORK: dict[str, Any] = {"seed": 1, "inputs": 17, "outputs": 6, "strength": 1.0}

Case = tuple[Callable[[], object], str]


def room(**params: Any) -> Variation:
    return Variation(Task.of("darkroom", **{**ROOM, **params}))


def under(adversary: Adversary) -> Callable[[], object]:
    return lambda: icrl_dist.make(Variation(Task.of("darkroom", **ROOM), adversary))


def begun(variation: Variation) -> Any:
    env = icrl_dist.make(variation, "rgb_array")
    env.reset(seed=0)
    return env


def closed() -> Any:
    env = begun(room())
    env.close()
    env.close()
    return env


def over() -> Any:
    env = begun(room())
    for _ in range(3):
        env.step(np.int64(0))
    return env


def agent() -> Any:
    return icrl_dist.load_agent("darkroom", seed=0)


def observing(**other: Any) -> Callable[[], object]:
    usual = {"obs": [[1, 2]], "action": [3], "reward": [0.0], "next_obs": [[1, 1]], "done": [False]}
    return lambda: agent().observe(**{**usual, **other})


def stepped(variation: Variation, actions: Any) -> Callable[[], object]:
    batch = registry.batch([variation] * 2)
    batch.reset([np.random.default_rng(row) for row in range(2)])
    return lambda: batch.step(actions)


TASKS: list[Case] = [
    (lambda: icrl_dist.make(room(strat=(0, 0))), "'strat'.*start"),
    (lambda: icrl_dist.make(Variation(Task.of("darkroom", goal=(1, 1), size=3))), "'horizon' is missing"),
    (lambda: icrl_dist.make(Variation(Task.of("darkroon", **ROOM))), "'darkroon'.*darkroom"),
    (lambda: icrl_dist.make(room(goal=(float("nan"), 1))), "goal.*nan"),
    (lambda: icrl_dist.make(room(size=float("inf"))), "size.*inf"),
    (lambda: icrl_dist.make(room(size="four")), "size='four'"),
    (lambda: icrl_dist.make(room(goal=3)), "goal=3"),
    (lambda: icrl_dist.make(room(start=(0.5, 0))), r"start=\(0.5, 0\)"),
    (lambda: icrl_dist.make(Variation(Task.of("dmc-cheetah-run", torso_mas=3.0))), "'torso_mas'.*torso_mass"),
    (lambda: icrl_dist.make(Variation(Task.of("metaworld-pick-place", goal=(0, 0.85, 0.2)))), "'object' is missing"),
    (under(Adversary.of("uniform", p=0.1, strenght=1)), "'strenght'"),
    (under(Adversary.of("unifrom", p=0.1)), "'unifrom'.*uniform"),
    (under(Adversary.of("uniform", prob=0.1)), "'prob'"),
    (under(Adversary.of("uniform")), "'p' is missing"),
    (under(Adversary.of("null", p=0.3)), "null: no parameter 'p'"),
    (under(Adversary.of("uniform", p=1.5)), "p=1.5.*0, 1"),
    (under(Adversary.of("uniform", p=float("nan"))), "p=nan"),
    (lambda: icrl_dist.make(Variation(CHEETAH.task, Adversary.of("netwrok", **NETWORK))), "'netwrok'.*network"),
    (lambda: icrl_dist.make(Variation(CHEETAH.task, Adversary.of("network", **NETWORK, gain=1))), "'gain'"),
    (lambda: icrl_dist.make(Variation(CHEETAH.task, Adversary.of("network", **NETWORK | {"seed": -1}))), "seed = -1"),
    (lambda: icrl_dist.make(Variation(CHEETAH.task, Adversary.of("network", **NETWORK | {"seed": 1.5}))), "seed = 1.5"),
    (lambda: icrl_dist.oracle.Hypotheses.of([room(strat=(0, 0))]), "'strat'"),
    (lambda: icrl_dist.make(Task.of("darkroom", **ROOM)), "Variation"),  # type: ignore[arg-type]
    (lambda: icrl_dist.make(room(), render_mode="human"), "render_mode 'human'"),
    (lambda: registry.batch(room()), "list of Variation"),  # type: ignore[arg-type]
    (lambda: registry.batch([]), "one problem"),
]
ENVIRONMENTS: list[Case] = [
    (lambda: icrl_dist.make(room()).step(np.int64(0)), "reset"),
    (lambda: icrl_dist.make(room(), "rgb_array").render(), "reset"),
    (lambda: over().step(0), "horizon of 3.*reset"),
    (lambda: closed().step(0), "closed"),
    (lambda: closed().reset(), "closed"),
    (lambda: closed().render(), "closed"),
    (lambda: begun(room()).reset(seed=-1), "seed = -1"),
    (lambda: begun(room()).reset(seed=1.5), "seed = 1.5"),
    (lambda: begun(room()).reset(options={"start": (0, 0)}), "options.*start"),
    *(
        (lambda wrong=wrong: begun(room()).step(wrong), f"action.*{found}")
        for wrong, found in (
            (True, "bool"),
            (5, "5.*0..4"),
            (-1, "-1.*0..4"),
            (1.5, "1.5"),
            (float("nan"), "nan"),
            ([1], r"\(1,\)"),
            ("up", "'up'"),
            (None, "None"),
            ({}, "expected"),
        )
    ),
    *(
        (lambda wrong=wrong: begun(CHEETAH).step(wrong), f"action.*{found}")
        for wrong, found in (
            ([0.0] * 5, r"\(5,\).*\(6,\)"),
            ([2.0] * 6, "2.0"),
            ([float("nan")] * 6, "nan"),
            ([True] * 6, "bool"),
            (0.5, r"\(\)"),
            ([[0.0], [0.0, 1.0]], "numbers"),
        )
    ),
    (stepped(room(), np.array([True, False])), "actions"),
    (stepped(room(), np.array([0.0, 1.0])), "actions"),
    (stepped(room(), np.array([0, 5])), "actions"),
    (stepped(CHEETAH, np.ones((2, 6), bool)), "actions"),
    (stepped(CHEETAH, np.full((2, 6), np.nan, np.float32)), "actions"),
    (lambda: registry.batch([room()]).reset([0]), "rngs"),  # type: ignore[list-item]
    (lambda: registry.batch([CHEETAH]).reset([None]), "rngs"),  # type: ignore[list-item]
    (lambda: registry.batch([room()]).reset([]), "0 generators"),
]
AGENTS: list[Case] = [
    *(
        (lambda wrong=wrong: agent().act(wrong), f"obs.*{found}")
        for wrong, found in (
            ([[float("nan"), 1]], "nan"),
            ([[float("inf"), 1]], "inf"),
            ([[1e300, 1]], "1e.300"),
            ([[1e20, 1]], "1e.20"),
            ([1, 2], r"\(2,\).*\(1, 2\)"),
            ([[1, 2], [1, 2]], r"\(2, 2\).*reset_context"),
            (np.zeros((1, 17)), r"\(1, 17\).*2 observation components"),
            ([["a", "b"]], "numbers"),
            ([[1], [1, 2]], "numbers"),
            (None, "None"),
            (np.zeros((1, 2), complex), "complex"),
        )
    ),
    *(
        (observing(**{name: wrong}), f"{name}.*{found}")
        for name, wrong, found in (
            ("obs", [[float("nan"), 0]], "nan"),
            ("next_obs", [[float("-inf"), 0]], "inf"),
            ("reward", [float("nan")], "nan"),
            ("reward", 1.0, r"\(\)"),
            ("action", [7], "7.*0..4"),
            ("action", [-1], "-1"),
            ("action", [2.5], "2.5"),
            ("action", [True], "bool"),
            ("action", ["up"], "whole numbers"),
            ("done", ["False"], "True or False"),
            ("done", [2], "2"),
            ("done", [float("nan")], "nan"),
            ("done", [False, False], r"\(2,\)"),
        )
    ),
    (lambda: agent().distribution([[float("nan"), 0]]), "states.*nan"),
    (lambda: agent().distribution([0, 0]), "states"),
    (lambda: agent().distribution([[0, 0]], row=1), "row = 1"),
    (lambda: agent().distribution([[0, 0]], row=-1), "row = -1"),
    (lambda: agent().context(True), "row = True"),
    (lambda: agent().reset_context(batch=0), "batch = 0"),
    (lambda: agent().reset_context(batch=2.5), "batch = 2.5"),
    (lambda: icrl_dist.load_agent("darkroom", seed=-1), "seed = -1"),
    (lambda: icrl_dist.load_agent("darkroom", seed="a"), "seed = 'a'"),  # type: ignore[arg-type]
    (lambda: icrl_dist.load_agent("darkroom", threads=0), "threads = 0"),
    (lambda: icrl_dist.load_agent("darkroom", threads=1.5), "threads = 1.5"),  # type: ignore[arg-type]
    (lambda: icrl_dist.load_agent("darkroom", deploy="commited"), "'commited'.*committed"),  # type: ignore[arg-type]
    (lambda: icrl_dist.load_agent("darkroom", deploy=""), "deploy"),  # type: ignore[arg-type]
    (lambda: icrl_dist.load_agent("darkroom", decoder="kernl"), "'kernl'.*kernel"),  # type: ignore[arg-type]
]


def files(folder: Path) -> list[Case]:
    """Files and paths: ``folder`` is empty."""
    made = {
        "text": b"hello\n",
        "empty": b"",
        "pickled": b"\x80\x04\x95\x00.",
        "zip.npz": b"PK\x03\x04 broken",
        "folder/x": b"",
    }
    for name, content in made.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(content)
    np.save(folder / "array.npy", np.zeros(3))
    np.save(folder / "objects.npy", np.array([{}, 1], object))
    np.savez(folder / "objects.npz", manifest=np.array([{}], object))
    np.savez(folder / "arrays.npz", x=np.zeros(3))
    torch.save({"x": torch.zeros(2)}, folder / "torch.pt")
    no_agent = folder / "expert.npz"
    from icrl_dist.storage.checkpoint import Checkpoint, save_checkpoint

    save_checkpoint(no_agent, Checkpoint({"actor": np.zeros(3)}, {"steps": 3}))
    wrong = [folder / name for name in ("text", "empty", "pickled", "zip.npz", "objects.npy", "array.npy", "objects.npz")]
    wrong += [folder / "arrays.npz", folder / "torch.pt", no_agent]
    readers: tuple[Callable[[Any], object], ...] = (icrl_dist.load_agent, icrl_dist.evaluate)
    cases: list[Case] = [
        (partial(read, path), f"{path.name}.*(not a checkpoint of this system|holds no agent)")
        for read in readers
        for path in wrong
    ]
    all_readers: tuple[Callable[[Any], object], ...] = (
        *readers,
        icrl_dist.load_run,
        icrl_dist.read_dataset,
        icrl_dist.read_results,
    )
    for read in all_readers:
        name = {"read_dataset": "run_dir", "read_results": "runs"}.get(read.__name__, "what")
        cases += [(partial(read, odd), f"{name} = .*expected a path") for odd in (b"runs/demo", "", None, 5)]
        cases += [
            (partial(read, folder / "missing"), "no such"),
            (partial(read, "x" * 5000), "what|runs|run_dir|no packaged run"),
        ]
    cases += [
        (lambda: icrl_dist.load_agent(folder / "folder"), "holds no checkpoint"),
        (lambda: icrl_dist.load_run(folder / "folder"), "no such file"),
        (lambda: icrl_dist.read_dataset(folder / "folder"), "holds no run"),
        (lambda: icrl_dist.read_dataset(folder / "text"), "is a file"),
        (lambda: icrl_dist.read_results([folder / "text"]), "is a file"),
        (lambda: icrl_dist.load_run(folder / "text"), "text.*(TOML|a path must end in .toml)"),
    ]
    return cases


def played(wrap: Callable[[Any], Any] = np.asarray, action: Callable[[Any], Any] = int) -> list[Any]:
    """Two episodes of the agent in a room: actions, observations, rewards; ``wrap`` and ``action`` give other types."""
    one, env = agent(), begun(room())
    found = []
    for number in range(2):
        obs = env.reset(seed=number)[0]
        for _ in range(3):
            (chosen,) = one.act(wrap([obs]))
            following, reward, _, done, _ = env.step(action(chosen))
            one.observe(wrap([obs]), wrap([chosen]), wrap([reward]), wrap([following]), wrap([done]))
            found.append((int(chosen), following.tolist(), reward, one.distribution(wrap([obs])).tolist()))
            obs = following
    return found


def pushed(wrap: Callable[[Any], Any]) -> list[Any]:
    env = begun(CHEETAH)
    return [env.step(wrap(np.full(6, 0.5, np.float32)))[0].tolist() for _ in range(3)]


def in_threads() -> list[list[Any]]:
    """Four agents at once, each in its thread, and the number of torch threads afterwards."""
    torch.set_num_threads(2)
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda _: played(), range(4)))
    assert torch.get_num_threads() == 2, torch.get_num_threads()
    return found


def forked() -> list[Any]:
    """What an agent does in a forked process, after it acted in this one."""
    played()
    reader, writer = os.pipe()
    if (child := os.fork()) == 0:
        os.write(writer, pickle.dumps(played()))
        os._exit(0)
    os.close(writer)
    with os.fdopen(reader, "rb") as file:
        found: list[Any] = pickle.load(file)
    os.waitpid(child, 0)
    return found


def lists(value: Any) -> Any:
    return [part.tolist() if isinstance(part, np.ndarray | np.generic) else part for part in value]


def tensors(value: Any) -> Any:
    return torch.as_tensor(np.asarray(value), dtype=torch.float64).requires_grad_()


def accepted() -> None:
    int_like: Any = np.int64(0)
    usual, cheetah = played(), pushed(np.asarray)
    ways: list[tuple[str, object, object]] = [
        ("lists", played(lists), usual),
        ("tensors", played(tensors, torch.as_tensor), usual),
        ("float64", played(lambda value: np.asarray(value, np.float64), float), usual),
        ("numpy scalars", played(list, np.uint8), usual),
        ("a list as an action", pushed(lambda action: action.tolist()), cheetah),
        ("a tensor as an action", pushed(torch.as_tensor), cheetah),
        ("float64 as an action", pushed(lambda action: action.astype(np.float64)), cheetah),
        (
            "a numpy seed",
            icrl_dist.load_agent("darkroom", seed=int_like).act([[0, 0]]).tolist(),
            agent().act([[0, 0]]).tolist(),
        ),
        ("several threads", in_threads(), [usual] * 4),
        ("a forked process", forked(), usual),
        ("an empty context", [column.shape[0] for column in agent().context()], [0] * 4),
        ("no states", agent().distribution(np.zeros((0, 2))).shape, (0, 5)),
    ]
    for way, found, expected in ways:
        if found != expected:
            print(f"{way}: {found} and not {expected}")


def main() -> None:
    accepted()
    for call, expected in (*TASKS, *ENVIRONMENTS, *AGENTS, *files(Path(sys.argv[1]))):
        try:
            found = call()
        except (ValueError, TypeError, RuntimeError) as error:  # ConfigError and StoreError are of these types
            text = str(error)
            if len(text.splitlines()) != 1 or "pickle" in text.replace("pickled", "") or not re.search(expected, text):
                print(f"expected {expected!r}, and found {type(error).__name__}: {text}")
        except BaseException as error:
            print(f"expected {expected!r}, and found {type(error).__name__}: {error}")
        else:
            print(f"expected {expected!r}, and nothing was refused: {found!r}")


if __name__ == "__main__":
    main()
