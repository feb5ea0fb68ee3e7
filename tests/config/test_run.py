"""Run files: what is written is read back, and every mistake is one line that names it."""

from __future__ import annotations

import dataclasses
import inspect
from importlib import resources
from pathlib import Path
from typing import Any

import pytest

from icrl_dist.config import run as config
from icrl_dist.config.run import ConfigError, Run, make_run, run_type
from icrl_dist.config.sections import StreamConfig
from icrl_dist.problems import registry
from icrl_dist.problems.dmc import domains
from icrl_dist.problems.metaworld import pick_place


def refusal(text: str) -> str:
    with pytest.raises(ConfigError) as caught:
        config.parse(text, "mine.toml")
    message = str(caught.value)
    assert message.startswith("mine.toml: ")
    assert "\n" not in message
    return message


def test_defaults_are_a_possible_run() -> None:
    assert config.parse("", "empty") == make_run()


def test_dumps_is_read_back(small_run: Run) -> None:
    changed = dataclasses.replace(
        small_run,
        stream=StreamConfig(endpoint="tls/[::1]:0", certificates='"quoted" \\ back\nslash\té'),
        optim=dataclasses.replace(small_run.optim, learning_rate=1e-05, clip=1e16),
        evaluate=dataclasses.replace(small_run.evaluate, p=(0.0, 0.125, 1.0)),
    )
    assert config.parse(config.dumps(changed), "again") == changed
    assert config.parse(config.dumps(make_run()), "again") == make_run()


def test_every_number_has_a_docstring() -> None:
    """A docstring stands under each field, for ``--help`` and the docs."""
    sections: list[Any] = [
        item.default_factory for item in dataclasses.fields(run_type(None)) if dataclasses.is_dataclass(item.default_factory)
    ]
    assert {"AdversaryConfig", "SACConfig", "AlertsConfig", "DarkRoomConfig", "ControlConfig"} <= {s.__name__ for s in sections}
    for section in (Run, *sections):
        for item in dataclasses.fields(section):
            owner = next(one for one in section.__mro__ if item.name in inspect.get_annotations(one))
            source = inspect.getsource(owner).splitlines()
            line = next(i for i, text in enumerate(source) if text.startswith(f"    {item.name}: "))
            assert section is Run or source[line + 1].startswith('    """'), f"{section.__name__}.{item.name} has no docstring"


