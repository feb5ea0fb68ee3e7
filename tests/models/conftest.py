from __future__ import annotations

import pytest

from icrl_dist.models.compiled import kinds
from tests.models.deployments import IMPLEMENTATIONS, Deploy, deployment


@pytest.fixture(params=IMPLEMENTATIONS)
def deploy(request: pytest.FixtureRequest) -> Deploy:
    name: str = request.param
    if name != "torch" and name not in kinds():
        pytest.skip(f"the kernel was not built, or this processor has no {name}")
    return deployment(name)
