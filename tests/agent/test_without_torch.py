"""Agents through the compiled decoder, without torch: they act as through torch, and import what that needs."""

import copy
import pickle
import subprocess

import numpy as np
import pytest

from icrl_dist import Adversary, Task, Variation, load_agent, make
from icrl_dist.agent import in_context_agent, trained_model
from icrl_dist.agent.in_context_agent import InContextAgent
from icrl_dist.config.run import ConfigError
from icrl_dist.models import kernel
from icrl_dist.models.compiled import Unusable, kinds
from icrl_dist.models.kernel_transformer import KernelTransformer
from icrl_dist.models.stored import StoredTransformer
from icrl_dist.telemetry import processes

compiled = pytest.mark.skipif(not kinds(), reason="the decoder kernel was not built, or does not support this processor")

USE = """
import os, pickle, sys
import icrl_dist

agent = icrl_dist.load_agent("darkroom", seed=0)
for step in range(3):
    action = agent.act([[0, 0]])
    agent.observe([[0, 0]], action, [0.0], [[0, 1]], [step == 1])
agent.distribution([[1, 1]]), agent.context(), agent.surprise
other = pickle.loads(pickle.dumps(agent))
expected = [int(agent.act([[0, 1]])[0]) for _ in range(5)]
if os.fork() == 0:
    os._exit(expected != [int(other.act([[0, 1]])[0]) for _ in range(5)])
assert os.wait()[1] == 0, "a copy in a forked process acts otherwise"
for name, module in list(sys.modules.items()):
    if "site-packages" in (getattr(module, "__file__", None) or "") and "." not in name and not name.startswith("_"):
        print(name)
"""


@compiled
@pytest.mark.integration
def test_an_agent_is_loaded_and_acts_on_numpy_alone():
    """Also pickled, and in a forked process."""
    done = subprocess.run(
        processes.python("-c", USE), env=processes.environment(), capture_output=True, text=True, check=False, timeout=120
    )
    assert done.returncode == 0, done.stderr
    loaded = set(done.stdout.split())
    assert "numpy" in loaded
    assert loaded <= {
        "icrl_dist",
        "numpy",
        "jaxtyping",
        "annotated_types",
        "msgpack",
        "tomli_w",
        "typing_extensions",
        "wadler_lindig",
    }


def played(agent, episodes=3):
    """The actions of some episodes in a disturbed room, and the agent's state after each."""
    goal, size = agent.manifest["test_goals"][0], agent.manifest["size"]
    task = Task.of("darkroom", goal=goal, size=size, horizon=20, start=(0, 0))
    env = make(Variation(task, Adversary.of("uniform", p=0.2)))
    actions, states = [], []
    for episode in range(episodes):
        obs, ended = env.reset(seed=episode)[0], False
        while not ended:
            (action,) = agent.act([obs])
            after, reward, _, ended, _ = env.step(action)
            agent.observe([obs], [action], [reward], [after], [ended])
            obs = after
            actions.append(int(action))
        states.append((agent.distribution([[0, 0], [3, 4]]), agent.surprise, agent.context()[0]))
    return actions, states


@compiled
@pytest.mark.parametrize("deploy", ["paper", "committed"])
def test_an_agent_acts_through_the_kernel_as_through_torch(deploy):
    ours, theirs = (load_agent("darkroom", 0, deploy, decoder=decoder) for decoder in ("auto", "torch"))
    assert isinstance(ours._policy.model, StoredTransformer) and ours._trained._model is None
    (actions, states), (expected, their_states) = played(ours), played(theirs)
    assert actions == expected
    for found, right in zip(states, their_states, strict=True):
        for one, other in zip(found, right, strict=True):
            np.testing.assert_allclose(one, other, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("decoder", [pytest.param("kernel", marks=compiled), "torch"])
@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy, lambda agent: pickle.loads(pickle.dumps(agent))])
def test_copies_act_alike(decoder, copied):
    agent = load_agent("darkroom", seed=0, decoder=decoder)
    played(agent, 1)
    other = copied(agent)
    assert played(agent, 1)[0] == played(other, 1)[0]


@compiled
def test_a_pickled_agent_says_what_it_needs_where_there_is_no_kernel(monkeypatch):
    pickled = pickle.dumps(load_agent("darkroom", seed=0))
    monkeypatch.setattr(kernel, "kinds", lambda: ())
    with pytest.raises(RuntimeError, match=r"pickled agent of the compiled decoder.*decoder='torch'"):
        pickle.loads(pickled)


@compiled
def test_an_agents_model_is_built_when_it_is_asked_for_and_later_contexts_use_its_weights(monkeypatch):
    agent, same = load_agent("darkroom", seed=0), load_agent("darkroom", seed=0)
    before = agent.distribution([[1, 2]])
    model = agent.model
    assert agent.model is model
    agent.reset_context()
    np.testing.assert_array_equal(agent.distribution([[1, 2]]), before)
    assert isinstance(agent._policy._deployed, KernelTransformer)
    for parameter in model.parameters():
        parameter.data.mul_(0.5)
    agent.reset_context()
    assert np.abs(agent.distribution([[1, 2]]) - before).max() > 0.01
    monkeypatch.setattr(trained_model.TrainedModel, "model", property(lambda _: pytest.fail("the model was built")))
    same.reset_context(batch=3)
    assert same.act(np.zeros((3, 2))).shape == (3,)


def test_without_a_kernel_torch_decides_and_the_kernel_is_refused(monkeypatch):
    monkeypatch.setattr(kernel, "kinds", lambda: ())
    for module in (kernel, in_context_agent):
        monkeypatch.setattr(module, "library", lambda name: Unusable("not compiled", "install a C compiler"))
    agent, right = load_agent("darkroom", seed=0), load_agent("darkroom", seed=0, decoder="torch")
    assert not isinstance(agent._policy._deployed, KernelTransformer)
    assert played(agent)[0] == played(right)[0]
    with pytest.raises(ConfigError, match="decoder = 'kernel': not compiled: install a C compiler"):
        load_agent("darkroom", decoder="kernel")


def test_a_wide_model_is_decided_by_torch_unless_the_kernel_is_asked_for(monkeypatch):
    monkeypatch.setattr(kernel, "WIDEST", 8)
    agent = load_agent("darkroom", seed=0)
    assert isinstance(agent, InContextAgent) and not isinstance(agent._policy._deployed, KernelTransformer)
    if kinds():
        assert isinstance(load_agent("darkroom", decoder="kernel")._policy._deployed, KernelTransformer)
