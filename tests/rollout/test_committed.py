"""Windows (zeta of eq. 6) and the committed deployment, each against a slow obvious loop."""

import dataclasses
import itertools
import math

import numpy as np
import pytest
import torch
from icrl_dist.methods.recipes import METHODS

from icrl_dist.agent.in_context_agent import InContextAgent
from icrl_dist.collect import jobs
from icrl_dist.config.run import ConfigError
from icrl_dist.config.sections import ContextConfig, ModelConfig, OptimConfig
from icrl_dist.models.dpt import DeployedTransformer, PretrainedTransformer, Transitions, Windows
from icrl_dist.models.heads import Gaussian
from icrl_dist.problems import registry, splits
from icrl_dist.problems.darkroom import room
from icrl_dist.problems.darkroom.room import next_cell
from icrl_dist.problems.darkroom.solver import Hypotheses, cell_numbers, soft_labels
from icrl_dist.rollout import deployment
from icrl_dist.rollout.deployment import CommittedPolicy, InContextPolicy
from icrl_dist.rollout.episode import deploy_online, episode
from icrl_dist.training import batches, fit
from icrl_dist.training.batches import Examples, Pool
from icrl_dist.types import Adversary, Job, Spec, Step, Variation

HORIZON, LENGTH = 7, 4
B, T, R = 3, 15, 2


def build(spec, heads=2, window=LENGTH, scale=0.4):
    """A model whose every parameter matters."""
    torch.manual_seed(0)
    model = PretrainedTransformer(spec, ModelConfig(3, heads, 16, window=window)).eval()
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.copy_(torch.randn_like(parameter) * scale)
    return model


SPEC = Spec(low=(0.0, 0.0), high=(4.0, 4.0), actions=5, horizon=HORIZON)


def transitions(seed=0):
    g = torch.Generator().manual_seed(seed)
    states = torch.randint(0, 5, (B, T + 1, 2), generator=g).float()
    rewards = torch.randint(0, 2, (B, T), generator=g).float()
    return Transitions(states[:, :-1], torch.randint(0, 5, (B, T), generator=g), states[:, 1:], rewards)


def windows(seed=5):
    g = torch.Generator().manual_seed(seed)
    states = torch.randint(0, 5, (B, R, LENGTH, 2), generator=g).float()
    return Windows(states, torch.randint(0, 5, (B, R, LENGTH), generator=g), torch.rand(B, R, LENGTH, generator=g))


def part(of, *place):
    return type(of)(*(column[place] for column in of))


@torch.no_grad()
def test_the_first_state_of_a_stretch_is_a_query_alone_and_stretches_do_not_see_each_other():
    model, whole, of = build(SPEC), transitions(), windows()
    prefix = torch.tensor([[0, 7], [3, T], [1, 2]])
    cache = model.encode(whole)
    together = model.decide_windows(of, cache, prefix)
    torch.testing.assert_close(together[:, :, 0], model.decide(of.states[:, :, 0], cache, prefix), atol=1e-5, rtol=1e-5)
    for r in range(R):
        alone = model.decide_windows(part(of, slice(None), slice(r, r + 1)), cache, prefix[:, r : r + 1])
        torch.testing.assert_close(alone, together[:, r : r + 1], atol=1e-5, rtol=1e-5)
    assert together.std(dim=2).min() > 1e-3, "the states all answer alike: this would prove nothing"


@torch.no_grad()
@pytest.mark.parametrize("column", Windows._fields)
@pytest.mark.parametrize("at", range(LENGTH))
def test_what_happened_in_a_stretch_counts_for_what_comes_after_and_nothing_before(column, at):
    model, of, cache = build(SPEC), windows(), None
    cache = model.encode(transitions())
    value = getattr(of, column).clone()
    value[:, :, at] = (value[:, :, at] + 1) % 5
    one, two = (model.decide_windows(s, cache, torch.full((B, R), T)) for s in (of, of._replace(**{column: value})))
    moved = (one - two).abs().amax(dim=(0, 1, 3))
    first = at if column == "states" else at + 1
    assert (moved[:first] < 1e-6).all() and (moved[first:] > 1e-4).all()


