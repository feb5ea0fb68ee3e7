"""Experts in lockstep: the same numbers as stable-baselines3, and one that learns a real game."""

import dataclasses
import subprocess
import sys

import gymnasium
import numpy as np
import pytest
import stable_baselines3
import torch
from stable_baselines3.common.buffers import ReplayBufferSamples
from stable_baselines3.common.logger import configure

from icrl_dist.config.sac import SACConfig
from icrl_dist.experts.sac.batched import SACBatch, pick, train
from icrl_dist.experts.sac.draws import of_updates
from icrl_dist.experts.sac.lockstep import draw
from icrl_dist.experts.sac.one import Expert
from icrl_dist.experts.sac.replay import Replay, Transitions
from icrl_dist.experts.sac.stacked import outputs
from icrl_dist.types import Spec, Step

S, A, N = 17, 6, 3
SPEC = Spec((-10.0,) * S, (10.0,) * S, A, 200, discrete=False)
PAPER = SACConfig(replay=100)
SMALL = SACConfig(hidden=(16, 8), batch=12, replay=100, actor_rate=1e-3)


class Spaces(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(-10, 10, (S,), np.float32)
    action_space = gymnasium.spaces.Box(-1, 1, (A,), np.float32)


def drawn(config, updates, seed=0, experts=N):
    """Batches and noise of so many updates."""
    g = torch.Generator().manual_seed(seed)
    B = config.batch
    for _ in range(updates):
        seen, following = torch.randn(2, experts, B, S, generator=g)
        acted, reward = torch.rand(experts, B, A, generator=g) * 2 - 1, torch.rand(experts, B, generator=g)
        yield Transitions(seen, acted, reward, following), torch.randn(2, experts, B, A, generator=g)


class Handed:
    """A replay buffer that hands out what it is given."""

    def __init__(self, batches):
        self.batches = batches

    def sample(self, batch_size, env):
        seen, acted, reward, following = next(self.batches)
        return ReplayBufferSamples(seen, acted, following, torch.zeros(batch_size, 1), reward[:, None])


def by_sb3(model, index, batches, monkeypatch):
    """``model`` after the updates of expert ``index``."""
    batches = list(batches)
    noises = iter([noise[half, index] for _, noise in batches for half in (0, 1)])
    monkeypatch.setattr("torch.distributions.normal._standard_normal", lambda shape, dtype, device: next(noises))
    model.set_logger(configure(None, []))
    model.replay_buffer = Handed(iter([Transitions(*(column[index] for column in batch)) for batch, _ in batches]))
    for _ in batches:
        model.train(1, model.batch_size)
    assert next(noises, None) is None
    return model


def apart(model, other, part):
    """Largest difference of two models' parameters."""
    pairs = zip(getattr(model, part).parameters(), getattr(other, part).parameters(), strict=True)
    return max(float((a - b).detach().abs().max()) for a, b in pairs)


def optimizers(model):
    return [model.actor.optimizer, model.critic.optimizer, model.ent_coef_optimizer]


def opened(engine, index, path):
    engine.save_sb3(index, path)
    return stable_baselines3.SAC.load(path, device="cpu")


@pytest.mark.parametrize(("updates", "actors", "critics"), [(1, 2e-6, 4e-5), (10, 6e-6, 4e-5), (50, 6e-4, 2e-4)])
def test_updates_are_those_of_stable_baselines3(updates, actors, critics, tmp_path, monkeypatch):
    engine = SACBatch(range(N), SPEC, PAPER, "cpu")
    models = []
    for index in (0, N - 1):
        engine.save_sb3(index, tmp_path / "before.zip")
        models.append(Expert.load(tmp_path / "before.zip", device="cpu"))
    for batch, noise in drawn(PAPER, updates):
        engine.update(batch, noise)
    for index, model in zip((0, N - 1), models, strict=True):
        by_sb3(model, index, drawn(PAPER, updates), monkeypatch)
        ours = opened(engine, index, tmp_path / "after.zip")
        assert apart(ours, model, "actor") <= 3 * actors
        assert apart(ours, model, "critic") <= 3 * critics
        assert apart(ours, model, "critic_target") <= 3 * critics
        assert ours.log_ent_coef.item() == pytest.approx(model.log_ent_coef.item(), abs=1e-5)


def test_the_gradients_are_each_experts_own_sum_and_no_mean(tmp_path, monkeypatch):
    """Adam's first steps hardly depend on a gradient's size; its moments do."""
    engine = SACBatch(range(N), SPEC, SMALL, "cpu")
    engine.save_sb3(1, tmp_path / "before.zip")
    model = by_sb3(Expert.load(tmp_path / "before.zip", device="cpu"), 1, drawn(SMALL, 3), monkeypatch)
    for batch, noise in drawn(SMALL, 3):
        engine.update(batch, noise)
    ours = opened(engine, 1, tmp_path / "after.zip")
    assert len(optimizers(ours)) == len(optimizers(model)) == 3
    for one, other in zip(optimizers(ours), optimizers(model), strict=True):
        assert len(one.state) == len(other.state)
        for mine, theirs in zip(one.state.values(), other.state.values(), strict=True):
            assert mine["step"] == theirs["step"] == 3
            for moment in ("exp_avg", "exp_avg_sq"):
                size = theirs[moment].abs().max()
                assert size > 0
                torch.testing.assert_close(mine[moment], theirs[moment], rtol=1e-3, atol=float(1e-4 * size))


@pytest.mark.parametrize("batch", [16, 48])
def test_an_expert_becomes_the_same_to_the_bit_in_any_company(batch):
    config = dataclasses.replace(LINE, batch=batch, hidden=(8, 8), actor_rate=1e-2)
    seeds = [3**n for n in range(37)]
    whole = train(Line(37), config, 63, seeds, device="cpu").state()
    assert whole["updates"] == 18
    for rows in ([0], [36], [7, 20], range(4, 37)):
        part = train(Line(len(rows)), config, 63, [seeds[row] for row in rows], device="cpu").state()
        for name, array in part.items():
            np.testing.assert_array_equal(array, whole[name] if array.ndim == 0 else whole[name][list(rows)], err_msg=name)


def test_the_squashed_gaussian_where_its_deviation_is_clamped(tmp_path, monkeypatch):
    """Some log deviations are above 2.  At -20 stable-baselines3's own float32 has no digit left: there, in float64."""
    engine = SACBatch(range(N), SPEC, SMALL, "cpu")
    engine.actor_shape.layers(engine.arrays["actor"])[-1][1][..., A:] = torch.tensor([2.0, -6.0, 5.0, 2.5, 0.0, 1.0])
    engine.save_sb3(0, tmp_path / "before.zip")
    model = by_sb3(Expert.load(tmp_path / "before.zip", device="cpu"), 0, drawn(SMALL, 1), monkeypatch)
    (batch, noise), *_ = drawn(SMALL, 1)
    engine.update(batch, noise)
    ours = opened(engine, 0, tmp_path / "after.zip")
    for mine, theirs in zip(ours.actor.parameters(), model.actor.parameters(), strict=True):
        got, wanted = (m.actor.optimizer.state[p]["exp_avg"] for m, p in ((ours, mine), (model, theirs)))
        torch.testing.assert_close(got, wanted, rtol=1e-3, atol=float(1e-4 * wanted.abs().max()))


def test_a_law_and_its_derivatives_are_those_of_torch_in_float64():
    g = torch.Generator().manual_seed(0)
    output, noise, weight = (torch.randn(2, 9, n, generator=g, dtype=torch.float64) for n in (2 * A, A, A))
    output[..., A:] = output[..., A:] * 12 - 6
    output.requires_grad_()
    mean, raw = output.chunk(2, 2)
    assert int((raw < -20).sum()) > 0 and int((raw > 2).sum()) > 0
    normal = torch.distributions.Normal(mean, raw.clamp(-20, 2).exp())
    u = mean + raw.clamp(-20, 2).exp() * noise
    likelihood = (normal.log_prob(u) - (1 - u.tanh() ** 2 + 1e-6).log()).sum(2)
    ((weight * u.tanh()).sum() + likelihood.sum()).backward()
    found = draw(output.detach(), noise)
    torch.testing.assert_close(found.actions, u.detach().tanh())
    torch.testing.assert_close(found.log_likelihood, likelihood.detach(), atol=1e-5, rtol=1e-5)
    by_u = found.inner * (weight + 2 * found.actions / (found.inner + 1e-6))
    torch.testing.assert_close(output.grad[..., :A], by_u, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(output.grad[..., A:], by_u * found.scaled - found.free, atol=1e-5, rtol=1e-5)


def test_products_of_bfloat16_follow_those_of_float32():
    """Parameters stay float32; a step is that of the float32 engine up to what 8 bits leave of a gradient."""
    full, half = SACBatch(range(N), SPEC, SMALL, "cpu"), SACBatch(range(N), SPEC, SMALL, "cpu", "bfloat16")
    for batch, noise in drawn(SMALL, 20):
        full.update(batch, noise)
        half.update(batch, noise)
    for name in ("actor", "critic"):
        wanted, got = full.arrays[f"{name}/exp_avg"], half.arrays[f"{name}/exp_avg"]
        assert got.dtype == torch.float32
        assert float((got - wanted).norm() / wanted.norm()) < 0.05
        moved = half.arrays[name] - full.arrays[name]
        assert 0 < float(moved.norm() / full.arrays[name].norm()) < 0.01


def test_a_file_opens_in_stable_baselines3_and_acts_the_same(tmp_path):
    engine = SACBatch(range(N), SPEC, SMALL, "cpu")
    for batch, noise in drawn(SMALL, 5):
        engine.update(batch, noise)
    seen = np.random.default_rng(0).normal(size=(N, 7, S)).astype(np.float32)
    chosen = engine.act(seen)
    assert chosen.shape == (N, 7, A)
    np.testing.assert_allclose(engine.act(seen[:, 0]), chosen[:, 0], atol=1e-6)
    for index in range(N):
        model = opened(engine, index, tmp_path / "expert.zip")
        np.testing.assert_allclose(model.predict(seen[index], deterministic=True)[0], chosen[index], atol=1e-6)
        assert model._n_updates == 5


def test_files_come_back_as_they_were_and_as_stable_baselines3_left_them(tmp_path, monkeypatch):
    engine = SACBatch(range(N), SPEC, SMALL, "cpu")
    for batch, noise in drawn(SMALL, 5):
        engine.update(batch, noise)
    paths = [tmp_path / f"{index}.zip" for index in range(N)]
    for index, path in enumerate(paths):
        engine.save_sb3(index, path)
        again = by_sb3(Expert.load(path, device="cpu"), index, drawn(SMALL, 5, seed=1), monkeypatch)
        again.save(tmp_path / f"later-{index}.zip")
    other = SACBatch(range(7, 7 + N), SPEC, SMALL, "cpu")
    other.load_sb3(paths)
    assert other.updates == 5
    for name, array in engine.arrays.items():
        assert torch.equal(other.arrays[name], array), name
    for batch, noise in drawn(SMALL, 5, seed=1):
        other.update(batch, noise)
    engine.load_sb3([tmp_path / f"later-{index}.zip" for index in range(N)])
    assert engine.updates == other.updates == 10
    for name, array in engine.arrays.items():
        torch.testing.assert_close(other.arrays[name], array, atol=2e-5, rtol=1e-3)


def test_an_expert_that_has_never_been_updated_comes_back_too(tmp_path):
    engine, other = SACBatch([0], SPEC, SMALL, "cpu"), SACBatch([1], SPEC, SMALL, "cpu")
    engine.save_sb3(0, tmp_path / "first.zip")
    other.load_sb3([tmp_path / "first.zip"])
    assert other.updates == 0 and all(torch.equal(other.arrays[name], array) for name, array in engine.arrays.items())


def test_files_of_another_shape_length_or_kind_are_refused(tmp_path):
    engine = SACBatch(range(2), SPEC, SMALL, "cpu")
    paths = [tmp_path / "0.zip", tmp_path / "1.zip"]
    engine.save_sb3(0, paths[0])
    with pytest.raises(ValueError, match="1 files for 2 experts"):
        engine.load_sb3(paths[:1])
    for batch, noise in drawn(SMALL, 1, experts=2):
        engine.update(batch, noise)
    engine.save_sb3(1, paths[1])
    with pytest.raises(ValueError, match=r"after \[0, 1\] updates"):
        engine.load_sb3(paths)
    wide = SACBatch([0], SPEC, dataclasses.replace(SMALL, hidden=(16, 9)), "cpu")
    with pytest.raises(ValueError, match=r"hidden layers \[16, 8\], not 17, 6 and \(16, 9\)"):
        wide.load_sb3(paths[:1])
    fixed = stable_baselines3.SAC(
        "MlpPolicy", Spaces(), policy_kwargs={"net_arch": [16, 8]}, ent_coef=0.1, buffer_size=1, device="cpu"
    )
    fixed.save(paths[0])
    with pytest.raises(ValueError, match="temperature is fixed"):
        SACBatch([0], SPEC, SMALL, "cpu").load_sb3(paths[:1])
    for low, between, words in ((-1, torch.nn.Tanh, "with Tanh between"), (-2, torch.nn.ReLU, r"actions from \[-2.0")):
        spaces = Spaces()
        spaces.action_space = gymnasium.spaces.Box(low, 1, (A,), np.float32)
        kinds = {"net_arch": [16, 8], "activation_fn": between}
        stable_baselines3.SAC("MlpPolicy", spaces, policy_kwargs=kinds, buffer_size=1, device="cpu").save(paths[0])
        with pytest.raises(ValueError, match=words):
            SACBatch([0], SPEC, SMALL, "cpu").load_sb3(paths[:1])


def test_no_update_touches_the_global_generators(tmp_path):
    torch.manual_seed(3)
    before = torch.get_rng_state(), np.random.get_state()[1].tolist()
    engine = SACBatch([0], SPEC, SMALL, "cpu")
    engine.save_sb3(0, tmp_path / "expert.zip")
    engine.load_sb3([tmp_path / "expert.zip"])
    seen, acted = np.ones((1, S), np.float32), np.ones((1, A), np.float32)
    engine.remember(seen, acted, Step(seen, np.ones(1, np.float32), False, np.zeros((1, 2), np.float32)))
    ((picks, noise),) = of_updates([0], 0, (SMALL.batch, A), 1, torch.device("cpu"))
    engine.learn(picks, noise)
    assert torch.equal(before[0], torch.get_rng_state()) and before[1] == np.random.get_state()[1].tolist()


def test_actions_are_drawn_from_the_squashed_gaussian():
    engine = SACBatch([0], SPEC, SMALL, "cpu")
    weights, bias = engine.actor_shape.layers(engine.arrays["actor"])[-1]
    weights.zero_()
    bias[0, 0] = torch.tensor([0.0, 0.5, -0.5, 0.0, 1.0, 0.2, -1.0, -2.0, -30.0, 9.0, -1.0, -1.0])
    noise = np.random.default_rng(0).standard_normal((1, 20000, A), dtype=np.float32)
    drawn_ = engine.act(np.zeros((1, 20000, S), np.float32), noise)[0].astype(np.float64)
    normal = np.arctanh(np.clip(drawn_, -1 + 1e-7, 1 - 1e-7))
    np.testing.assert_allclose(np.median(normal, axis=0), [0.0, 0.5, -0.5, 0.0, 1.0, 0.2], atol=0.15)
    np.testing.assert_allclose(normal.std(axis=0)[[0, 1, 2, 4]], np.exp([-1.0, -2.0, -20.0, -1.0]), rtol=0.03, atol=1e-6)
    assert np.quantile(np.abs(normal[:, 3]), 0.3) == pytest.approx(np.exp(2.0) * 0.385, rel=0.05)


def test_the_replay_forgets_the_oldest_and_draws_each_experts_own():
    replay = Replay(2, 4, 2, 1, torch.device("cpu"))
    with pytest.raises(IndexError, match="add transitions first"):
        replay.take(torch.zeros(2, 1, dtype=torch.int64))
    for step in range(6):
        here = torch.tensor([[step, 0.0], [step, 1.0]])
        replay.add(here, here[:, :1] / 10, here[:, 0] * 2, here + 1)
    assert (len(replay), replay.added) == (4, 6)
    ((picks, _),) = of_updates([0, 1], 0, (500, 1), 1, torch.device("cpu"))
    found = replay.take(picks)
    for expert_ in range(2):
        steps, own = found.observations[expert_].T
        assert set(own.tolist()) == {float(expert_)} and set(steps.tolist()) == {2.0, 3.0, 4.0, 5.0}
        assert torch.bincount(steps.long())[2:].min() > 80
        assert torch.equal(found.rewards[expert_], steps * 2) and torch.equal(found.actions[expert_, :, 0], steps / 10)
        assert torch.equal(found.following[expert_], found.observations[expert_] + 1)
    assert not torch.equal(found.observations[0, :, 0], found.observations[1, :, 0]), "both draw the same places"
    again = Replay(2, 4, 2, 1, torch.device("cpu"))
    again.load(replay.state())
    for column, other in zip(found, again.take(picks), strict=True):
        assert torch.equal(column, other)
    with pytest.raises(ValueError, match="do not fit 2 experts of 5 transitions"):
        Replay(2, 5, 2, 1, torch.device("cpu")).load(replay.state())


class Line:
    """N places on a line that actions move; each row draws its start, and the reward is where one stands."""

    def __init__(self, batch, horizon=7):
        self.spec, self.batch = Spec((-9.0, 0.0), (9.0, 9.0), 1, horizon, discrete=False), batch
        self.starts, self.acted = [], []

    def _seen(self):
        return np.stack([self.at, np.full(self.batch, self.time)], axis=1).astype(np.float32)

    def reset(self, rngs):
        self.time, self.at = 0, np.array([rng.uniform(-1, 1) for rng in rngs], np.float32)
        self.starts.append(self.at)
        return self._seen()

    def step(self, actions):
        self.time, self.at = self.time + 1, self.at + actions[:, 0]
        self.acted.append(actions)
        return Step(self._seen(), self.at, self.time == self.spec.horizon, np.full(self.batch, -1, np.int16))


class Broken(Line):
    """The second row breaks down at step 3, and shows no numbers from then on."""

    def step(self, actions):
        made = super().step(actions)
        lost = np.array([False, self.time >= 3])
        return made._replace(reward=np.where(lost, np.nan, made.reward).astype(np.float32), diverged=lost)


LINE = SACConfig(hidden=(8,), batch=4, random_steps=5, warmup=9, update_every=3, replay=1000)


def test_the_target_bootstraps_through_the_time_limit():
    """The last step of an episode is remembered with what was seen at the limit, and its target has what is to come."""
    heard = []
    engine = train(Line(2), LINE, 14, [0, 1], lambda _, returns: heard.append(returns), "cpu")
    rows = torch.from_numpy(engine.replay.state()["rows"])
    assert rows.shape == (2, 14, 6) and rows[:, 6, 5].tolist() == [7, 7] and rows[:, 7, 1].tolist() == [0, 0]
    np.testing.assert_allclose(np.array(heard), rows[:, :, 3].reshape(2, 2, 7).sum(2).T, rtol=1e-5)
    last = rows[:, [6, 6, 13, 13]]
    batch = Transitions(last[..., :2], last[..., 2:3], last[..., 3], last[..., 4:])
    noise = torch.randn(2, 2, 4, 1, generator=torch.Generator().manual_seed(0))
    before = {name: array.clone() for name, array in engine.arrays.items()}
    engine.arrays["critic/exp_avg"].zero_()
    engine.update(batch, noise)
    for expert_ in range(2):
        mean, spread = outputs(
            engine.actor_shape, before["actor"][expert_ : expert_ + 1], batch.following[expert_ : expert_ + 1]
        )[0].chunk(2, 1)
        u = mean + spread.clamp(-20, 2).exp() * noise[1, expert_]
        normal = torch.distributions.Normal(mean, spread.clamp(-20, 2).exp())
        entropy = -(normal.log_prob(u) - (1 - u.tanh() ** 2 + 1e-6).log()).sum(1)
        read = torch.cat([batch.following[expert_], u.tanh()], dim=1).expand(2, -1, -1)
        to_come = outputs(engine.critic_shape, before["target"][expert_], read)[..., 0].amin(0)
        to_come = to_come + before["log_temperature"][expert_].exp() * entropy
        wanted = batch.rewards[expert_] + 0.9 * to_come
        now = outputs(
            engine.critic_shape,
            before["critic"][expert_],
            torch.cat([batch.observations, batch.actions], 2)[expert_].expand(2, -1, -1),
        )
        error = (now[..., 0] - wanted).mean(1)  # the derivative by the last bias
        got = engine.critic_shape.layers(engine.arrays["critic/exp_avg"][expert_])[-1][1][:, 0, 0] / 0.1
        torch.testing.assert_close(got, error, rtol=1e-3, atol=1e-5)


def test_actions_are_uniform_for_the_random_steps_and_the_experts_then(monkeypatch):
    asked, act = [], SACBatch.act
    monkeypatch.setattr(SACBatch, "act", lambda self, *given: asked.append(self.steps) or act(self, *given))
    line = Line(400)
    train(line, LINE, 14, range(400), device="cpu")
    assert asked == list(range(5, 14))
    uniform = np.stack(line.acted)[:5].ravel()
    assert np.abs(np.quantile(uniform, [0.1, 0.5, 0.9]) - [-0.8, 0.0, 0.8]).max() < 0.08


def test_a_training_draws_by_its_seed_alone_and_goes_on_from_a_state():
    kept = {}

    def keep(engine, returns):
        kept[engine.steps] = engine.state()

    line = Line(2)
    whole = train(line, LINE, 35, [5, 6], keep, "cpu").state()
    assert whole["updates"] == 8  # after the steps 12, 15, ..., 33, not yet after 9
    assert len({tuple(start) for start in line.starts}) == 5 and len({x for start in line.starts for x in start}) == 10
    np.random.seed(1)
    torch.manual_seed(1)
    for again in (
        train(Line(2), LINE, 35, [5, 6], device="cpu"),
        train(Line(2), LINE, 35, [5, 6], device="cpu", state=kept[14]),
    ):
        state = again.state()
        assert set(state) == set(whole)
        for name, array in whole.items():
            np.testing.assert_array_equal(state[name], array, err_msg=name)
    other = train(Line(2), LINE, 35, [6, 7], device="cpu").state()
    assert not np.array_equal(other["actor"], whole["actor"])
    cut = train(Line(2), LINE, 36, [5, 6], device="cpu").state()
    with pytest.raises(ValueError, match="step 36, within an episode of 7"):
        train(Line(2), LINE, 70, [5, 6], device="cpu", state=cut)


class Wild(Broken):
    """Says nothing of it."""

    def step(self, actions):
        return super().step(actions)._replace(diverged=None)


def test_a_simulation_that_breaks_down_teaches_nothing():
    engine = train(Broken(2), LINE, 28, [0, 1], device="cpu")
    rows = engine.replay.state()["rows"]
    assert np.isfinite(rows).all() and engine.updates > 0
    assert rows[0, :7, 1].tolist() == [0, 1, 2, 3, 4, 5, 6] and rows[1, :8, 1].tolist() == [0, 1, 1, 1, 1, 1, 1, 0]
    first = Replay(1, 4, 2, 1, torch.device("cpu"))
    first.add(torch.ones(1, 2), torch.ones(1, 1), torch.ones(1), torch.ones(1, 2), torch.tensor([True]))
    assert not first.state()["rows"].any()


def test_weights_that_are_no_numbers_stop_a_training():
    with pytest.raises(FloatingPointError, match=r"experts \[1\] .* step 12: lower the learning rates"):
        train(Wild(2), LINE, 28, [0, 1], device="cpu")
    with pytest.raises(ValueError, match="1 seeds for 2 environments"):
        train(Line(2), LINE, 28, [0], device="cpu")


def test_what_it_cannot_be_made_of_is_refused(monkeypatch):
    with pytest.raises(ValueError, match=r"0 experts"):
        SACBatch(range(0), SPEC, SMALL, "cpu")
    with pytest.raises(ValueError, match=r"discrete = True"):
        SACBatch([0], Spec((0.0,), (1.0,), 3, 5), SMALL, "cpu")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert pick("auto").type == "cpu"
    with pytest.raises(ValueError, match="torch finds no GPU"):
        pick("cuda")
    with pytest.raises(ValueError, match=r"actor has the shape \(2, .*not \(1, "):
        state = SACBatch(range(2), SPEC, SMALL, "cpu").state()
        engine = SACBatch([0], SPEC, SMALL, "cpu")
        engine._take({name: torch.from_numpy(state[name]) for name in engine.arrays}, 0)


def test_an_expert_learns_to_balance_the_pole_within_12000_steps():
    """Its mean action, in ten episodes of its own that it does not learn from, looked at every 1,000 steps."""
    ran = subprocess.run([sys.executable, "-m", "tests.pole"], capture_output=True, text=True, timeout=550)
    heard = [float(line) for line in ran.stdout.splitlines()]
    assert ran.returncode == 0 and heard[-1] >= 190 and len(heard) <= 12, ran.stdout + ran.stderr
    assert heard[0] < 170, "there was nothing to learn"
