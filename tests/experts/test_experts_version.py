"""A change of the code that changes trained experts is noticed, so that EXPERTS_VERSION is raised."""

import json

import numpy as np
import pytest

from icrl_dist.experts import cache
from tests.experts import recorded_histories
from tests.experts.recorded_histories import CASES, FILE

RECORD = json.loads(FILE.read_text())
AGAIN = "then run `python -m tests.experts.recorded_histories`"
REMEDY = (
    f"tiny experts are not the recorded ones.  If the code of this package was changed on purpose: raise EXPERTS_VERSION in "
    f"icrl_dist/experts/cache.py, {AGAIN}.  If only a library has another version ({{}}): run that command alone.  "
    "Otherwise find the accidental change: experts in the caches of users would no longer be those of the code"
)


def test_the_record_has_every_case_and_the_present_version():
    assert set(RECORD["cases"]) == set(CASES), AGAIN
    assert RECORD["version"] == cache.EXPERTS_VERSION, f"EXPERTS_VERSION was raised: {AGAIN}"


@pytest.mark.parametrize("case", CASES)
def test_experts_are_the_recorded_ones(case):
    """To the bit on the kind of machine that recorded them, else nearly: last digits differ between processors."""
    now, recorded = recorded_histories.measured(case), RECORD["cases"][case]
    versions = recorded_histories.libraries()
    others = ", ".join(
        f"{name} {versions[name]}, recorded {old}" for name, old in RECORD["libraries"].items() if versions[name] != old
    )
    remedy = REMEDY.format(others or "none has")
    np.testing.assert_allclose(now["numbers"], recorded["numbers"], rtol=1e-4, atol=1e-6, err_msg=remedy)
    if not others and recorded_histories.machine() == RECORD["machine"]:
        assert now["digest"] == recorded["digest"], remedy