@torch.no_grad()
@pytest.mark.parametrize("heads", [1, 2])
@pytest.mark.parametrize("together", [set(), {0, 7}, {9, 10}], ids=str)
def test_a_context_that_grows_one_by_one_decides_as_in_training(heads, together):
    """Whether transitions arrive with a decision or (``together``) several at once."""
    model, whole, of = build(SPEC, heads), transitions(), part(windows(), slice(None), slice(0, 1))
    deployed, t = DeployedTransformer(model, B), 0
    while t < T:
        expected = model.decide_windows(of, model.encode(part(whole, slice(None), slice(0, t + 1))), torch.full((B, 1), t + 1))
        arrived = part(whole, slice(None), slice(t, t + 1))
        torch.testing.assert_close(deployed.decide_window(of, arrived), expected[:, 0, -1], atol=1e-5, rtol=1e-5)
        assert deployed.length == t + 1
        torch.testing.assert_close(deployed.decide_window(of), expected[:, 0, -1], atol=1e-5, rtol=1e-5)
        if t in together:
            deployed.append(part(whole, slice(None), slice(t + 1, t + 4)))
            t += 3
        t += 1
    expected = model.decide(of.states[:, 0, :1], model.encode(whole))[:, 0]
    torch.testing.assert_close(deployed.decide(of.states[:, 0, 0]), expected, atol=1e-5, rtol=1e-5)


def outputs_of(model, history, zeta, state):
    """T_theta at every state of zeta and at this one after it, given a list of (s, a, s', r): encoded from nothing."""
    s, a, n, r = zip(*history, strict=True) if history else ([], [], [], [])
    seen = Transitions(
        torch.tensor(np.array(s, np.float32)).reshape(1, -1, 2),
        torch.tensor(np.array(a, np.int64)).reshape(1, -1),
        torch.tensor(np.array(n, np.float32)).reshape(1, -1, 2),
        torch.tensor(np.array(r, np.float32)).reshape(1, -1),
    )
    states = [z[0] for z in zeta] + [state]
    of = Windows(
        torch.tensor(np.array(states, np.float32))[None, None],
        torch.tensor([z[1] for z in zeta] + [0])[None, None],
        torch.tensor([float(z[2]) for z in zeta] + [0.0])[None, None],
    )
    with torch.no_grad():
        found = model.decide_windows(of, model.encode(seen), torch.tensor([[len(history)]]))
    return found[0, 0, -1].double().softmax(-1).numpy()


def slow(model, variation, row, trials, most):
    """The committed deployment in one environment, one step at a time."""
    env, kept, acted = registry.batch([variation]), [], []
    for trial in range(trials):
        rng = np.random.default_rng((trial, row))
        state, u, this = env.reset([rng])[0], rng.random(HORIZON), []
        for h in range(HORIZON):
            zeta = [(s, a, r) for s, a, _, r in this][-(LENGTH - 1) :]
            p = outputs_of(model, [*itertools.chain(*kept), *this], zeta, state)
            action = int((u[h] * p.sum() >= p.cumsum()[:-1]).sum())
            step = env.step(np.array([action]))
            this.append((state, action, step.observation[0], step.reward[0]))
            state = step.observation[0]
        acted.append([t[1] for t in this])
        kept.append(this)
        while sum(map(len, kept)) > most:
            kept.pop(0)
    return acted


def variations():
    adversary = Adversary.of("uniform", p=0.3)
    return [Variation(room.task(goal, 5, HORIZON), adversary) for goal in ((0, 2), (1, 1), (4, 0))]


