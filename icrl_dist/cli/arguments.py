"""What each command of the command line is given; the docstrings are its ``--help``."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from icrl_dist.config.run import Deployment, Run


@dataclass(frozen=True)
class Train:
    """Run a method from its first trajectory to its evaluation on held-out tasks.

    RUN is a packaged run (demo, smoke, darkroom) or the path of a TOML file.  Every number of
    the run can be overridden: ``icrl-dist train demo --method icag --adversary.count 4``.
    ``icrl-dist train --from runs/demo@0 --set adversary.count=16`` goes on from T^0 of another
    run, with its data and other numbers.
    """

    run: tyro.conf.Positional[str] = ""
    """Name of a packaged run, or path of a run file; with --from the other run's numbers are
    taken if it is left out."""
    source: Annotated[str | None, tyro.conf.arg(name="from")] = None
    """RUN_DIR@ROUND: begin with T^ROUND of another run and the data it was fitted to; both are
    shared, not copied."""
    set: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """SECTION.NAME=VALUE, as in adversary.count=16; may be given many times."""
    engine: Literal["ray", "inline"] = "ray"
    """``ray``: a learner process and Ray workers; ``inline``: all in this process, same results."""
    address: str | None = None
    """Address of a Ray cluster to take workers from; without it Ray starts here."""
    actors: int | None = None
    """Workers: 2 on this machine; on a cluster as many as its machines have cores, and more when more join."""
    min_actors: int | None = None
    """On a cluster: begin with so many after a minute, though other machines have not joined."""
    oversubscribe: bool = False
    """Allow more workers than cores: slower, and the same results."""
    out: Path | None = None
    """Run folder, ``~`` included where no shell has resolved it; runs/RUN if not given."""
    resume: bool = False
    """Go on with the run in the folder from its last checkpoint."""
    overwrite: bool = False
    """Replace the run in the folder: it is removed once the new one has its first checkpoint, and comes
    back if the new one ends before that."""
    json: bool = False
    """Print the result as one JSON object on the last line."""
    given: tyro.conf.Suppress[tuple[str, ...]] = ()
    """The words of the command."""
    config: Annotated[Run, tyro.conf.arg(name="")] = field(default_factory=Run)


@dataclass(frozen=True)
class Evaluate:
    """Deploy a trained agent on tasks it never trained on, beside T^0, exact agents and the oracle."""

    what: tyro.conf.Positional[Path | None] = None
    """A run folder, or a checkpoint file."""
    pretrained: str | None = None
    """Instead, the name of an agent that comes with the package: ``darkroom``.  Its report is
    written under runs/NAME-pretrained."""
    suite: Literal["online", "offline", "posterior"] = "online"
    """``online``: episode after episode from an empty context; ``offline``: one episode given a
    random or an expert one (Algorithm 1); ``posterior``: how far its decisions are from the exact
    posterior's, in nats, and its return from the exact agent's."""
    deploy: Deployment | None = None
    """``paper``: Algorithm 1, the context frozen within an episode; ``committed``: every transition
    joins the context at once, and a guess once acted on is kept.  Committed if not given, for an
    agent that was trained on windows (model.window); the posterior suite is about ``paper``."""
    episodes: int | None = None
    """Online episodes; the run's own number if not given (posterior: 40)."""
    seeds: int | None = None
    """Evaluations of every task; the run's own number if not given (posterior: 2)."""
    p: tuple[float, ...] = ()
    """Override probabilities to test; the run's own if none are given (posterior: 0 0.2 0.4 0.6)."""
    prior: Literal["uniform", "unseen"] | None = None
    """Law of the test adversary; the run's own if not given (posterior: uniform)."""
    json: bool = False
    """Print one JSON object on the last line."""


@dataclass(frozen=True)
class Tap:
    """Print one JSON line a trajectory, live, from the monitor plane of a run that is on.

    ``icrl-dist tap --task 3 --adversary dirichlet --every 10`` prints every tenth of those that
    pass both filters.

    Nothing that a tap does can slow the run: what it cannot take in time is dropped.
    """

    what: tyro.conf.Positional[Path | None] = None
    """Run folder to listen to; the newest under runs/ if neither this nor --connect is given."""
    connect: str | None = None
    """Endpoint of a learner, such as tcp/127.0.0.1:7447."""
    certificates: str | None = None
    """Folder with ca.pem, monitor.pem and monitor.key, for a learner at tls/; the run's own if
    not given."""
    task: tuple[int, ...] = ()
    """Only these tasks, by their numbers."""
    adversary: tuple[str, ...] = ()
    """Only these adversaries: numbers of variations, or kinds such as ``dirichlet`` or ``null``."""
    every: int = 1
    """Of those that pass, only every so manyth."""
    format: Literal["json", "msgpack"] = "json"
    """``json``: a line each; ``msgpack``: the same maps one after another, as a msgpack stream."""
    count: int = 0
    """End after so many trajectories; 0 goes on until Ctrl-C."""
    timeout: float = 30.0
    """Seconds to wait for the learner."""


