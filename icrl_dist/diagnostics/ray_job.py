"""How Ray's worker processes find code.  The module ``ray`` is an argument."""

from __future__ import annotations

from typing import Any

from icrl_dist.telemetry import processes


def job_config(ray: Any) -> Any:
    """A job for ``ray.init`` whose workers import installed code, and this package's own code in a source checkout.

    Ray would put the folder of the script and the current folder before all others, so a file ``random.py`` of the
    user there would be imported in place of Python's own.  It adds neither for a job that has a working directory.
    """

    class Job(ray.job_config.JobConfig):  # type: ignore[misc]
        def _runtime_env_has_working_dir(self) -> bool:
            return True

    return Job(_py_driver_sys_path=processes.code_path())
