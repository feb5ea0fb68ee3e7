"""Action windows of SAC experts and their decoys, progress messages of trainings, and deployed experts."""

import dataclasses

import numpy as np
import pytest
import torch

from icrl_dist.config.run import ConfigError, validate
from icrl_dist.config.sac import SACConfig
from icrl_dist.config.sections import AdversaryConfig
from icrl_dist.experts import cache
from icrl_dist.experts.cache import History
from icrl_dist.experts.payloads import WINDOW_EPISODES
from icrl_dist.experts.sac import batched
from icrl_dist.experts.train import ExpertPolicy, ScriptedPolicy
from icrl_dist.methods import registry as methods
from icrl_dist.methods.dpt_loss import batch_loss
from icrl_dist.models.dpt import PretrainedTransformer
from icrl_dist.problems import registry
from icrl_dist.problems.continuous.config import ControlConfig
from icrl_dist.problems.metaworld import environment, pick_place
from icrl_dist.rollout import deployment
from icrl_dist.rollout.episode import episode
from icrl_dist.training import fit
from icrl_dist.types import NULL, Variation
from tests.experts.histories import EPISODES, HORIZON, run
from tests.jobs import InMemoryDataset, do, in_problem, jobs_of
from tests.optional import known

pytestmark = pytest.mark.integration

__all__ = ["run"]


def test_in_meta_world_labels_come_from_the_scripted_policy_at_the_true_states(small_run):
    sac = SACConfig(hidden=(8,), batch=8, random_steps=10, warmup=10, steps=60, cache="")
    run = in_problem(
        small_run,
        "metaworld-pick-place",
        method="icag",
        control=ControlConfig(train_tasks=2, test_tasks=1, horizon=30),
        adversary=AdversaryConfig(count=1),
        sac=sac,
        pretrain=dataclasses.replace(small_run.pretrain, contexts=8, queries=5),
    )
    (job,) = jobs_of(run)
    sent = do(run, job)
    assert len(sent) == 8
    for t in sent:
        assert not t.observations[:, 36:].any() and not t.queries[:, 36:].any(), "the goal stays hidden"
        if t.variation.adversary == NULL:  # then what is shown is true, but for the goal
            truth = t.queries.astype(np.float64)
            truth[:, 36:] = t.variation.task.vector("goal")
            np.testing.assert_allclose(t.labels, environment.expert(truth), atol=1e-3)
    pushed = [t for t in sent if t.variation.adversary != NULL]
    blind = [np.abs(environment.expert(t.queries.astype(np.float64)) - t.labels).max() for t in pushed]
    assert min(blind) > 0.05, "labels of what is shown would be others"


def test_each_expert_acts_in_its_own_row(run):
    torch.manual_seed(0)
    spec = registry.of(run).spec
    batch = batched.SACBatch(range(3), spec, run.sac, "cpu")
    shapes: dict[str, tuple[int, ...]] = dict.fromkeys(
        ("actions", "adversary", "labels", "window_actions", "window_labels"), (0, 1, 2)
    )
    shapes |= {"rewards": (0, 1), "window_rewards": (0, 1), "observations": (0, 2, 6), "window_observations": (0, 2, 6)}
    empty = {name: np.zeros(shape, np.float32) for name, shape in shapes.items()}
    actors = batch.arrays["actor"].numpy()
    made = [History(**empty, actor=actor) for actor in actors]
    policy = ExpertPolicy(made, run.sac)
    seen = np.random.default_rng(0).normal(size=(3, 6)).astype(np.float32)
    np.testing.assert_allclose(policy.act(seen, np.zeros((3, 2))), batch.act(seen), atol=1e-6)


def test_the_scripted_policy_reads_the_true_states_of_its_environment():
    env = environment.PickPlace([Variation(pick_place.task((0.02, 0.65, 0.02), (0.05, 0.85, 0.2)))] * 2)
    policy = ScriptedPolicy(registry.problem(pick_place.KIND), env)
    seen = env.reset([np.random.default_rng(0)] * 2)
    np.testing.assert_array_equal(policy.act(seen * 0, np.zeros((2, 4))), environment.expert(env.truth))


def test_a_training_reports_its_progress_and_the_cache_reports_what_it_saved(run):
    job, received = jobs_of(run)[0], []
    progress = lambda text, note=False, reached=0: received.append((text, note, reached))  # noqa: E731
    do(run, job, progress=progress)
    assert len(received) == EPISODES and received[4][0].startswith("4 experts at 100 of 200 steps, mean return ")
    assert not any(note for _, note, _ in received) and [reached for *_, reached in received] == list(range(20, 201, 20))
    received.clear()
    do(run, job, progress=progress)
    assert received == [(f"{job.label}: 4 experts from the cache, 800 steps of SAC saved", True, 0)]