@dataclass(frozen=True)
class Monitor:
    """Watch a run live, in the terminal or in a browser; or play one again that has ended.

    Without WHAT: the newest run under runs/ that is on.  A view reads the monitor plane only, so
    it can slow nobody down.  ``icrl-dist monitor runs/demo`` plays the run in that folder again
    once it has ended, at any speed.
    """

    what: tyro.conf.Positional[Path | None] = None
    """Run folder: watched if the run is on, played again if it has ended or crashed."""
    connect: str | None = None
    """Instead, the endpoint of a learner, such as tcp/127.0.0.1:7447."""
    certificates: str | None = None
    """Folder with ca.pem, monitor.pem and monitor.key, for a learner at tls/; the run's own if
    not given."""
    web: int | None = None
    """Serve a page at this port instead; 0 takes a free one."""
    host: str = "127.0.0.1"
    """Where the page is served: only to this machine unless you change it."""
    speed: float = 10.0
    """Seconds of then a second, of a run that is played again; the views can change it."""
    timeout: float = 30.0
    """Seconds to wait for the learner."""


@dataclass(frozen=True)
class Bench:
    """Measure one part of the system on this machine, beside what it is compared with."""

    name: tyro.conf.Positional[
        Literal[
            "env",
            "stream",
            "ingest",
            "scale",
            "broadcast",
            "recovery",
            "soak",
            "fuzz",
            "incontext",
            "experts",
            "disturbance",
            "monitor",
        ]
    ]
    """``env``: environment steps a second, of simulated problems beside their library's own loop;
    ``stream``: trajectories a second through the stream and, in the same run, as Ray actor returns;
    ``ingest``: trajectories a second onto the disk, with and without fsync; ``scale``: the same from
    1 to 256 simulated workers; ``broadcast``: weights
    to eight processes, beside ``ray.put`` and ``get``; ``recovery``: how soon a run is at work again
    after a worker or the learner was killed; ``soak``: does any process of a long run grow;
    ``fuzz``: 100,000 hostile inputs to every reader of bytes; ``incontext``: deployment and
    training of the model, beside DPT's official layout; ``experts``: updates of experts in
    lockstep, beside stable-baselines3; ``disturbance``: the return that an undisturbed expert loses
    under each default adversary; ``monitor``: what it costs a run to be watched, and a view to watch a
    thousand streams."""
    problem: str | None = None
    """Which environment: one such as ``dmc-cheetah-run`` (env: ``darkroom`` if not given;
    disturbance: every simulated one)."""
    seconds: float | None = None
    """How long to measure (env, stream, ingest, scale and soak)."""
    quick: bool = False
    """One seed instead of three (incontext), 3 turns instead of 15 (experts), experts that have learned
    little and 3 episodes instead of 10 (disturbance), 2 pairs of short windows instead of 8 (monitor)."""
    drop: float | None = None
    """disturbance: instead, the strength at which that share of the return is lost, as in 0.25; solved once
    a problem and kept for ``control.strength`` of later runs, as ``drop:0.25``."""
    steps: int | None = None
    """Steps of the experts' training (disturbance --drop), or those of it with updates (experts --device cuda)."""
    device: Literal["cpu", "cuda", "auto"] = "cpu"
    """experts: ``cuda`` measures 160 experts on a GPU beside stable-baselines3 on one core, and trains an
    expert set of the paper for a while to tell how long it takes; ``auto``: on a GPU if there is one."""
    folder: Path = Path("runs")
    """Whose disk to write to (ingest, scale, recovery), where to put the figure (soak, incontext) or an
    input that breaks something (fuzz), where to keep finished trainings (incontext)."""
    json: bool = False
    """Print one JSON object on the last line."""


@dataclass(frozen=True)
class Explain:
    """Where a training example came from: task, adversary, weights, seed, worker, labels, bytes.

    Without IDENTITY: the whole ledger, a JSON line a trajectory.
    """

    what: tyro.conf.Positional[Path]
    """Run folder."""
    identity: tyro.conf.Positional[str | None] = None
    """STAGE/ROUND/TASK/VARIATION/TRIAL, such as adapt/0/3/1/7."""
    rerun: bool = False
    """Make it once more on this machine and compare every byte."""
    json: bool = False
    """Print one JSON object on the last line."""


