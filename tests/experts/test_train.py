"""Histories of SAC experts: what is sent, what is kept, and what a kill or a breakdown costs."""

import dataclasses

import numpy as np
import pytest
import torch
from icrl_dist.methods.recipes import METHODS, self_labelled

from icrl_dist.collect import jobs
from icrl_dist.config.run import ConfigError, validate
from icrl_dist.config.sac import SACConfig
from icrl_dist.config.sections import AdversaryConfig
from icrl_dist.experts import cache, train
from icrl_dist.experts.cache import LED, History
from icrl_dist.experts.sac import batched
from icrl_dist.experts.train import ExpertPolicy, ScriptedPolicy
from icrl_dist.models.dpt import PretrainedTransformer
from icrl_dist.problems import registry, splits
from icrl_dist.problems.continuous.config import ControlConfig
from icrl_dist.problems.continuous.network_adversary import Networks
from icrl_dist.problems.metaworld import environment
from icrl_dist.results import evaluate, heldout
from icrl_dist.rollout import deployment
from icrl_dist.stream import wire
from icrl_dist.training import batches as context
from icrl_dist.training import fit
from icrl_dist.types import NULL
from tests.methods.test_recipes import Fixed, Kept

HORIZON, EPISODES = 20, 10


@pytest.fixture
def run(small_run, tmp_path):
    """Four tasks of reacher, a null and a pushing adversary in each, experts of ten short episodes."""
    sac = SACConfig(hidden=(8, 8), batch=16, random_steps=40, warmup=40, update_every=2, steps=HORIZON * EPISODES)
    return dataclasses.replace(
        small_run,
        problem="dmc-reacher-easy",
        control=ControlConfig(train_tasks=4, test_tasks=2, horizon=HORIZON),
        adversary=AdversaryConfig(count=2),
        sac=dataclasses.replace(sac, cache=str(tmp_path / "experts")),
        pretrain=dataclasses.replace(small_run.pretrain, contexts=8 * 3, queries=6),
    )


@pytest.fixture
def trained(monkeypatch):
    """How many experts were trained each time."""
    batches, real = [], batched.train
    monkeypatch.setattr(batched, "train", lambda env, *rest, **more: batches.append(env.batch) or real(env, *rest, **more))
    return batches


def asked(run, method="icag"):
    return METHODS[method].ask(run, METHODS[method].phases(run)[0])


def digests(trajectories):
    return [wire.trajectory_digest(t) for t in trajectories]


def test_a_job_is_all_variations_of_a_few_tasks_with_the_numbers_of_sac(run):
    first, second = asked(run)
    assert first.kind == "train_expert" and (first.trials, first.tasks, second.task) == (3, 2, 2)
    assert [v.adversary == NULL for v in first.variations] == [True, False] * 2
    assert cache.sac_of(wire.decode_job(wire.encode_job(first))) == run.sac
    assert {v.adversary for job in asked(run, "dpt") for v in job.variations} == {NULL}


def test_contexts_are_episodes_of_the_training_and_labels_what_its_expert_would_do(run):
    job = asked(run)[0]
    sent = list(jobs.do(job, None, "w"))
    assert [t.identity for t in sent] == list(job.identities())
    found = [cache.any_kept(v, run.sac, run.seed) for v in job.variations]
    for t in sent:
        row = job.variations.index(t.variation)
        history = found[row]
        assert history.rewards.shape == (EPISODES, HORIZON) and t.origin == "expert" and t.policy_version == -1
        number = [0, 4, 9][t.identity.trial]  # evenly spaced, from the first random one to the last
        for name in ("observations", "actions", "rewards", "adversary"):
            np.testing.assert_array_equal(getattr(t, name), getattr(history, name)[number])
        states = history.observations[:, :-1].reshape(-1, 6)
        assert all((states == query).all(axis=1).any() for query in t.queries) and len(t.queries) == 6
        policy = ExpertPolicy([history] * 6, run.sac)
        np.testing.assert_allclose(t.labels, policy.act(t.queries, np.zeros((6, 2))), atol=1e-5)
        pushes = Networks([t.variation.adversary] * HORIZON, registry.spec(t.variation.task), 2).act(t.observations[:-1])
        np.testing.assert_allclose(t.adversary, pushes, atol=1e-6)
    assert np.abs(sent[-1].adversary).max() > 0.1 and not sent[0].adversary.any()
    assert len({t.queries.tobytes() for t in sent}) == len(sent)


