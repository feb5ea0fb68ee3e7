"""What tables and figures call agents.  Result rows hold keys; nothing but this file makes names of them."""

from __future__ import annotations

import re
from typing import NamedTuple

from icrl_dist.config import plugins
from icrl_dist.config.run import ConfigError


class AgentKey(NamedTuple):
    """The columns of result rows by which the agents of one suite differ."""

    agent: str
    deployment: str = ""
    data: str = ""

    @property
    def is_model(self) -> bool:
        """Whether the agent is a policy version of the run."""
        return re.fullmatch(r"t\d+", self.agent) is not None


MINIMAX = "minimax"
"""Key of the policy that is best against the worst adversary of its strength, in rows of suite ``attack``."""


def key_of(version: int) -> str:
    """The key of policy version T^version."""
    return f"t{version}"


def names(agents: list[AgentKey], suite: str, method: str, problem: str) -> dict[AgentKey, str]:
    """The name of each agent of a table.

    The newest policy version is named with its method.  A deployment by Algorithm 1 is named only if another rule
    deploys the same version in the same table.  A reference agent of a problem that is not installed has its key as name.
    """
    versions = [int(agent.agent[1:]) for agent in agents if agent.is_model]
    try:
        known = dict(plugins.find("problems", problem).agent_names)
    except ConfigError:
        known = {}
    found = {}
    for agent in agents:
        name = known.get(agent.agent, "minimax oracle" if agent.agent == MINIMAX else agent.agent)
        if agent.is_model:
            version = int(agent.agent[1:])
            name = f"T^{version} ({method})" if version == max(versions) else f"T^{version}"
            rules = {other.deployment for other in agents if other.agent == agent.agent and other.data == agent.data}
            if agent.deployment == "paper" and len(rules) > 1:
                name += ", Algorithm 1"
        if suite == "offline":
            source = "random" if agent.agent == "random" else "expert"
            name = f"{name}, {agent.data} data" if agent.data else f"{source} data"
        found[agent] = name
    return found
