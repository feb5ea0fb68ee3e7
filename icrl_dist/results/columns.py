"""The columns of the result rows, which docs/data.md documents with the text of ``document``."""

from __future__ import annotations

from typing import Any, NamedTuple

FORMAT = 2
"""Number of the file format.  It changes whenever a column is added, removed, or gets another meaning."""
FORMER = 1
"""The former format, which is read too: without the columns ``ADDED``, and with one test adversary for each task."""


class Column(NamedTuple):
    """A column of the result rows."""

    type: str
    """Type of pyarrow: ``string``, ``int64``, ``double`` or ``bool``."""
    meaning: str
    nullable: bool = False


_RETURN = (
    "undiscounted return; up to the step at which the simulation diverged, if it did; in suite `attack` the exact "
    "expectation, if the agent's policy is fixed within an episode"
)
COLUMNS: dict[str, Column] = {
    "format": Column("int64", "number of the file format; this page describes format 2"),
    "evaluation": Column("string", "name of the file without its suffix: which evaluation wrote the row"),
    "written": Column("string", "when, in UTC"),
    "package_version": Column("string", "version of icrl-dist"),
    "code_digest": Column("string", "SHA-256 of the code of icrl-dist"),
    "commit": Column("string", "Git commit of that code, with `-dirty` if it was changed; empty outside a Git checkout"),
    "libraries": Column(
        "string",
        "versions of Python and of libraries, JSON; also the package of the problem or method if it is not this one",
    ),
    "instruction_set": Column("string", "vector instructions that torch used, such as `AVX512`"),
    "threads": Column("int64", "CPU threads of torch"),
    "run": Column("string", "name of the run: the name of its folder or of the checkpoint file"),
    "method": Column("string", "method of the run, such as `icaa`"),
    "problem": Column("string", "problem of the run, such as `darkroom`"),
    "training_seed": Column("int64", "`seed` of the run"),
    "split_seed": Column("int64", "`split_seed` of the run's problem; null if it has none that is a whole number", True),
    "setting": Column("string", "name of the setting in a sweep; empty outside a sweep"),
    "variant": Column("string", "name of the method in a sweep, such as `icag-k4`; outside a sweep the method"),
    "adversaries": Column("int64", "K: disturbances per training task, without the null adversary; null if not known", True),
    "label_source": Column("string", "what the labels of training come from, such as `optimal`; null if not known", True),
    "training_episodes": Column("int64", "episodes that the training collected; null if not known", True),
    "labelled_episodes": Column("int64", "those of them whose labels the fits used; null if not known", True),
    "environment_steps": Column("int64", "environment steps of the training, of demonstrations too; null if not known", True),
    "optimizer_steps": Column("int64", "optimizer steps of the in-context model; null if not known", True),
    "suite": Column("string", "`online`, `offline`, `posterior`, `attack`, `worst`, `label_quality` or `experts`"),
    "tasks": Column("string", "the tasks: `evaluated` (of the online evaluation), `test` or `train`"),
    "agent": Column("string", "key of the agent: `t2` is T^2; other keys are those of reference agents"),
    "policy_version": Column("int64", "version of the weights; -1 for an agent without weights of this run"),
    "weights_digest": Column("string", "SHA-256 of the weights; empty for an agent without"),
    "ceiling": Column("bool", "whether the agent is given the task, so that other returns are shown as a share of its own"),
    "deployment": Column("string", "deployment rule of a model, `paper`, `committed` or `growing`; empty for other agents"),
    "data": Column(
        "string",
        "in suite `offline`: whose episode the context holds, `random` or `expert`; in suite `label_quality`: what the trial "
        "became, `context`, or `labels` if labels come from it or from trials as late; in suite `worst`: whether the agent's "
        "context stayed as it was when its adversary was trained, `frozen`, or began empty, `adapting`; else empty",
    ),
    "prior": Column("string", "`evaluate.prior`: distribution of the test adversaries; empty if they are of training"),
    "task_index": Column("int64", "number of the task among `tasks`"),
    "task": Column("string", "parameters of the task, JSON"),
    "p": Column("double", "strength of the test adversary, from `evaluate.p`; null if it is an adversary of training", True),
    "adversary_family": Column("string", "family of the adversary, such as `dirichlet`; `null` is no disturbance"),
    "adversary_index": Column(
        "int64", "number of the adversary draw for this task, from 0; in training, number of the variation"
    ),
    "adversary": Column("string", "parameters of the adversary, JSON; of a network they include its seed and strength"),
    "evaluation_seed": Column("int64", "number of the evaluation of the task, from 0; the context starts empty in each"),
    "episode": Column("int64", "number of the episode in that evaluation, from 0"),
    "return": Column("double", _RETURN),
    "optimum": Column("double", "expected return of the optimal policy in this variation, where it is known", True),
    "diverged": Column("bool", "whether the simulation diverged in this episode"),
    "surprise": Column("double", "out-of-distribution score after the evaluation's last episode; null elsewhere", True),
    "certified": Column(
        "double",
        "expected return of this episode, given its context, against the worst override adversary of strength p; exact; "
        "null where it is not known",
        True,
    ),
    "agreement": Column(
        "double", "in suite `label_quality`: share of the variation's labels that are optimal; null if it gave none", True
    ),
}
"""The columns of the result rows, in the files' order."""
ADDED: dict[str, Any] = {
    "setting": "",
    "variant": None,
    "adversaries": None,
    "label_source": None,
    "training_episodes": None,
    "labelled_episodes": None,
    "environment_steps": None,
    "optimizer_steps": None,
    "certified": None,
}
"""The columns that format 1 lacks, with their values in its rows; ``variant`` is the method.  K is not known: format 1
has no column for it."""


def document() -> str:
    """The table of columns in docs/data.md."""
    lines = ["| column | type | meaning |", "|---|---|---|"]
    return "\n".join([*lines, *(f"| `{name}` | {column.type} | {column.meaning} |" for name, column in COLUMNS.items())])
