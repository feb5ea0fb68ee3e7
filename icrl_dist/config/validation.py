"""What a run's numbers may be: well typed is not enough."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

from icrl_dist.config import sac
from icrl_dist.config.sac import PROBLEMS
from icrl_dist.config.toml import ConfigError, nearest
from icrl_dist.problems.continuous import calibrated_strength
from icrl_dist.stream import endpoints

if TYPE_CHECKING:
    from icrl_dist.config.run import Run


def validate(run: Run, source: str) -> None:
    """Raises ConfigError for values that are well typed but impossible."""

    def need(condition: bool, where: str, value: object, remedy: str) -> None:
        if not condition:
            raise ConfigError(f"{source}: {where} = {value!r}: {remedy}")

    if run.problem not in PROBLEMS:
        known = f"choose one of {', '.join(PROBLEMS)}"
        raise ConfigError(f"{source}: problem = {run.problem!r}{nearest(run.problem, PROBLEMS)}: {known}")
    room, icaa, dagger, optim = run.darkroom, run.icaa, run.dagger, run.optim
    need(room.size >= 2, "darkroom.size", room.size, "a room has at least 2 cells a side")
    need(room.horizon >= 1, "darkroom.horizon", room.horizon, "an episode has at least 1 step")
    need(0 < room.train_fraction < 1, "darkroom.train_fraction", room.train_fraction, "use a share between 0 and 1")
    need(0 < room.gamma <= 1, "darkroom.gamma", room.gamma, "a discount lies in (0, 1]")
    train = round(room.train_fraction * room.size**2)
    need(0 < train < room.size**2, "darkroom.train_fraction", room.train_fraction, "leave goals to train and to test")
    need(0 <= run.adversary.p_max <= 1, "adversary.p_max", run.adversary.p_max, "a probability lies in [0, 1]")
    need(run.adversary.count >= 1, "adversary.count", run.adversary.count, "at least 1, the null adversary")
    need(run.seed >= 0, "seed", run.seed, "seeds are not negative")
    for p in run.evaluate.p:
        need(0 <= p <= 1, "evaluate.p", p, "a probability lies in [0, 1]")
    need(len(run.evaluate.p) > 0, "evaluate.p", run.evaluate.p, "name at least one override probability")
    room_or_game = "Dark Room has exact labels and no experts: use dpt, icag or icaa"
    if isinstance(run.control.strength, str):
        try:
            calibrated_strength.share(run.control.strength)
        except ConfigError as error:
            raise ConfigError(f"{source}: {error}") from None
        in_rooms = "Dark Room's adversaries override actions, see adversary.p_max: leave it out"
        need(run.problem != "darkroom", "control.strength", run.control.strength, in_rooms)
    need(run.method != "experts" or run.problem != "darkroom", "method", run.method, room_or_game)
    if run.problem != "darkroom":
        train = run.control.train_tasks
        _validate_control(run, need)
    need(run.pretrain.contexts >= train, "pretrain.contexts", run.pretrain.contexts, f"at least one a task ({train})")
    need(0 <= icaa.context_trials < icaa.trials, "icaa.context_trials", icaa.context_trials, "must be below icaa.trials")
    need(len(run.pretrain.behaviors) > 0, "pretrain.behaviors", run.pretrain.behaviors, "name at least one")
    need(icaa.rounds >= 0, "icaa.rounds", icaa.rounds, "at least 0")
    need(
        0 <= run.pretrain.decoy_fraction <= 1, "pretrain.decoy_fraction", run.pretrain.decoy_fraction, "a share lies in [0, 1]"
    )
    need(0 <= dagger.new_fraction <= 1, "dagger.new_fraction", dagger.new_fraction, "a share lies in [0, 1]")
    need(0 <= optim.beta2 < 1, "optim.beta2", optim.beta2, "must lie in [0, 1)")
    need(0 <= icaa.new_fraction <= 1, "icaa.new_fraction", icaa.new_fraction, "a share lies in [0, 1]")
    need(run.model.heads > 0, "model.heads", run.model.heads, "must be above 0")
    need(run.model.window > 0, "model.window", run.model.window, "at least 1, which is none")
    for where, windows in (("pretrain.windows", run.pretrain.windows), ("optim.windows", optim.windows)):
        remedy = "above 0 exactly if model.window is above 1"
        need((windows > 0) == (run.model.window > 1), where, windows, remedy)
    horizon = room.horizon if run.problem == "darkroom" else sac.horizon(run.problem, run.control.horizon)
    need(run.model.window <= horizon, "model.window", run.model.window, f"at most the horizon, {horizon} steps")
    need(run.model.width % run.model.heads == 0, "model.heads", run.model.heads, "must divide model.width")
    need(run.context.max >= horizon, "context.max", run.context.max, "must hold at least one episode")
    need(0 <= run.model.dropout < 1, "model.dropout", run.model.dropout, "a probability below 1")
    need(run.learner.device in ("auto", "cpu", "cuda"), "learner.device", run.learner.device, "use auto, cpu or cuda")
    served = run.learner.prometheus
    host, _, port = served.rpartition(":")
    need(
        not served or bool(host and port.isascii() and port.isdigit() and 0 < int(port) < 65536),
        "learner.prometheus",
        served,
        "use HOST:PORT, such as 127.0.0.1:9464, or nothing",
    )
    for name, endpoint, remedy in endpoints.objections(run.stream.endpoint, run.stream.connect, run.stream.certificates):
        need(False, f"stream.{name}", endpoint, remedy)
    positive = {
        "pretrain.queries": run.pretrain.queries,
        "pretrain.steps": run.pretrain.steps,
        "dagger.trials": dagger.trials,
        "dagger.steps": dagger.steps,
        "dagger.learning_rate": dagger.learning_rate,
        "icaa.steps": icaa.steps,
        "model.layers": run.model.layers,
        "model.width": run.model.width,
        "optim.learning_rate": optim.learning_rate,
        "icaa.learning_rate": icaa.learning_rate,
        "optim.batch": optim.batch,
        "optim.queries": optim.queries,
        "optim.episodes": optim.episodes,
        "optim.clip": optim.clip,
        "evaluate.episodes": run.evaluate.episodes,
        "evaluate.seeds": run.evaluate.seeds,
        "stream.credits": run.stream.credits,
        "stream.job_tasks": run.stream.job_tasks,
        "stream.lease_s": run.stream.lease_s,
        "stream.reply_timeout_s": run.stream.reply_timeout_s,
        "stream.max_message_bytes": run.stream.max_message_bytes,
    }
    for where, value in positive.items():
        need(0 < value < math.inf, where, value, "must be above 0 and finite")
    not_negative = {
        "darkroom.split_seed": room.split_seed,
        "darkroom.label_slack": room.label_slack,
        "model.fourier": run.model.fourier,
        "dagger.rounds": dagger.rounds,
        "optim.transitions": optim.transitions,
        "optim.muon": optim.muon,
        "optim.weight_decay": optim.weight_decay,
        "optim.warmup": optim.warmup,
        "learner.threads": run.learner.threads,
        "learner.restarts": run.learner.restarts,
        "stream.staleness": run.stream.staleness,
        "learner.cache_mb": run.learner.cache_mb,
    }
    for where, value in not_negative.items():
        need(0 <= value < math.inf, where, value, "must not be negative, and be finite")


Need = Callable[[bool, str, object, str], None]


def _validate_control(run: Run, need: Need) -> None:
    """What a run of a continuous game may be."""
    control, count = run.control, run.control.train_tasks
    scripted = control.histories == "scripted"
    need(
        run.problem.startswith("metaworld") or not scripted,
        "control.histories",
        control.histories,
        "only Meta-World has a scripted policy",
    )
    need(run.method != "experts" or not scripted, "control.histories", control.histories, "experts are made for sac")
    if run.problem.startswith("dmc-"):
        need(count in (4, 16, 36), "control.train_tasks", count, "the centre of the grid has 4, 16 or 36 tasks")
        need(
            0 < control.test_tasks <= 64 - count, "control.test_tasks", control.test_tasks, f"the grid has {64 - count} others"
        )
    else:
        most = 50 - control.test_tasks
        need(0 < count <= most, "control.train_tasks", count, f"ML1 has 50 tasks: use 1 to {most}, or test fewer")
        need(control.test_tasks > 0, "control.test_tasks", control.test_tasks, "at least 1")
        need(control.horizon <= 500, "control.horizon", control.horizon, "Meta-World allows at most 500 steps")
        need(0 <= control.disturbance <= 0.1, "control.disturbance", control.disturbance, "0 to 0.1 metres")
    alone = count == 1 or count % run.stream.job_tasks == 1 or run.stream.job_tasks == 1
    need(
        not (run.pretrain.windows and run.pretrain.decoy_fraction and alone),
        "pretrain.decoy_fraction",
        run.pretrain.decoy_fraction,
        f"0, or a stream.job_tasks that leaves none of the {count} tasks alone in a job: another's expert misleads",
    )
    need(control.horizon >= 0, "control.horizon", control.horizon, "at least 0, which is the problem's own")
    if isinstance(control.strength, float):
        need(0 <= control.strength < math.inf, "control.strength", control.strength, "must not be negative, and be finite")
    elif run.problem.startswith("metaworld"):
        need(control.disturbance > 0, "control.disturbance", control.disturbance, "a drop needs a distance to multiply")
    need(run.dagger.rounds == 0, "dagger.rounds", run.dagger.rounds, "only Dark Room's labels can be had of new histories")