@pytest.mark.parametrize("most", [1000, 2 * HORIZON + 1])
def test_the_committed_deployment_is_the_slow_loop(most):
    model, rows = build(SPEC), variations()
    policy = CommittedPolicy(model, B, ContextConfig(max=most))
    chance = ([np.random.default_rng((trial, row)) for row in range(B)] for trial in range(4))
    ran = [e.actions for e in deploy_online(registry.batch(rows), policy, chance)]
    expected = [slow(model, variation, row, 4, most) for row, variation in enumerate(rows)]
    assert np.array_equal(ran, np.array(expected).transpose(1, 0, 2))
    assert policy.length == min(4, most // HORIZON) * HORIZON


def test_every_transition_joins_the_context_at_once_and_asking_changes_nothing():
    model = build(SPEC)
    state, step = np.ones((B, 2), np.float32), np.zeros(B, np.int64)
    asked, silent = (CommittedPolicy(model, B, ContextConfig()) for _ in range(2))
    for count in range(HORIZON):
        for _ in range(2):
            law = asked.probabilities(state)
            assert asked.length == count
        if count in (3, 5):
            np.testing.assert_allclose(silent.probabilities(state), law, atol=1e-6)
        for policy in (asked, silent):
            policy.observe(state, step + count % 5, np.full(B, count % 2, np.float32), state, count == HORIZON - 1)
    assert asked.length == silent.length == HORIZON
    np.testing.assert_allclose(silent.probabilities(state), asked.probabilities(state), atol=1e-6)


def test_a_model_without_stretches_is_not_committed():
    with pytest.raises(ConfigError, match=r"model\.window = 1") as caught:
        InContextAgent(build(SPEC, window=1), {}, ContextConfig(), deploy="committed")
    assert "\n" not in str(caught.value)
    kinds = {1: InContextPolicy, LENGTH: CommittedPolicy}
    for window, kind in kinds.items():
        assert type(deployment.in_context(build(SPEC, window=window), 1, ContextConfig())) is kind
    assert type(deployment.in_context(build(SPEC), 1, ContextConfig(), "paper")) is InContextPolicy


# Where stretches come from.


@pytest.fixture
def run(small_run):
    return dataclasses.replace(
        small_run,
        method="icag",
        pretrain=dataclasses.replace(small_run.pretrain, windows=2, decoy_fraction=0.5),
        model=dataclasses.replace(small_run.model, window=LENGTH),
        optim=dataclasses.replace(small_run.optim, windows=3),
    )


def collected(run, decoy_fraction):
    run = dataclasses.replace(run, pretrain=dataclasses.replace(run.pretrain, decoy_fraction=decoy_fraction))
    phase = METHODS[run.method].phases(run)[0]
    return METHODS[run.method].ask(run, phase)


def followed(run, t):
    """States, actions, rewards and labels of a trajectory's windows."""
    alone = len(t.queries) - len(t.taken)
    assert (alone, len(t.taken)) == (run.pretrain.queries, 2 * LENGTH)
    cells = cell_numbers(t.queries[alone:], 3).reshape(2, LENGTH)
    return cells, t.taken.reshape(2, LENGTH), t.gained.reshape(2, LENGTH), t.labels[alone:].reshape(2, LENGTH, -1)


@pytest.mark.parametrize("decoy_fraction", [0.0, 1.0])
def test_stretches_are_lived_in_the_variation_and_labelled_for_it(run, decoy_fraction):
    starts, right = set(), []
    for job in collected(run, decoy_fraction):
        for t in jobs.do(job, None, "w"):
            truth = soft_labels(Hypotheses.of([t.variation]), run.darkroom.gamma, run.darkroom.label_slack)[0]
            cells, taken, gained, labels = followed(run, t)
            starts |= set(cells[:, 0].tolist())
            np.testing.assert_array_equal(labels, truth[cells])
            goal = int(t.variation.task.vector("goal")[0] * 3 + t.variation.task.vector("goal")[1])
            np.testing.assert_array_equal(gained[:, :-1] == 1, cells[:, 1:] == goal)
            if t.variation.adversary.kind == "null":
                np.testing.assert_array_equal(next_cell(3)[cells[:, :-1], taken[:, :-1]], cells[:, 1:])
            right.append((np.take_along_axis(labels, taken[:, :, None].astype(np.int64), axis=2) > 0).mean())
    assert starts == set(range(9))
    assert np.mean(right) == 1 if decoy_fraction == 0 else np.mean(right) < 0.9


def test_a_trajectorys_stretches_are_its_own_whatever_the_job_holds(run):
    job: Job = collected(run, 0.5)[0]
    whole = {t.identity: t for t in jobs.do(job, None, "w")}
    count = len(job.variations) // job.tasks
    for row, (task, k) in enumerate(job.rows()):
        alone = dataclasses.replace(job, task=task, first=k, variations=job.variations[row : row + 1], tasks=1)
        for t in jobs.do(alone, None, "w"):
            for name, array in t.arrays().items():
                np.testing.assert_array_equal(array, getattr(whole[t.identity], name), err_msg=name)
    assert count > 1


def test_training_draws_stretches_of_the_contexts_variation():
    rng = np.random.default_rng(0)

    def examples(mark):
        states = np.full((4, LENGTH, 2), mark, np.float32) + np.arange(4, dtype=np.float32)[:, None, None] / 10
        of = batches.LabelledWindows(
            states, np.full((4, LENGTH), mark), states[..., 0], np.full((4, LENGTH, 5), mark, np.float32)
        )
        flat = np.full((6, HORIZON), mark)
        return Examples(
            flat,
            np.full((6, HORIZON + 1, 2), mark, np.float32),
            flat.astype(np.float32),
            states[:, 0],
            of.labels[:, 0],
            False,
            of,
        )

    pool = Pool(1.0, [examples(1), examples(2)], 3)
    chosen, prefixes = set(), set()
    for _ in range(30):
        batch = batches.draw(rng, [pool], 8, 2, windows=3)
        assert batch.windows.states.shape == (8, 3, LENGTH, 2)
        for row in range(8):
            mark = batch.actions[row, 0]
            assert (batch.windows.taken[row] == mark).all() and (batch.windows.labels[row] == mark).all()
            assert ((batch.windows.states[row] // 1) == mark).all()
            np.testing.assert_array_equal(batch.windows.gained[row], batch.windows.states[row, :, :, 0])
        chosen |= set(np.round(batch.windows.states[:, :, 0, 0] % 1 * 10).astype(int).ravel().tolist())
        prefixes |= set(batch.window_prefix.ravel().tolist())
    assert chosen == {0, 1, 2, 3} and prefixes == set(range(3 * HORIZON + 1))
    with pytest.raises(ValueError, match="windows"):
        batches.draw(rng, [Pool(1.0, [dataclasses.replace(examples(1), windows=None)], 1)], 2, 2, windows=1)


def test_every_label_counts_the_same(run):
    model, rng = build(SPEC), np.random.default_rng(0)
    whole, of = transitions(), windows()
    labels, followed_labels = (rng.dirichlet([0.5] * 5, size=shape).astype(np.float32) for shape in ((B, 6), (B, R, LENGTH)))
    prefix, window_prefix = rng.integers(0, T + 1, size=(B, 6)), rng.integers(0, T + 1, size=(B, R))
    queries = rng.integers(0, 5, size=(B, 6, 2)).astype(np.float32)
    s, a, n, r = (column.numpy() for column in whole)
    batch = batches.Batch(
        s, a, n, r, queries, labels, prefix, batches.LabelledWindows(*(c.numpy() for c in of), followed_labels), window_prefix
    )
    cache, total = model.encode(whole), 0.0
    with torch.no_grad():
        law = model.decide(torch.tensor(queries), cache, torch.tensor(prefix)).log_softmax(-1).numpy()
        total -= (law * labels).sum()
        law = model.decide_windows(of, cache, torch.tensor(window_prefix)).log_softmax(-1).numpy()
        total -= (law * followed_labels).sum()
        assert fit.batch_loss(model, batch).item() == pytest.approx(total / (B * (6 + R * LENGTH)), rel=1e-5)


def test_own_trials_are_cut_into_stretches_that_do_not_cross_episodes(run):
    run = dataclasses.replace(run, method="icaa", icaa=dataclasses.replace(run.icaa, label_trials="later"))
    policies = Fixed(splits.spec(run), run.model)
    phase = METHODS["icaa"].phases(run)[1]
    job = METHODS["icaa"].ask(run, phase)[0]
    assert job.setting("deploy") == "committed"
    made = [t for t in jobs.do(job, policies, "w") if t.identity[2:4] == (job.task, 0)]
    from icrl_dist.methods.recipes import self_labelled

    of = self_labelled(run, made).windows
    later = made[run.icaa.context_trials + 1 :]
    expected = [(t, h) for t in later for h in range(0, run.darkroom.horizon // LENGTH * LENGTH, LENGTH)]
    assert len(of.states) == len(expected)
    for n, (t, h) in enumerate(expected):
        np.testing.assert_array_equal(of.states[n], t.observations[h : h + LENGTH])
        np.testing.assert_array_equal(of.taken[n], t.actions[h : h + LENGTH])
        np.testing.assert_array_equal(of.gained[n], t.rewards[h : h + LENGTH])
        np.testing.assert_array_equal(of.labels[n].argmax(axis=1), t.actions[h : h + LENGTH])


class Fixed:
    """Weights of any version: the same model."""

    def __init__(self, spec, config):
        torch.manual_seed(0)
        self._model = PretrainedTransformer(spec, config).eval()

    def at(self, version):
        return self._model, f"digest {version}"


# The same code where actions are vectors.


class Valley:
    """A toy game: a point in [-1, 1]^2 moves by a tenth of its action; the reward is 1 near a hidden goal on the edge."""

    GOALS = np.array([[0.8, 0.0], [-0.8, 0.0], [0.0, 0.8], [0.0, -0.8]], np.float32)

    def __init__(self, goals):
        self.spec = Spec((-1.0, -1.0), (1.0, 1.0), actions=2, horizon=12, discrete=False)
        self.batch, self._goals = len(goals), self.GOALS[goals]

    def reset(self, rngs):
        self._h, self._at = 0, np.zeros((self.batch, 2), np.float32)
        return self._at

    def step(self, actions):
        assert actions.shape == (self.batch, 2) and np.abs(actions).max() <= 1
        self._h += 1
        self._at = np.clip(self._at + 0.2 * actions, -1, 1).astype(np.float32)
        near = (np.abs(self._at - self._goals).sum(axis=1) < 0.4).astype(np.float32)
        return Step(self._at, near, self._h == self.spec.horizon, np.full(self.batch, -1, np.int16))

    @classmethod
    def right(cls, states, goal):
        return np.clip(5 * (cls.GOALS[goal] - states), -1, 1).astype(np.float32)


class Anywhere(InContextPolicy):
    """Uniform actions, to compare with and to collect contexts by."""

    def act(self, observation, u):
        return (2 * u - 1).astype(np.float32)

    def observe(self, *transition):
        pass

    def append(self, *columns):
        pass


def lived(goal, rng, episodes):
    """Examples of one goal: walks that random goals lead, and windows, some of which another goal leads."""
    walks, states = [], rng.uniform(-1, 1, size=(64, 2)).astype(np.float32)
    for _ in range(episodes):
        env = Valley([goal])
        seen, acted, gained = [env.reset(None)], [], []
        while len(acted) < 12:
            if len(acted) % 4 == 0:
                leads = rng.integers(0, 4, size=1)
            way = np.clip(Valley.right(seen[-1], leads) + rng.normal(size=(1, 2)) / 5, -1, 1).astype(np.float32)
            step = env.step(way)
            seen.append(step.observation), acted.append(way), gained.append(step.reward)
        walks.append([np.concatenate(column) for column in (seen, acted, gained)])
    at = rng.uniform(-1, 1, size=(32, 2)).astype(np.float32)
    guess = np.where(rng.random(32) < 0.3, rng.integers(0, 4, size=32), goal)
    path = [at]
    for _ in range(LENGTH):
        path.append(np.clip(path[-1] + 0.2 * Valley.right(path[-1], guess), -1, 1).astype(np.float32))
    along = np.stack(path, axis=1)
    near = (np.abs(along[:, 1:] - Valley.GOALS[goal]).sum(axis=2) < 0.4).astype(np.float32)
    of = batches.LabelledWindows(
        along[:, :-1], Valley.right(along[:, :-1], guess[:, None]), near, Valley.right(along[:, :-1], np.array(goal))
    )
    seen, acted, gained = (np.stack(column) for column in zip(*walks, strict=True))
    return Examples(acted, seen, gained, states, Valley.right(states, np.array(goal)), False, of)


def test_the_same_code_learns_and_deploys_a_game_of_continuous_actions():
    rng = np.random.default_rng(0)
    spec = Valley([0]).spec
    torch.manual_seed(0)
    model = PretrainedTransformer(spec, ModelConfig(2, 1, 32, window=LENGTH))
    optim = OptimConfig(learning_rate=8e-3, muon=5.0, batch=16, queries=32, windows=8, episodes=2, beta2=0.98, warmup=20)
    pool = Pool(1.0, [lived(goal, rng, 30) for goal in range(4)], optim.episodes)
    opt = fit.Optimizer(model, optim)
    fit.fit(model, opt, optim, 8e-3, 150, lambda step: batches.draw(np.random.default_rng(step), [pool], 16, 32, windows=8))
    goals, names = [0, 1, 2, 3] * 8, ("observations", "actions", "rewards")

    def earned(policy):
        for n in range(4):  # D_off: walks of others
            seen = [lived(goal, np.random.default_rng((n, row)), 1) for row, goal in enumerate(goals)]
            states, acted, gained = (np.concatenate([getattr(e, name) for e in seen]) for name in names)
            policy.append(states[:, :-1], acted, states[:, 1:], gained)
        ran = [episode(Valley(goals), policy, np.random.default_rng(9 + n).spawn(32)) for n in range(3)]
        assert all(e.actions.dtype == np.float32 and e.actions.shape == (32, 12, 2) for e in ran)
        return np.mean([e.returns for e in ran])

    best = 12 - 3
    assert earned(CommittedPolicy(model, 32, ContextConfig())) > 0.6 * best
    assert earned(InContextPolicy(model, 32, ContextConfig())) > 0.6 * best
    assert earned(Anywhere(model, 32, ContextConfig())) < 0.25 * best
    agent = InContextAgent(model, {}, ContextConfig(), seed=0)
    agent.reset_context(2)
    action = agent.act(np.zeros((2, 2)))
    assert action.shape == (2, 2)
    agent.observe(np.zeros((2, 2)), action, [0, 0], np.zeros((2, 2)), [False, False])
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.copy_(parameter.flatten()[torch.randperm(parameter.numel())].view_as(parameter))
    assert earned(CommittedPolicy(model, 32, ContextConfig())) < 0.4 * best, "what it knew was in the weights"


def test_a_gaussian_head_is_its_formulas():
    rng = np.random.default_rng(0)
    out, value = rng.normal(size=(3, 4)), rng.uniform(-1, 1, size=(3, 2))
    total = 0.0
    for row in range(3):
        for c in range(2):
            deviation = 0.05 + math.log1p(math.exp(out[row, 2 + c]))
            total += 0.5 * ((value[row, c] - out[row, c]) / deviation) ** 2 + math.log(deviation * math.sqrt(2 * math.pi))
    head = Gaussian(2)
    assert head.loss(torch.tensor(out), torch.tensor(value)).item() == pytest.approx(total / 3)
    assert head.log_likelihood(torch.tensor(out), torch.tensor(value)).shape == (3,)
    u = np.broadcast_to(((np.arange(20001) + 0.5) / 20001)[:, None], (20001, 2))
    narrow = torch.tensor([[0.2, -0.1, -9.0, -2.0]]).expand(20001, 4)
    acted = head.act(narrow, u)
    np.testing.assert_allclose(acted.mean(axis=0), [0.2, -0.1], atol=1e-3)
    np.testing.assert_allclose(acted.std(axis=0), [0.05 + math.log1p(math.exp(-9)), 0.05 + math.log1p(math.exp(-2))], atol=2e-3)
    assert np.abs(head.act(torch.tensor([[9.0, -9.0, 0.0, 0.0]]), np.array([[0.5, 0.5]]))).max() == 1
