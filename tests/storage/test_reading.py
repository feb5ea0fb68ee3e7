"""Trajectories of a run for analysis: canonical order, selections, and every step as a row."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from icrl_dist import ConfigError, read_dataset
from icrl_dist.storage import reading
from icrl_dist.storage.dataset import Dataset
from icrl_dist.storage.files import StoreError
from icrl_dist.stream import wire
from icrl_dist.types import Adversary, Identity
from tests.jobs import collected
from tests.stream import examples


def stored(folder, trajectories):
    """A run folder with these trajectories, the last ones first."""
    (folder / "run.toml").touch()
    store = Dataset(folder / "dataset", durable=False)
    store.append(trajectories[3:])
    store.seal()
    store.append(trajectories[:3])
    store.close()
    return folder


@pytest.fixture
def trajectories(small_run):
    return collected(small_run, 2)


@pytest.fixture
def data(trajectories, tmp_path):
    with read_dataset(stored(tmp_path, trajectories)) as found:
        yield found


def test_iteration_gives_every_trajectory_in_canonical_order(data, trajectories, monkeypatch):
    assert len(data) == len(trajectories) and list(data.identities()) == [t.identity for t in trajectories]
    assert [wire.trajectory_digest(t) for t in data] == [wire.trajectory_digest(t) for t in trajectories]
    read, real = [], data._store.read

    def recorded(identity):
        read.append(identity)
        return real(identity)

    monkeypatch.setattr(data._store, "read", recorded)
    next(iter(data))
    assert read == [trajectories[0].identity], "one at a time"


def test_a_selection_has_the_given_parts_of_the_identity(data, trajectories):
    key = trajectories[4].identity
    for parts in ({"task": key.task}, {"task": key.task, "variation": key.variation}, key._asdict(), {"stage": "adapt"}):
        wanted = [t.identity for t in trajectories if all(getattr(t.identity, name) == parts[name] for name in parts)]
        assert list(data.select(**parts).identities()) == wanted
    assert list(data.select(task=key.task).select(trial=key.trial).identities()) == list(
        data.select(task=key.task, trial=key.trial).identities()
    )
    with pytest.raises(ConfigError, match="stage 'adept': choose one of pretrain, adapt"):
        data.select(stage="adept")


def test_a_row_is_a_step(data, trajectories):
    frame = data.steps()
    assert len(frame) == sum(len(t.rewards) for t in trajectories)
    rows = frame.itertuples(index=False)
    names = list(frame.columns)
    for t in trajectories:
        for step in range(len(t.rewards)):
            row = dict(zip(names, next(rows), strict=True))
            assert Identity(*(row[name] for name in Identity._fields)) == t.identity and row["step"] == step
            assert (row["problem"], row["adversary"]) == (t.variation.task.kind, t.variation.adversary.kind)
            for name, owner in (("task", t.variation.task), ("adversary", t.variation.adversary)):
                for key, value in owner.params:
                    assert row[f"{name}.{key}"] == value
            for i in range(t.observations.shape[1]):
                assert row[f"observation.{i}"] == t.observations[step, i]
                assert row[f"next_observation.{i}"] == t.observations[step + 1, i]
            assert (row["action"], row["reward"], row["adversary_action"]) == (
                t.actions[step],
                t.rewards[step],
                t.adversary[step],
            )
            assert (row["policy_version"], row["weights_digest"], row["worker"]) == (
                t.policy_version,
                t.weights_digest,
                t.worker,
            )
            assert (row["origin"], row["queries"]) == (t.origin, len(t.queries))


def test_vectors_have_a_column_for_each_component_and_missing_parameters_are_null(tmp_path):
    first = examples.vectors(steps=4)
    force = Adversary.of("force", strength=2.0)
    second = dataclasses.replace(
        examples.vectors(steps=2),
        identity=first.identity._replace(trial=8),
        variation=dataclasses.replace(first.variation, adversary=force),
    )
    with read_dataset(stored(tmp_path, [first, second])) as data:
        frame = data.steps()
    assert list(frame["trial"]) == [7] * 4 + [8] * 2 and list(frame["step"]) == [0, 1, 2, 3, 0, 1]
    np.testing.assert_array_equal(
        frame[[f"action.{i}" for i in range(4)]].to_numpy(), np.vstack([first.actions, second.actions])
    )
    np.testing.assert_array_equal(frame["adversary_action.2"], [*first.adversary[:, 2], *second.adversary[:, 2]])
    assert list(frame["adversary.strength"].isna()) == [True] * 4 + [False] * 2
    assert frame["adversary.alpha"][0] == (0.5, 2.0) and "action" not in frame


def test_a_selection_without_trajectories_has_no_rows(data):
    frame = data.select(round=99).steps()
    assert len(frame) == 0 and {"stage", "step", "reward"} <= set(frame.columns)


def test_reading_changes_nothing_and_leaves_out_what_is_damaged(tmp_path, trajectories):
    folder = stored(tmp_path, trajectories)
    path = sorted((folder / "dataset").iterdir())[0]
    content = bytearray(path.read_bytes())
    content[-200] ^= 1
    path.write_bytes(content)
    before = {file: file.read_bytes() for file in folder.rglob("*") if file.is_file()}
    with read_dataset(folder) as data:
        assert len(list(data)) == len(trajectories) - 1
    assert {file: file.read_bytes() for file in folder.rglob("*") if file.is_file()} == before


def test_folders_without_a_readable_dataset_are_refused_in_one_line(tmp_path):
    with pytest.raises(ConfigError, match="none: no such run folder; `icrl-dist train demo` makes one"):
        read_dataset(tmp_path / "none")
    with pytest.raises(ConfigError, match="holds no run; name a run folder"):
        read_dataset(tmp_path)
    folder = stored(tmp_path, [examples.trajectory()])
    (folder / "dataset" / "segment-x.frames").write_bytes(b"x")
    with pytest.raises(StoreError, match="segment-x"):
        read_dataset(folder)


def test_the_page_has_every_column(tmp_path, trajectories):
    assert reading.document() in Path("docs/data.md").read_text(), "put the output of `reading.document()` into docs/data.md"
    patterns = [name.replace(".NAME", ".").replace(".I", ".") for name in reading.COLUMNS]

    def described(name):
        return next(
            i for i, pattern in enumerate(patterns) if name == pattern or (pattern[-1] == "." and name.startswith(pattern))
        )

    with read_dataset(stored(tmp_path, [trajectories[0], examples.trajectory()])) as data:
        order = [described(name) for name in data.steps()]
    assert order == sorted(order) and set(order) == set(range(len(patterns)))
