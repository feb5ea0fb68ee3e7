"""The cluster file that is shipped on hosts of this machine's own: jobs, three faults, and nothing left behind.

One cluster serves all of it: `ray up` takes longer than a run.
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

from tests.e2e import hosts
from tests.e2e.cluster.machines import TRAIN, plain, started, underway, up, wait_until

CUT_S = 20.0

pytestmark = pytest.mark.timeout(1200)  # five hosts on two cores, beside other tests


@pytest.fixture(scope="module")
def possible():
    if reason := hosts.missing():
        pytest.skip(reason)


@pytest.fixture(scope="module")
def inline(possible, tmp_path_factory):
    """The result of the same run in one process, which goes on beside the first run on the cluster."""
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
    """What is asked of a cluster by `ray job`, from outside."""

    def test_the_machines_join_and_strangers_are_kept_out(self, jobs):
        wait_until(lambda: jobs.running("raylet/raylet") == [1, 1], "a raylet on each worker machine")
        refused = subprocess.run(
            jobs.desk.command("env", "RAY_AUTH_MODE=disabled", "ray", "status", f"--address={jobs.head.address}:6379"),
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        assert refused.returncode != 0 and "Unauthenticated" in refused.stdout, refused.stdout
        assert jobs.answers_strangers() == 401

    def test_a_run_submitted_from_outside_equals_one_in_one_process_and_says_where_everything_is(self, jobs, inline, tmp_path):
        with underway(tmp_path, jobs.job("submit", "--", *jobs.train("smoke").split())) as (process, printed):
            wait_until(lambda: jobs.running("WorkerActor.work") == [1, 1] or process.poll() is not None, "a worker on each machine")
            assert process.poll() is None and not jobs.head.processes("WorkerActor.work"), printed()
            wait_until(lambda: "round 0" in printed() or process.poll() is not None, "what the run prints")
            assert process.poll() is None, "nothing was printed before the end"
            assert process.wait(timeout=400) == 0, printed()
        assert re.search(r"learner on head \(cpu, 1 threads\) listens at tls/", printed())
        assert re.search(r"workers: worker-[ab] \(10.0.0.[34]\): w0; worker-[ab] \(10.0.0.[34]\): w1", printed())
        assert "succeeded" in printed()
        same(jobs.result("smoke"), inline())
        assert set(jobs.workers_of("smoke")) == {"w0", "w1"}

    def test_machines_that_do_not_fit_or_have_no_token_stop_a_run_before_it_starts(self, jobs):
        def refused(words):
            done = subprocess.run(words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=400)
            lines = {plain(line) for line in done.stdout.splitlines() if plain(line).startswith("icrl-dist: ")}
            assert done.returncode != 0 and len(lines) == 1, done.stdout
            return lines.pop(), plain(done.stdout)

        keys = [worker.home / ".icrl" / "certificates" / "worker.key" for worker in jobs.workers]  # whichever answers first
        for key, worker in zip(keys, jobs.workers, strict=True):
            key.rename(key.with_suffix(".away"))
            # A machine that cannot reach the learner's port, though Ray's.
            worker.run("ip", "route", "add", "blackhole", "10.0.0.77/32")
        unfit = jobs.train("unfit", "--stream.connect", "tls/10.0.0.77:7447").split()
        commands = [jobs.exec(f"RAY_AUTH_MODE=disabled {jobs.train('open')}"), jobs.job("submit", "--", *unfit)]
        try:
            with ThreadPoolExecutor() as pool:
                (said, _), (wrong, printed) = pool.map(refused, commands)
        finally:
            for key in keys:
                key.with_suffix(".away").rename(key)
        assert "without a token anyone who reaches Ray's ports" in said
        where = r"worker-[ab] \(10.0.0.[34]\)"
        assert re.search(where + r": .*worker.key: cannot be read.*cannot reach the learner's port, 10.0.0.77:7447", wrong)
        assert re.search(r"Job '\w+' failed .*failed with exit code 2", printed)
        left = [name for name in ("open", "unfit") if jobs.folder(name).exists()]
        assert not left, "the same command could not be given again"

    def test_a_job_that_is_stopped_goes_on_and_20_seconds_without_a_link_change_nothing(self, jobs, inline, tmp_path):
        """Both workers are cut off in the middle of a round, so that the run cannot go on without them."""
        words = jobs.job("submit", "--submission-id", "stopped", "--", *jobs.train("stopped").split())
        with underway(tmp_path, words) as (process, printed):
            wait_until(lambda: jobs.running("WorkerActor.work") == [1, 1] or process.poll() is not None, "workers")
            with jobs.held():
                subprocess.run(jobs.job("stop", "stopped"), check=True, capture_output=True, timeout=250)
                process.wait(timeout=200)
            assert re.search(r"interrupted; `icrl-dist train smoke --resume .*` goes on", printed()), printed()
            assert "was stopped" in printed(), printed()
        assert not jobs.head.processes("learner") and not jobs.head.processes("icrl-dist train")
        with underway(tmp_path, jobs.exec(jobs.train("stopped", "--resume"))) as (process, printed):
            wait_until(lambda: "round 0" in printed() or process.poll() is not None, "a round")
            with contextlib.ExitStack() as cut:
                with jobs.held():
                    cut.enter_context(jobs.cut_off())
                time.sleep(CUT_S)
                assert process.poll() is None, printed()
            assert process.wait(timeout=400) == 0, printed()
        same(jobs.result("stopped"), inline())


def test_killed_raylets_a_killed_learner_and_a_machine_that_joins_midway(cluster, inline, tmp_path):
    """All workers and the learner die in the middle of a round; a machine that nobody has told of does the rest."""
    with underway(tmp_path, cluster.exec(cluster.train("killed"))) as (process, printed):
        wait_until(lambda: "round 0" in printed() or process.poll() is not None, "the first round")
        assert process.poll() is None, printed()
        for word, machines in (("raylet/raylet", cluster.workers), ("-m learner", (cluster.head,))):
            for machine in machines:
                for victim in machine.processes(word):
                    victim.kill()
        joins(cluster)
        assert process.wait(timeout=400) == 0, printed()
    result = cluster.result("killed")
    same(result, inline())
    assert result["worker_deaths"] == 0, "raylets were lost, and with them their workers"
    assert result["learner_deaths"] == 1 and "the learner died (exit code -9)" in printed()
    assert re.search(r"late \(10.0.0.5\): w\d", printed()), printed()
    assert set(cluster.workers_of("killed")) - {"w0", "w1"}, "nobody was needed but those that were killed"


def joins(cluster):
    """What the cluster file does on a worker, by hand."""
    late, head = cluster.late, cluster.head
    for folder in (".ray", ".icrl"):
        shutil.copytree(cluster.desk.home / folder, late.home / folder)
    start = f"RAY_AUTH_MODE=token RAY_worker_niceness=0 {hosts.CODE} ray start --address={head.address}:6379 --num-cpus=1"
    start += f" --node-ip-address={late.address} --object-store-memory=104857600"
    started(
        lambda: late.run("bash", "-c", f"ulimit -n $(ulimit -Hn); {start}", timeout=200),
        lambda: late.run("ray", "stop", "--force", timeout=200),
    )


def test_ray_down_and_ray_stop_end_every_process(cluster):
    stop = "for host; do ssh -i ~/.ssh/id_ed25519 -o StrictHostKeyChecking=no $host icrl-dist/.venv/bin/ray stop & done; wait"
    cluster.desk.run(*cluster.ray("down", "-y", cluster.FILE), timeout=250)
    wait_until(lambda: not left(cluster.head), "everything on the head ended", 60)
    with ThreadPoolExecutor() as pool:
        late = pool.submit(cluster.late.run, "ray", "stop", timeout=250)
        cluster.desk.run("bash", "-c", stop, "stop", *(worker.address for worker in cluster.workers), timeout=250)
        late.result()
    for worker in (*cluster.workers, cluster.late):
        wait_until(lambda worker=worker: not left(worker), "everything ended", 60)


def left(machine):
    """Names of what runs there yet."""
    names = []
    for process in machine.processes(""):
        with contextlib.suppress(psutil.NoSuchProcess):  # it is going just now
            names.append(process.name())
    return [name for name in names if name != "sshd"]