@dataclass(frozen=True)
class Export:
    """Write what a run made in a form for others to use."""

    what: tyro.conf.Positional[Path]
    """A run folder (its newest version), or a checkpoint file."""
    to: Literal["agent"] = "agent"
    """``agent``: weights and manifest in one file for ``load_agent``, without what only training
    needs."""
    out: Path | None = None
    """File to write; agent.npz in the run folder, or beside the checkpoint, if not given."""


@dataclass(frozen=True)
class Chaos:
    """Disturb a small job on a seeded schedule: every digest must equal the undisturbed run's.

    RUN is run once undisturbed, then once for each fault: kill-worker, kill-learner and
    kill-tree (SIGKILL), stop-learner (SIGSTOP for 15 s), cut-link (12 s of silence), torn-tail
    and flip-byte (a damaged dataset), full-disk (needs root, or user namespaces).  A fault that
    did not land, for nothing died, was sent again or was repaired, fails the command as another
    digest does.  ``icrl-dist chaos smoke`` takes some minutes on two cores.
    """

    run: tyro.conf.Positional[str] = "smoke"
    """Name of a packaged run, or path of a run file."""
    set: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """SECTION.NAME=VALUE, as in icaa.trials=60; may be given many times."""
    seeds: int = 1
    """Schedules to run: each strikes elsewhere."""
    seed: int = 0
    """The first schedule's seed."""
    faults: str = ""
    """Some of the faults, such as kill-worker,torn-tail; all if not given."""
    actors: int = 2
    """Workers."""
    out: Path = Path("runs/chaos")
    """Where run folders and logs are made; those of faults that changed nothing are removed."""
    reference: Path | None = None
    """Folder of a finished run with the same numbers, to compare with instead of running it."""
    json: bool = False
    """Print one JSON object on the last line."""


@dataclass(frozen=True)
class Play:
    """Be the adversary of a trained agent in a Dark Room, live in the browser.

    Move the goal, override actions by hand or by a law, and watch it adapt: its returns beside the
    oracle's, its surprise, and what it believes of the goal beside the exact posterior.
    """

    what: tyro.conf.Positional[Path | None] = None
    """A run folder, or a checkpoint file."""
    pretrained: str | None = None
    """Instead, the name of an agent that comes with the package: ``darkroom``."""
    web: int = 8000
    """Port of the page; 0 takes a free one."""
    host: str = "127.0.0.1"
    """Address to listen on.  Whoever reaches another than this machine's own may play."""
    deploy: Deployment | None = None
    """As for ``evaluate``."""
    seed: int = 0
    """Of the agent's and the adversary's draws."""
    paused: bool = False
    """Begin paused, so that the same clicks give the same game."""


@dataclass(frozen=True)
class Doctor:
    """Check this machine: versions, cores, memory, ports, folders; one line and a remedy each.

    Or, with --cluster, a cluster file before `ray up`, without asking any machine or cloud; run it
    where `ray up` will be run.  Or, with --address on its head, a cluster that is up: every
    machine's versions, clock, shared memory, certificates, and the ports between them.
    """

    cluster: Path | None = None
    """Cluster file to look through, such as deploy/clusters/aws.yaml."""
    address: str | None = None
    """Address of a Ray cluster, such as ``auto``."""
    certificates: str = ""
    """With --address: the folder of certificates on its machines."""
    endpoint: str = "tcp/127.0.0.1:0"
    """Where a learner would listen."""
    folder: Path = Path("runs")
    """Where run folders would be made."""


@dataclass(frozen=True)
class Plan:
    """What a run would take on N machines: hours, network, disk, and what holds it up first.

    Times a little of each part of the run on this machine, some tens of seconds while nothing else
    should run; machines are taken to be like this one.
    """

    run: tyro.conf.Positional[str]
    """Name of a packaged run, or path of a run file."""
    nodes: int = 1
    """Machines that run workers."""
    cores: int | None = None
    """Workers on each; as many as this machine has cores if not given."""
    gbit: float = 1.0
    """What the learner's network carries, Gbit/s."""
    set: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """SECTION.NAME=VALUE, as in adversary.count=16; may be given many times."""
    rates: Path | None = None
    """Rates that were measured before, or on another machine: what --json printed there."""
    json: bool = False
    """Print one JSON object on the last line, the rates included."""