def test_the_same_job_gives_the_same_bytes_with_or_without_a_cache(run, tmp_path):
    job = asked(run)[0]
    here = digests(jobs.do(job, None, "w0"))
    assert digests(jobs.do(job, None, "w1")) == here, "from the cache"
    none = dataclasses.replace(run, sac=dataclasses.replace(run.sac, cache=""))
    assert digests(jobs.do(asked(none)[0], None, "w")) == here, "without one"
    other = dataclasses.replace(none, seed=1)
    assert digests(jobs.do(asked(other)[0], None, "w")) != here


def test_nothing_is_trained_that_is_in_the_cache(run, trained, caplog):
    job = asked(run)[0]
    first = digests(jobs.do(job, None, "w"))
    assert trained == [4]
    assert digests(jobs.do(dataclasses.replace(job, trials=2), None, "w")) != first and trained == [4]
    file = cache.file(run.sac, cache.key(job.variations[2], run.sac, run.seed, "lockstep"))
    whole = file.read_bytes()
    for damage in (whole[: len(whole) // 2], b"nothing"):
        file.write_bytes(damage)
        assert digests(jobs.do(job, None, "w")) == first
    assert trained == [4, 1, 1] and "made anew" in caplog.text and file.read_bytes() == whole


def test_what_one_method_trained_another_takes_and_ends_with_the_bytes_of_its_own(run, trained, tmp_path):
    """DPT has the undisturbed ones of ICAG's experts, in other company."""
    alone = dataclasses.replace(run, sac=dataclasses.replace(run.sac, cache=str(tmp_path / "other")))
    own = [digests(jobs.do(job, None, "w")) for job in asked(alone, "dpt")]
    assert trained == [2, 2]
    for job in asked(run, "icag"):
        list(jobs.do(job, None, "w"))
    assert trained == [2, 2, 4, 4]
    assert [digests(jobs.do(job, None, "w")) for job in asked(run, "dpt")] == own and trained == [2, 2, 4, 4]


def test_a_history_gives_no_more_episodes_than_its_training_had_and_all_of_them_if_they_are_asked_for(run, monkeypatch):
    monkeypatch.setattr(cache, "KEPT", 6)
    many = dataclasses.replace(run, pretrain=dataclasses.replace(run.pretrain, contexts=8 * 30))
    job = asked(many)[0]
    assert job.trials == EPISODES
    sent = list(jobs.do(job, None, "w"))
    assert len({t.actions.tobytes() for t in sent}) == len(sent) == 4 * EPISODES
    few = asked(run)[0]
    assert few.trials == 3
    list(jobs.do(few, None, "w"))
    assert len(cache.kept(few.variations[0], run.sac, run.seed, "lockstep").rewards) == 6


def test_what_decides_a_history_decides_where_it_is_kept(run, monkeypatch):
    job = asked(run)[0]
    one = cache.key(job.variations[0], run.sac, 0, "lockstep")
    changed = [
        cache.key(job.variations[1], run.sac, 0, "lockstep"),
        cache.key(job.variations[2], run.sac, 0, "lockstep"),
        cache.key(job.variations[0], run.sac, 1, "lockstep"),
        cache.key(job.variations[0], run.sac, 0, "stable-baselines3"),
        *(
            cache.key(job.variations[0], dataclasses.replace(run.sac, **{name: value}), 0, "lockstep")
            for name, value in {"hidden": (8, 9), "gamma": 0.5, "steps": 400, "update_every": 3}.items()
        ),
    ]
    assert len({one, *changed}) == 1 + len(changed)
    again = cache.key(job.variations[0], dataclasses.replace(run.sac, cache="/elsewhere"), 0, "lockstep")
    assert again == one
    with monkeypatch.context() as patched:
        patched.setattr(cache.metadata, "version", lambda name: "0")
        assert cache.key(job.variations[0], run.sac, 0, "lockstep") != one, "other physics is other data"
    monkeypatch.setattr(cache.version, "digest_of", lambda parts: "other")
    assert cache.key(job.variations[0], run.sac, 0, "lockstep") != one, "so is other code"


class KilledError(Exception):
    pass


def test_a_killed_training_goes_on_from_its_checkpoint_to_the_same_bytes(run, monkeypatch):
    job = asked(run)[0]
    undisturbed = digests(jobs.do(asked(dataclasses.replace(run, sac=dataclasses.replace(run.sac, cache="")))[0], None, "w"))
    monkeypatch.setattr(train, "CHECKPOINT_S", 0.0)
    real, begun = train.save_checkpoint, []

    def killed(path, checkpoint):
        real(path, checkpoint)
        begun.append(path.name)
        if len(begun) in (4, 7):
            raise KilledError

    monkeypatch.setattr(train, "save_checkpoint", killed)
    for _ in range(2):
        with pytest.raises(KilledError):
            list(jobs.do(job, None, "w"))
    assert all(name.startswith("part-") for name in begun) and len(begun) == 7
    assert digests(jobs.do(job, None, "w")) == undisturbed
    assert len([name for name in begun if name.startswith("part-")]) == EPISODES, "no episode was trained twice"
    assert not list(cache.file(run.sac, "").parent.glob("part-*"))


class Breaking:
    """Rows 1 and 3 break down, in the first two episodes or in all."""

    def __init__(self, env, always):
        self.spec, self.batch, self._env, self._always, self._episode = env.spec, env.batch, env, always, -1

    def reset(self, rngs):
        self._episode += 1
        return self._env.reset(rngs)

    def step(self, actions):
        step = self._env.step(actions)
        broken = np.zeros(self.batch, bool)
        broken[[1, 3]] = self._always or self._episode < 2
        return step._replace(diverged=broken)


@pytest.mark.parametrize("always", [False, True])
def test_episodes_that_broke_down_are_no_data(run, monkeypatch, always):
    real = registry.batch
    monkeypatch.setattr(train.registry, "batch", lambda variations: Breaking(real(variations), always))
    job = asked(run)[0]
    if always:
        with pytest.raises(RuntimeError, match="breaks down in every episode"):
            list(jobs.do(job, None, "w"))
        return
    list(jobs.do(job, None, "w"))
    lengths = [len(cache.any_kept(v, run.sac, run.seed).rewards) for v in job.variations]
    assert lengths == [EPISODES, EPISODES - 2, EPISODES, EPISODES - 2]


def test_an_evaluation_counts_what_broke_down_and_says_whose_expert_is_missing(run, monkeypatch, tmp_path):
    run = dataclasses.replace(run, evaluate=dataclasses.replace(run.evaluate, episodes=3, seeds=1, p=(0.0, 1.0)))
    real = registry.batch
    monkeypatch.setattr(evaluate.registry, "batch", lambda variations: Breaking(real(variations), False))
    results = evaluate.online(run, {"random": evaluate.random_vectors})
    assert [result.broken for result in results] == [4, 4] and results[0].row()["broken"] == 4
    monkeypatch.undo()
    assert "broken" not in evaluate.online(run, {"random": evaluate.random_vectors})[0].row()
    assert "4 of the evaluated tasks" in heldout._no_expert(run, tmp_path)
    assert f"`icrl-dist train experts-{tmp_path}/run.toml --out OTHER` trains them" in heldout._no_expert(run, tmp_path)
    list(jobs.do(asked(run)[0], None, "w"))
    assert "2 of the evaluated tasks" in heldout._no_expert(run, tmp_path)
    assert evaluate.expert(run, splits.evaluated(run)) is None
    list(jobs.do(asked(run)[1], None, "w"))
    assert evaluate.expert(run, splits.evaluated(run)) is not None


def test_a_rollout_that_broke_down_is_no_data(run, monkeypatch):
    icaa = dataclasses.replace(run, method="icaa")
    job = METHODS["icaa"].ask(icaa, METHODS["icaa"].phases(icaa)[1])[0]
    policies = Fixed(splits.spec(icaa), icaa.model)
    assert len(list(jobs.do(job, policies, "w"))) == len(list(job.identities()))
    real = registry.batch
    monkeypatch.setattr(jobs.registry, "batch", lambda variations: Breaking(real(variations), True))
    with pytest.raises(RuntimeError, match=r"adapt/0/0/1/0, adapt/0/1/1/0: the simulation broke down"):
        list(jobs.do(job, policies, "w"))


def test_a_models_own_vectors_become_labels(run):
    icaa = dataclasses.replace(run, method="icaa")
    job = METHODS["icaa"].ask(icaa, METHODS["icaa"].phases(icaa)[1])[0]
    trials = list(jobs.do(job, Fixed(splits.spec(icaa), icaa.model), "w"))
    own = [t for t in trials if t.identity[:4] == trials[0].identity[:4]]
    examples = self_labelled(icaa, own)
    later = own[icaa.icaa.context_trials + 1 :]
    np.testing.assert_array_equal(examples.labels, np.concatenate([t.actions for t in later]))
    np.testing.assert_array_equal(examples.queries, np.concatenate([t.observations[:-1] for t in later]))
    assert examples.actions.dtype == np.float32 and examples.actions.shape[2] == 2


def test_in_meta_world_the_scripted_policy_labels_what_it_alone_sees_whole(small_run):
    sac = SACConfig(hidden=(8,), batch=8, random_steps=10, warmup=10, steps=60, cache="")
    run = dataclasses.replace(
        small_run,
        problem="metaworld-pick-place",
        control=ControlConfig(train_tasks=2, test_tasks=1, horizon=30),
        adversary=AdversaryConfig(count=2),
        sac=sac,
        pretrain=dataclasses.replace(small_run.pretrain, contexts=8, queries=5),
    )
    (job,) = asked(run)
    sent = list(jobs.do(job, None, "w"))
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


def test_experts_act_each_in_its_row(run):
    torch.manual_seed(0)
    spec = registry.spec(splits.split(run).train[0])
    batch = batched.SACBatch(range(3), spec, run.sac, "cpu")
    shapes = dict.fromkeys(("actions", "adversary", "labels", "led_actions", "led_labels"), (0, 1, 2))
    shapes |= {"rewards": (0, 1), "led_rewards": (0, 1), "observations": (0, 2, 6), "led_observations": (0, 2, 6)}
    empty = {name: np.zeros(shape, np.float32) for name, shape in shapes.items()}
    actors = batch.arrays["actor"].numpy()
    made = [History(**empty, actor=actor) for actor in actors]
    policy = ExpertPolicy(made, run.sac)
    seen = np.random.default_rng(0).normal(size=(3, 6)).astype(np.float32)
    np.testing.assert_allclose(policy.act(seen, np.zeros((3, 2))), batch.act(seen), atol=1e-6)


def test_the_scripted_policy_acts_by_the_truth_of_the_environment_that_it_met():
    env = environment.PickPlace([envs_variation() for _ in range(2)])
    policy = ScriptedPolicy()
    policy.meet(env)
    seen = env.reset([np.random.default_rng(0)] * 2)
    np.testing.assert_array_equal(policy.act(seen * 0, np.zeros((2, 4))), environment.expert(env.truth))


def envs_variation():
    from icrl_dist.problems.metaworld import pick_place
    from icrl_dist.types import Variation

    return Variation(pick_place.task((0.02, 0.65, 0.02), (0.05, 0.85, 0.2)))


def test_a_training_says_how_far_it_is_and_a_cache_what_it_saved(run):
    job, heard = asked(run)[0], []
    tell = lambda text, note=False, reached=0: heard.append((text, note, reached))  # noqa: E731
    list(jobs.do(job, None, "w", tell))
    assert len(heard) == EPISODES and heard[4][0].startswith("4 experts at 100 of 200 steps, mean return ")
    assert not any(note for _, note, _ in heard) and [reached for *_, reached in heard] == list(range(20, 201, 20))
    heard.clear()
    list(jobs.do(job, None, "w", tell))
    assert heard == [(f"{job.label}: 4 experts from the cache, 800 steps of SAC saved", True, 0)]


@pytest.fixture
def stretched(run):
    model = dataclasses.replace(run.model, window=4)
    fit = dataclasses.replace(run.pretrain, windows=5, decoy_fraction=0.5)
    return dataclasses.replace(run, model=model, pretrain=fit, optim=dataclasses.replace(run.optim, windows=2))


def test_stretches_are_cut_from_episodes_that_experts_led_some_of_them_another_tasks(stretched):
    job = asked(stretched)[0]
    sent = list(jobs.do(job, None, "w"))
    found = [cache.any_kept(v, stretched.sac, stretched.seed) for v in job.variations]
    policies = [ExpertPolicy([history] * 4, stretched.sac) for history in found]
    unused, led = np.zeros((4, 2)), {False: 0, True: 0}
    for t in sent:
        row = job.variations.index(t.variation)
        own, other = policies[row], policies[(row + 2) % 4]  # two variations of each of two tasks
        assert t.variation.task != job.variations[(row + 2) % 4].task
        assert len(t.queries) == 6 + 5 * 4 and len(t.taken) == 20
        states, taken, labels = t.queries[6:].reshape(5, 4, 6), t.taken.reshape(5, 4, 2), t.labels[6:].reshape(5, 4, 2)
        whole = found[row].led_observations[:, :-1]
        for n in range(5):
            np.testing.assert_allclose(labels[n], own.act(states[n], unused), atol=1e-5)
            misled = np.abs(taken[n] - labels[n]).max() > 1e-4
            led[bool(misled)] += 1
            np.testing.assert_allclose(taken[n], (other if misled else own).act(states[n], unused), atol=1e-5)
            places = [(g, h) for g in range(LED) for h in range(HORIZON - 3) if (whole[g, h : h + 4] == states[n]).all()]
            assert bool(places) != misled, "four states in a row of an episode that its own expert led, or of another"
            if places:
                g, h = places[0]
                np.testing.assert_array_equal(t.gained.reshape(5, 4)[n], found[row].led_rewards[g, h : h + 4])
    assert min(led.values()) > 0.25 * sum(led.values())


def test_nobody_can_be_misled_in_a_job_of_one_task(stretched):
    alone = dataclasses.replace(stretched, stream=dataclasses.replace(stretched.stream, job_tasks=1))
    with pytest.raises(ConfigError, match=r"pretrain\.decoy_fraction = 0\.5: use 0, or a stream\.job_tasks with at least two"):
        validate(alone, "x")
    validate(dataclasses.replace(alone, pretrain=dataclasses.replace(alone.pretrain, decoy_fraction=0.0)), "x")


def test_a_model_of_vectors_trains_on_stretches_and_is_deployed_committed(stretched):
    phase = METHODS["icag"].phases(stretched)[0]
    data = Kept([t for job in asked(stretched) for t in jobs.do(job, None, "w")])
    pools = METHODS["icag"].learn(stretched, phase, data)
    torch.manual_seed(0)
    model = PretrainedTransformer(splits.spec(stretched), stretched.model)
    draws = lambda step: context.draw(np.random.default_rng(step), pools, 8, 8, 0, 2)  # noqa: E731
    taken = draws(0).windows.taken
    assert taken.shape == (8, 2, 4, 2) and taken.dtype == np.float32
    opt = fit.Optimizer(model, stretched.optim)
    before = np.mean([fit.batch_loss(model, draws(1000 + n)).item() for n in range(8)])
    fit.fit(model, opt, stretched.optim, 3e-3, 60, draws)
    after = np.mean([fit.batch_loss(model, draws(1000 + n)).item() for n in range(8)])
    assert after < before - 0.3
    policy = deployment.in_context(model, 4, stretched.context)
    assert isinstance(policy, deployment.CommittedPolicy)
    env = registry.batch(asked(stretched)[0].variations)
    ran = deployment.episode(env, policy, [np.random.default_rng(row) for row in range(4)])
    assert ran.actions.shape == (4, HORIZON, 2) and policy.length == HORIZON
