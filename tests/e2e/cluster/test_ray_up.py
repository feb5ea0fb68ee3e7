"""The shipped cluster file on simulated nodes: jobs, three faults, and no process left at the end.

All tests use one cluster, because `ray up` takes longer than a run.
"""

import contextlib
import json
import re
import shutil
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import psutil
import pytest

from tests.e2e import simulated_nodes
from tests.e2e.cluster.shipped import TRAIN, one_line, started, underway, up
from tests.e2e.training import wait_for

CUT_S = 20.0

pytestmark = pytest.mark.timeout(1200)  # five nodes on two cores, in parallel with other tests


@pytest.fixture(scope="module")
def possible():
    if reason := simulated_nodes.missing():
        pytest.skip(reason)


@pytest.fixture(scope="module")
def inline(possible, tmp_path_factory):
    """The result of the same run in one process, which runs in parallel with the first run on the cluster."""
    folder = tmp_path_factory.mktemp("runs") / "inline"
    command = [sys.executable, "-m", "icrl_dist.cli", *TRAIN, "--engine", "inline", "--out", folder]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:

        def finished():
            assert process.wait(timeout=400) == 0
            return json.loads((folder / "result.json").read_text())

        yield finished


@pytest.fixture(scope="module")
def cluster(possible, tmp_path_factory):
    with up(tmp_path_factory.mktemp("cluster")) as cluster:
        yield cluster


@pytest.fixture(scope="class")
def jobs(cluster):
    """The cluster with a tunnel to its job server."""
    with cluster.tunnel():
        yield cluster


def same(result, expected):
    for name in ("dataset_digest", "weights_digest", "trajectories"):
        assert result[name] == expected[name], name