@pytest.fixture
def windowed(run):
    model = dataclasses.replace(run.model, window=4)
    fit = dataclasses.replace(run.pretrain, windows=5, decoy_fraction=0.5)
    return dataclasses.replace(run, model=model, pretrain=fit, optim=dataclasses.replace(run.optim, windows=2))


def test_windows_are_cut_from_episodes_of_experts_and_decoys_from_those_of_another_task(windowed):
    job = jobs_of(windowed)[0]
    sent = do(windowed, job)
    found = [known(cache.load_any(v, HORIZON, windowed.sac, windowed.seed)) for v in job.variations]
    policies = [ExpertPolicy([history] * 4, windowed.sac) for history in found]
    unused, counts = np.zeros((4, 2)), {False: 0, True: 0}
    for t in sent:
        row = job.variations.index(t.variation)
        own, other = policies[row], policies[(row + 2) % 4]  # two variations of each of two tasks
        assert t.variation.task != job.variations[(row + 2) % 4].task
        assert len(t.queries) == 6 + 5 * 4 and len(t.prev_actions) == 20
        states, prev_actions, labels = (
            t.queries[6:].reshape(5, 4, 6),
            t.prev_actions.reshape(5, 4, 2),
            t.labels[6:].reshape(5, 4, 2),
        )
        whole = found[row].window_observations[:, :-1]
        for n in range(5):
            np.testing.assert_allclose(labels[n], own.act(states[n], unused), atol=1e-5)
            decoy = np.abs(prev_actions[n] - labels[n]).max() > 1e-4
            counts[bool(decoy)] += 1
            np.testing.assert_allclose(prev_actions[n], (other if decoy else own).act(states[n], unused), atol=1e-5)
            places = [
                (g, h) for g in range(WINDOW_EPISODES) for h in range(HORIZON - 3) if (whole[g, h : h + 4] == states[n]).all()
            ]
            assert bool(places) != decoy, "four states in a row of an episode in which its own expert acted, or another"
            if places:
                g, h = places[0]
                np.testing.assert_array_equal(t.prev_rewards.reshape(5, 4)[n], found[row].window_rewards[g, h : h + 4])
    assert min(counts.values()) > 0.25 * sum(counts.values())


def test_a_job_of_one_task_has_no_decoys(windowed):
    one_task_jobs = dataclasses.replace(windowed, stream=dataclasses.replace(windowed.stream, job_tasks=1))
    with pytest.raises(ConfigError, match=r"pretrain\.decoy_fraction = 0\.5: use 0, or stream\.job_tasks = 2"):
        validate(one_task_jobs, "x")
    validate(dataclasses.replace(one_task_jobs, pretrain=dataclasses.replace(one_task_jobs.pretrain, decoy_fraction=0.0)), "x")


def test_a_model_with_vector_actions_trains_on_windows_and_is_deployed_committed(windowed):
    run = dataclasses.replace(windowed, optim=dataclasses.replace(windowed.optim, queries=8))
    method = methods.of(run)
    data = InMemoryDataset([t for job in jobs_of(run) for t in do(run, job)])
    draw = method.data(run, method.phases(run)[0], data)
    torch.manual_seed(0)
    model = method.build(registry.of(run).spec, run)
    assert isinstance(model, PretrainedTransformer)
    prev_actions = draw(np.random.default_rng(0)).windows.prev_actions
    assert prev_actions.shape == (8, 2, 4, 2) and prev_actions.dtype == np.float32

    def loss(step):
        return batch_loss(model, draw(np.random.default_rng(step)))

    opt = fit.Optimizer(model, run.optim)
    before = np.mean([loss(1000 + n).item() for n in range(8)])
    fit.fit(model, opt, run.optim, 3e-3, 60, loss)
    after = np.mean([loss(1000 + n).item() for n in range(8)])
    assert after < before - 0.3
    policy = deployment.in_context(model, 4, run.context)
    assert isinstance(policy, deployment.CommittedPolicy)
    env = registry.batch(jobs_of(run)[0].variations)
    ran = episode(env, policy, [np.random.default_rng(row) for row in range(4)])
    assert ran.actions.shape == (4, HORIZON, 2) and policy.length == HORIZON