def test_values_are_read_into_their_fields() -> None:
    run = config.parse('seed = 3\nmethod = "dpt"\n[darkroom]\nsize = 4\ngamma = 1\n[evaluate]\np = [0, 0.5]', "mine")
    room = run.section("darkroom")
    assert (run.seed, run.method, room.size, run.evaluate.p) == (3, "dpt", 4, (0.0, 0.5))
    assert isinstance(room.gamma, float), "a whole number is read as a float where one is expected"
    assert isinstance(run.evaluate.p[0], float)
    assert room.horizon == make_run().section("darkroom").horizon


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        # Unknown keys, with the nearest known one.
        ("sead = 1", ["unknown key sead", "did you mean 'seed'?"]),
        ("[darkrom]\nsize = 3", ["unknown key darkrom", "did you mean 'darkroom'?"]),
        ("[darkroom]\nhorison = 3", ["unknown key darkroom.horison", "did you mean 'horizon'?", "split_seed"]),
        ("[darkroom.walls]\nx = 1", ["unknown key darkroom.walls"]),
        # Wrong types.
        ('[darkroom]\nsize = "ten"', ["darkroom.size = 'ten'", "expected int, got str"]),
        ("[darkroom]\nsize = 3.0", ["darkroom.size = 3.0", "expected int, got float"]),
        ("[darkroom]\nsize = true", ["darkroom.size = True", "expected int, got bool"]),
        ("[darkroom]\ngamma = true", ["darkroom.gamma = True", "expected float, got bool"]),
        ("seed = [1]", ["seed = [1]", "expected int, got list"]),
        ("[stream]\nendpoint = 7447", ["stream.endpoint = 7447", "expected str, got int"]),
        ("darkroom = 3", ["darkroom = 3", "expected a table [darkroom]"]),
        ("[evaluate]\np = 0.2", ["evaluate.p = 0.2", "expected a list"]),
        ('[evaluate]\np = [0.2, "x"]', ["evaluate.p = 'x'", "expected float, got str"]),
        # Bad choices.
        (
            'method = "ppo"',
            ["method = 'ppo'", "choose one of ad, ardt, dpt, dr, experts, ic2rl, icaa, icag, mix_dpt, prompt_dt, qarl, rarl"],
        ),
        ("method = 3", ["method = 3", "expected str, got int"]),
        ('[darkroom]\nlabels = "hard"', ["darkroom.labels = 'hard'", "'soft', 'sampled', 'heuristic'"]),
        ('[learner]\ndevice = "tpu"', ["learner.device = 'tpu'", "choose one of 'auto', 'cpu', 'cuda'"]),
        # Well typed, but impossible.
        ("[darkroom]\nsize = 1", ["darkroom.size = 1", "2 to 1000"]),
        ("[darkroom]\nhorizon = 0", ["darkroom.horizon = 0", "1 to 1000000"]),
        ("[darkroom]\ntrain_fraction = 1.0", ["darkroom.train_fraction = 1.0", "between 0 and 1"]),
        ("[darkroom]\nsize = 2\ntrain_fraction = 0.95", ["darkroom.train_fraction = 0.95", "one goal to train on"]),
        ("[darkroom]\ngamma = 1.1", ["darkroom.gamma = 1.1", "(0, 1]"]),
        ("[darkroom]\ngamma = nan", ["darkroom.gamma = nan"]),
        ("[darkroom]\nlabel_slack = -0.1", ["darkroom.label_slack = -0.1"]),
        ("[darkroom]\nsplit_seed = -1", ["darkroom.split_seed = -1"]),
        ("[adversary]\np_max = 1.5", ["adversary.p_max = 1.5", "[0, 1]"]),
        ("[adversary]\np_min = 0.3", ["adversary.p_min = 0.3", "use 0 to adversary.p_max, which is 0.2"]),
        ("[adversary]\ncount = 0\nnull = false", ["adversary.count = 0", "at least 1, or adversary.null = true"]),
        ("[adversary]\ncount = -1", ["adversary.count = -1", "0 or more disturbances"]),
        ("seed = -1", ["seed = -1", "a seed is a whole number from 0"]),
        ("[evaluate]\np = [0.1, 2.0]", ["evaluate.p = 2.0", "[0, 1]"]),
        ("[evaluate]\np = []", ["evaluate.p = ()", "at least one"]),
        ("[pretrain]\ncontexts = 79", ["pretrain.contexts = 79", "use at least 80"]),
        ("[icaa]\ntrials = 5\ncontext_trials = 5", ["icaa.context_trials = 5", "below icaa.trials"]),
        ("[icaa]\nrounds = -1", ["icaa.rounds = -1", "must be from 0 to 9000"]),
        ("[icaa]\nnew_fraction = -0.5", ["icaa.new_fraction = -0.5", "[0, 1]"]),
        ("[model]\nheads = 3", ["model.heads = 3", "must divide model.width"]),
        ("[model]\nheads = 0", ["model.heads = 0"]),
        ("[model]\nwidth = 0", ["model.width = 0", "above 0"]),
        ("[model]\nfourier = -1", ["model.fourier = -1"]),
        ("[model]\nwindow = 0", ["model.window = 0", "at least 1"]),
        ("[model]\nwindow = 4", ["pretrain.windows = 0", "model.window"]),
        ("[optim]\nwindows = 2", ["optim.windows = 2", "model.window"]),
        ("[model]\nwindow = 101\n[pretrain]\nwindows = 1\n[optim]\nwindows = 1", ["model.window = 101", "horizon"]),
        ("[pretrain]\ndecoy_fraction = 1.5", ["pretrain.decoy_fraction = 1.5", "[0, 1]"]),
        ("[model]\ndropout = 1.0", ["model.dropout = 1.0", "below 1"]),
        ("[optim]\nlearning_rate = 0", ["optim.learning_rate = 0.0", "above 0"]),
        ("[optim]\nlearning_rate = nan", ["optim.learning_rate = nan", "must be finite"]),
        ("[optim]\nlearning_rate = inf", ["optim.learning_rate = inf"]),
        ("[optim]\nweight_decay = -1e-4", ["optim.weight_decay = -0.0001"]),
        ("[optim]\nwarmup = -1", ["optim.warmup = -1"]),
        ("[optim]\nbatch = 0", ["optim.batch = 0", "above 0"]),
        ("[context]\nmax = 99", ["context.max = 99", "at least one episode"]),
        ("[stream]\ncredits = 0", ["stream.credits = 0", "above 0"]),
        ("[learner]\nthreads = -1", ["learner.threads = -1"]),
        ("[learner]\nrestarts = -1", ["learner.restarts = -1"]),
        # Continuous problems.
        ('problem = "dmc-cheeta-run"', ["problem = 'dmc-cheeta-run'", "did you mean 'dmc-cheetah-run'"]),
        ('problem = "dmc-hopper-hop"\n[control]\ntrain_tasks = 9', ["control.train_tasks = 9", "4, 16 or 36"]),
        ('problem = "dmc-hopper-hop"\n[control]\ntest_tasks = 49', ["control.test_tasks = 49", "use 1 to 48"]),
        ('problem = "dmc-hopper-hop"\n[dagger]\nrounds = 1', ["dagger.rounds = 1", "only a problem with exact answers"]),
        ('problem = "dmc-hopper-hop"\n[context]\nmax = 150', ["context.max = 150", "at least one episode (200 steps)"]),
        ('problem = "metaworld-pick-place"\n[control]\ntrain_tasks = 46', ["control.train_tasks = 46", "1 to 45"]),
        ('problem = "metaworld-pick-place"\n[control]\nhorizon = 501', ["control.horizon = 501", "500"]),
        ('problem = "metaworld-pick-place"\n[control]\ndisturbance = 1', ["control.disturbance = 1.0", "0.1 meters"]),
        ('problem = "dmc-hopper-hop"\n[control]\nforces = "strong"', ["control.forces = 'strong'", "'paper', 'qarl'"]),
        ("[sac]\nsteps = 0", ["sac.steps = 0", "above 0"]),
        ("[sac]\nhidden = []", ["sac.hidden = ()", "at least one layer"]),
        ("[sac]\nhiden = [64]", ["sac.hiden", "did you mean 'hidden'"]),
        ("[sac]\ngamma = 1.0", ["sac.gamma = 1.0"]),
        # Broken TOML.
        ("[darkroom\nsize = 3", ["not valid TOML", "line 1"]),
        ("seed = 1\nseed = 2\n", ["not valid TOML", "Cannot overwrite a value"]),
    ],
)
def test_a_mistake_is_one_line_naming_source_key_and_value(text: str, parts: list[str]) -> None:
    message = refusal(text)
    for part in parts:
        assert part in message