class TestJobs:
    """Jobs that `ray job` submits to the cluster from outside."""

    def test_the_nodes_join_and_requests_without_a_token_are_refused(self, jobs):
        wait_for(lambda: jobs.running("raylet/raylet") == [1, 1], "a raylet on each worker node")
        refused = subprocess.run(
            jobs.client.command("env", "RAY_AUTH_MODE=disabled", "ray", "status", f"--address={jobs.head.address}:6379"),
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        assert refused.returncode != 0 and "Unauthenticated" in refused.stdout, refused.stdout
        assert jobs.status_without_token() == 401

    def test_a_submitted_run_equals_one_in_one_process_and_prints_its_placement(self, jobs, inline, tmp_path):
        with underway(tmp_path, jobs.job("submit", "--", *jobs.train("smoke").split())) as (process, printed):
            wait_for(lambda: jobs.running("WorkerActor.work") == [1, 1] or process.poll() is not None, "a worker on each node")
            assert process.poll() is None and not jobs.head.processes("WorkerActor.work"), printed()
            wait_for(lambda: "adapt/0" in printed() or process.poll() is not None, "the output of round 0")
            assert process.poll() is None, "the output came only at the end"
            assert process.wait(timeout=400) == 0, printed()
        assert re.search(r"learner on head \(cpu, 1 threads\) listens at tls/", printed())
        assert re.search(r"workers: worker-[ab] \(10.0.0.[34]\): w0; worker-[ab] \(10.0.0.[34]\): w1", printed())
        assert "succeeded" in printed()
        same(jobs.result("smoke"), inline())
        assert set(jobs.workers_of("smoke")) == {"w0", "w1"}

    def test_a_run_without_a_token_or_with_unfit_nodes_is_refused_before_it_starts(self, jobs):
        def refused(words):
            done = subprocess.run(words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=400)
            lines = {one_line(line) for line in done.stdout.splitlines() if one_line(line).startswith("icrl-dist: ")}
            assert done.returncode != 0 and len(lines) == 1, done.stdout
            return lines.pop(), one_line(done.stdout)

        keys = [
            worker.home / ".icrl" / "certificates" / "worker.key" for worker in jobs.workers
        ]  # either node may answer first
        for key, worker in zip(keys, jobs.workers, strict=True):
            key.rename(key.with_suffix(".away"))
            # The node cannot reach the learner's port, but it can reach Ray's.
            worker.run("ip", "route", "add", "blackhole", "10.0.0.77/32")
        unfit = jobs.train("unfit", "--stream.connect", "tls/10.0.0.77:7447").split()
        commands = [jobs.exec(f"RAY_AUTH_MODE=disabled {jobs.train('open')}"), jobs.job("submit", "--", *unfit)]
        try:
            with ThreadPoolExecutor() as pool:
                (refusal, _), (wrong, printed) = pool.map(refused, commands)
        finally:
            for key in keys:
                key.with_suffix(".away").rename(key)
        assert "without a token anyone who reaches Ray's ports" in refusal
        where = r"worker-[ab] \(10.0.0.[34]\)"
        assert re.search(where + r": .*worker.key: cannot be read.*cannot reach the learner's port, 10.0.0.77:7447", wrong)
        assert re.search(r"Job '\w+' failed .*failed with exit code 2", printed)
        left = [name for name in ("open", "unfit") if jobs.folder(name).exists()]
        assert not left, "the same command could not be given again"

    def test_a_stopped_job_resumes_and_20_seconds_without_a_network_change_nothing(self, jobs, inline, tmp_path):
        """Both workers are disconnected in the middle of a round, so that the run cannot continue without them."""
        words = jobs.job("submit", "--submission-id", "stopped", "--", *jobs.train("stopped").split())
        with underway(tmp_path, words) as (process, printed):
            wait_for(lambda: jobs.stored("stopped") or process.poll() is not None, "trajectories")
            with jobs.suspended():
                subprocess.run(jobs.job("stop", "stopped"), check=True, capture_output=True, timeout=250)
                process.wait(timeout=200)
            assert re.search(r"interrupted; `icrl-dist train smoke --resume .*` continues", printed()), printed()
            assert "was stopped" in printed(), printed()
        assert not jobs.head.processes("learner") and not jobs.head.processes("icrl-dist train")
        before = jobs.stored("stopped")
        with underway(tmp_path, jobs.exec(jobs.train("stopped", "--resume"))) as (process, printed):
            wait_for(lambda: jobs.stored("stopped") > before or process.poll() is not None, "more trajectories")
            with contextlib.ExitStack() as cut:
                with jobs.suspended():
                    cut.enter_context(jobs.cut_off())
                time.sleep(CUT_S)
                assert process.poll() is None, printed()
            assert process.wait(timeout=400) == 0, printed()
        same(jobs.result("stopped"), inline())


def test_killed_raylets_a_killed_learner_and_a_node_that_joins_during_a_round(cluster, inline, tmp_path):
    """All workers and the learner die in the middle of a round; a node outside the cluster file does the rest."""
    with underway(tmp_path, cluster.exec(cluster.train("killed"))) as (process, printed):
        wait_for(lambda: "adapt/0" in printed() or process.poll() is not None, "the first round")
        assert process.poll() is None, printed()
        for word, nodes in (("raylet/raylet", cluster.workers), ("-m learner", (cluster.head,))):
            for node in nodes:
                for victim in node.processes(word):
                    victim.kill()
        joins(cluster)
        assert process.wait(timeout=400) == 0, printed()
    result = cluster.result("killed")
    same(result, inline())
    assert result["worker_deaths"] == 0, "the workers were lost with their raylets"
    assert result["learner_deaths"] == 1 and "the learner died (exit code -9)" in printed()
    assert re.search(r"late \(10.0.0.5\): w\d", printed()), printed()
    assert set(cluster.workers_of("killed")) - {"w0", "w1"}, "only workers that were killed sent trajectories"


def joins(cluster):
    """Run the commands that the cluster file runs on a worker node."""
    late, head = cluster.late, cluster.head
    for folder in (".ray", ".icrl"):
        shutil.copytree(cluster.client.home / folder, late.home / folder)
    start = (
        f"RAY_AUTH_MODE=token RAY_worker_niceness=0 {simulated_nodes.CODE} ray start --address={head.address}:6379 --num-cpus=1"
    )
    start += f" --node-ip-address={late.address} --object-store-memory=104857600"
    started(
        lambda: late.run("bash", "-c", f"ulimit -n $(ulimit -Hn); {start}", timeout=200),
        lambda: late.run("ray", "stop", "--force", timeout=200),
    )


def test_ray_down_and_ray_stop_end_every_process(cluster):
    stop = "for host; do ssh -i ~/.ssh/id_ed25519 -o StrictHostKeyChecking=no $host icrl-dist/.venv/bin/ray stop & done; wait"
    cluster.client.run(*cluster.ray("down", "-y", cluster.FILE), timeout=250)
    wait_for(lambda: not left(cluster.head), "everything on the head ended", 60)
    with ThreadPoolExecutor() as pool:
        late = pool.submit(cluster.late.run, "ray", "stop", timeout=250)
        cluster.client.run("bash", "-c", stop, "stop", *(worker.address for worker in cluster.workers), timeout=250)
        late.result()
    for worker in (*cluster.workers, cluster.late):
        wait_for(lambda worker=worker: not left(worker), "everything ended", 60)


def left(node):
    """Names of the processes that still run on a node."""
    names = []
    for process in node.processes(""):
        with contextlib.suppress(psutil.NoSuchProcess):  # the process ends at this moment
            names.append(process.name())
    return [name for name in names if name != "sshd"]
