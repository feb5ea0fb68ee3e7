"""What a stored state of AdamW and Muon must hold, whether torch or the compiled kernel takes the steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np


def steps_of(stored: Mapping[str, np.ndarray], adamw: Sequence[tuple[int, ...]], muon: Sequence[tuple[int, ...]]) -> set[int]:
    """The steps that its parameters have taken, from a state by name, ``PART/INDEX/NAME``; none for an empty state.

    ``adamw``, ``muon``: the shapes of the parameters that each trains.  Raises ValueError for the state of other parameters
    or of another optimizer, and for steps that are no count.
    """
    if not stored:
        return set()
    trained = [len({key.split("/")[1] for key in stored if key.startswith(f"{part}/")}) for part in (0, 1)]
    if trained != [len(adamw), len(muon)]:
        raise ValueError(
            f"AdamW and Muon train {trained[0]} and {trained[1]} parameters there, {len(adamw)} and {len(muon)} here"
        )
    expected = {f"1/{index}/momentum_buffer": shape for index, shape in enumerate(muon)}
    for index, shape in enumerate(adamw):
        expected |= {f"0/{index}/step": (), f"0/{index}/exp_avg": shape, f"0/{index}/exp_avg_sq": shape}
    if names := sorted(set(expected) ^ set(stored)):
        raise ValueError(f"it holds {names[0]}, which is unknown" if names[0] in stored else f"it lacks {names[0]}")
    for name, shape in expected.items():
        if (found := stored[name]).shape != shape or found.dtype.kind != "f":
            raise ValueError(f"{name} has the shape {found.shape} and the type {found.dtype}, not {shape} and a float")
    steps = [float(stored[f"0/{index}/step"]) for index in range(len(adamw))]
    if wrong := [step for step in steps if step < 1 or not step.is_integer()]:
        raise ValueError(f"a parameter took {wrong[0]:g} steps, which is no count")
    return {int(step) for step in steps}