@pytest.mark.parametrize(
    "section",
    [
        *("pretrain.queries", "pretrain.steps", "icaa.steps", "model.layers", "optim.queries", "optim.episodes", "optim.clip"),
        *("evaluate.episodes", "evaluate.seeds", "stream.lease_s", "stream.reply_timeout_s", "stream.max_message_bytes"),
    ],
)
def test_what_must_be_positive(section: str) -> None:
    table, key = section.split(".")
    assert f"{section} = 0" in refusal(f"[{table}]\n{key} = 0")


def test_edges_are_allowed() -> None:
    config.parse("[model]\nwidth = 9\nheads = 3", "mine")
    config.parse("[darkroom]\ngamma = 1.0\nlabel_slack = 0\n[adversary]\np_max = 1.0\ncount = 0", "mine")
    config.parse("[icaa]\nrounds = 0\ntrials = 1\ncontext_trials = 0\nnew_fraction = 1\n[context]\nmax = 100", "mine")
    config.parse("[optim]\nwarmup = 0\nweight_decay = 0\n[learner]\nrestarts = 0", "mine")


def test_load_by_path(tmp_path: Path, small_run: Run) -> None:
    file = tmp_path / "mine.toml"
    file.write_text(config.dumps(small_run))
    assert config.load(str(file)) == small_run
    file.write_text("[darkroom]\nsize = 0")
    with pytest.raises(ConfigError, match=r"mine\.toml: darkroom\.size = 0"):
        config.load(str(file))
    file.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match=r"mine\.toml"):
        config.load(str(file))


@pytest.mark.parametrize("name", ["nowhere.toml", "no/where", "./."])
def test_load_of_a_missing_file(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match=f"run file '{name}': no such file"):
        config.load(name)


PACKAGED = config.packaged_runs()


@pytest.mark.parametrize("name", PACKAGED)
def test_an_unknown_packaged_run_names_the_nearest(name: str) -> None:
    with pytest.raises(ConfigError) as caught:
        config.load(name + "x")
    message = str(caught.value)
    assert message.startswith(f"run '{name}x': no packaged run of that name; did you mean '{name}'")
    assert all(known in message for known in PACKAGED)
    assert "\n" not in message


def test_there_are_packaged_runs() -> None:
    """A file each, but for the 11 problems of DeepMind Control, which share two."""
    files = {f.name.removesuffix(".toml") for f in resources.files("icrl_dist.config.runs").iterdir() if ".toml" in f.name}
    problems = {name for name in PACKAGED if name.startswith("dmc-")}
    assert set(PACKAGED) - problems == files - {"dmc", "dmc-laptop"} and "demo" in files and len(problems) == 22


def test_every_installed_problem_has_a_packaged_run() -> None:
    assert set(registry.names()) == {"darkroom", pick_place.KIND, *domains.PROBLEMS}
    assert {config.load(name).problem for name in PACKAGED} == set(registry.names())
    assert config.load("dmc-walker-run-laptop").problem == "dmc-walker-run"
    with pytest.raises(ConfigError, match="no packaged run of that name"):
        config.load("dmc")


@pytest.mark.parametrize("name", PACKAGED)
def test_every_packaged_run_is_possible(name: str) -> None:
    run = config.load(name)
    assert config.parse(config.dumps(run), name) == run
