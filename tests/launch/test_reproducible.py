"""``learner.reproducible``: what auto means, what is refused, what a resume keeps, and what is said about other machines."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from icrl_dist.config.resuming import differences
from icrl_dist.config.run import ConfigError, Run, dumps, parse_written
from icrl_dist.config.sections import Reproducible
from icrl_dist.launch import auto, train
from icrl_dist.models import kernel
from icrl_dist.models.compiled import Unusable, kinds
from icrl_dist.storage import held
from icrl_dist.storage.checkpoint import load_checkpoint, version_file
from icrl_dist.telemetry import provenance
from icrl_dist.training import reproducible
from learner import fitting
from tests.toys.return_to_go import ReturnToGo

pytestmark = [
    pytest.mark.unit,
    pytest.mark.skipif(not kinds("training"), reason="the training kernel was not built"),
]


def asked(run: Run, value: Reproducible, **sections: dict[str, Any]) -> Run:
    """The run with ``learner.reproducible = value`` and other settings, by section."""
    changed = {name: replace(getattr(run, name), **settings) for name, settings in sections.items()}
    run = replace(run, **changed)
    return replace(run, learner=replace(run.learner, reproducible=value))


def test_auto_is_any_machine_where_that_is_possible(small_run: Run, tmp_path: Path) -> None:
    found = auto.without_auto(small_run, tmp_path, resume=False)
    assert (found.learner.reproducible, found.context.decoder) == ("any-machine", "kernel")


@pytest.mark.parametrize(
    ("sections", "words"),
    [
        ({"model": {"width": 144}}, ["model.width = 144", "at most 128"]),
        ({"model": {"dropout": 0.1}}, ["model.dropout = 0.1", "use 0"]),
        ({"context": {"decoder": "torch"}}, ["context.decoder = 'torch'", "set context.decoder = 'kernel'"]),
        ({"learner": {"device": "cuda"}}, ["learner.device = 'cuda'", "set learner.device = 'auto' or 'cpu'"]),
    ],
)
def test_what_the_kernel_cannot_fit_is_refused_and_fitted_by_torch_with_auto(
    small_run: Run, tmp_path: Path, sections: dict[str, dict[str, Any]], words: list[str]
) -> None:
    refused(asked(small_run, "any-machine", **sections), tmp_path, words)
    found = auto.without_auto(asked(small_run, "auto", **sections), tmp_path, resume=False)
    assert found.learner.reproducible == "this-machine"


def refused(run: Run, folder: Path, words: list[str]) -> None:
    with pytest.raises(ConfigError) as caught:
        auto.without_auto(run, folder, resume=False)
    text = str(caught.value)
    assert "\n" not in text and all(word in text for word in (*words, "learner.reproducible = 'any-machine'", "'this-machine'"))


def test_a_gpu_a_missing_kernel_and_another_loss_are_refused(
    small_run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, install: Any
) -> None:
    run = asked(small_run, "any-machine")
    with monkeypatch.context() as patch:
        patch.setattr(reproducible, "_GPU_FILES", (str(tmp_path),))
        patch.setattr(torch.cuda, "is_available", lambda: True)
        refused(asked(run, "any-machine", learner={"device": "cuda"}), tmp_path, ["learner.device = 'cuda'", "'auto' or 'cpu'"])
        cases: list[tuple[str, Reproducible, Reproducible]] = [
            ("auto", "auto", "this-machine"),
            ("cpu", "auto", "any-machine"),
            ("auto", "any-machine", "any-machine"),
        ]
        for device, wanted, found in cases:
            there = auto.without_auto(asked(run, wanted, learner={"device": device}), tmp_path, resume=False).learner
            assert there.reproducible == found
            assert fitting.device_of(there).type == ("cuda" if found == "this-machine" else "cpu")
    with monkeypatch.context() as patch:
        patch.setattr(reproducible, "library", lambda name: Unusable("not compiled", "install a C compiler"))
        refused(run, tmp_path, ["cannot be used: not compiled: install a C compiler"])
    install(methods={"return-to-go": ReturnToGo})
    refused(replace(run, method="return-to-go"), tmp_path, ["method = 'return-to-go'", "use dpt, icag or icaa"])


def test_a_run_keeps_what_it_began_with(small_run: Run, tmp_path: Path) -> None:
    begun = asked(small_run, "this-machine", context={"decoder": "kernel"})
    folder = tmp_path / "run"
    train.prepare(begun, folder, resume=False, overwrite=False)
    again = auto.without_auto(small_run, folder, resume=True)
    assert again == begun
    assert not differences(begun, small_run), "auto is what the run began with"
    assert [d.name for d in differences(begun, asked(begun, "any-machine"))] == ["learner.reproducible"]
    assert held.differences(begun, asked(begun, "any-machine")), "a checkpoint of the other way to fit is another run's"


@pytest.mark.parametrize(
    ("there", "section", "change"),
    [
        ("any-machine", "context", {"decoder": "torch"}),
        ("any-machine", "model", {"dropout": 0.1}),
        ("this-machine", "learner", {"reproducible": "any-machine", "threads": 7}),
    ],
)
def test_a_resume_with_other_settings_names_them(
    small_run: Run, tmp_path: Path, there: Reproducible, section: str, change: dict[str, Any]
) -> None:
    """It gives no remedy of the kernel that another resume would refuse."""
    folder = tmp_path / "run"
    train.prepare(asked(small_run, there, context={"decoder": "kernel"}), folder, resume=False, overwrite=False)
    changed = asked(small_run, "auto") if section != "learner" else small_run
    changed = replace(changed, **{section: replace(getattr(changed, section), **change)})
    named = auto.without_auto(changed, folder, resume=True)
    with pytest.raises(ConfigError, match=rf"has other settings.*{section}\.{next(iter(change))}"):
        train.prepare(named, folder, resume=True, overwrite=False)


def test_a_refused_run_is_not_announced(small_run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    missing = Unusable("not compiled", "install a C compiler")
    monkeypatch.setattr(kernel, "kinds", lambda: ())
    monkeypatch.setattr(kernel, "library", lambda name: missing)
    monkeypatch.setattr(reproducible, "library", lambda name: missing)
    notes: list[str] = []
    with pytest.raises(ConfigError, match="training kernel cannot be used"):
        auto.without_auto(asked(small_run, "any-machine"), tmp_path, False, notes.append)
    assert not notes, "a note that the run uses torch contradicts the refusal"
    auto.without_auto(small_run, tmp_path, False, notes.append)
    assert len(notes) == 1 and "equal only on machines of one kind" in notes[0]


def test_runs_of_versions_without_the_key_were_fitted_by_torch(small_run: Run) -> None:
    text = "\n".join(line for line in dumps(small_run).splitlines() if not line.startswith("reproducible"))
    assert parse_written(text, "run.toml").learner.reproducible == "this-machine"


def test_threads_are_free_only_where_digests_do_not_depend_on_them(small_run: Run) -> None:
    cases: list[tuple[Reproducible, list[str]]] = [("any-machine", []), ("this-machine", ["learner.threads"])]
    for value, fixed in cases:
        run = asked(small_run, value)
        other = asked(run, value, learner={"threads": 2})
        assert [d.name for d in differences(run, other)] == fixed


def test_another_processor_is_reported_only_where_it_matters() -> None:
    def record(problem: str, value: Any) -> dict[str, Any]:
        return provenance.record(problem, "dpt", 1, reproducible=value)

    other = {"processor": "another", "instruction_set": "DEFAULT", "threads": 9}
    free, fixed, simulated = (
        record("darkroom", "any-machine"),
        record("darkroom", "this-machine"),
        record("dmc-cartpole-balance", "any-machine"),
    )
    assert not provenance.differences(free, free | other)
    assert "another" in provenance.differences(fixed, fixed | other)
    assert "another" in provenance.differences(simulated, simulated | other), "a simulator may depend on the processor"
    assert "code" in provenance.differences(free, free | other | {"code_digest": "0" * 64})


@pytest.mark.parametrize("muon", [0.0, 3.0])
def test_an_interrupted_fit_ends_with_the_same_weights_on_another_number_of_threads(
    small_run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, muon: float
) -> None:
    run = asked(small_run, "any-machine", context={"decoder": "kernel"}, optim={"muon": muon})
    run = replace(run, method="dpt")
    monkeypatch.setattr(fitting, "SAVE_STEPS", 4)

    class Killed(Exception):  # noqa: N818
        pass

    def kill(event: dict[str, Any]) -> None:
        if event.get("stage") == "fit" and event["step"] == run.pretrain.steps:
            raise Killed

    train.prepare(run, tmp_path / "whole", resume=False, overwrite=False)
    whole = train.train_inline(run, tmp_path / "whole", lambda event: None)
    train.prepare(run, tmp_path / "cut", resume=False, overwrite=False)
    with pytest.raises(Killed):
        train.train_inline(run, tmp_path / "cut", kill)
    resumed = replace(run, learner=replace(run.learner, threads=3))
    train.prepare(resumed, tmp_path / "cut", resume=True, overwrite=False)
    cut = train.train_inline(resumed, tmp_path / "cut", lambda event: None)
    assert (cut["weights_digest"], cut["dataset_digest"]) == (whole["weights_digest"], whole["dataset_digest"])
    assert load_checkpoint(version_file(tmp_path / "cut", 0)).manifest["made_by"]["any_machine"]
