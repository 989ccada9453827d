"""The sweep on a real Slurm: a cluster of one node that the tests start (Debian's slurm-wlm and munge, as root)."""

import os
import pwd
import signal
import subprocess

import pytest
from test_sweep import LONG, TINY, curves, run, runs_of, unbroken, wait_for  # noqa: F401 - a fixture

import sweep

pytestmark = pytest.mark.root
CONF = """
ClusterName=one
SlurmctldHost=localhost
AuthType=auth/munge
AuthInfo=socket={folder}/munge/socket,cred_expire=5
CredType=cred/munge
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
SlurmUser=root
SlurmctldPort={port}
SlurmdPort={port_node}
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
JobRequeue=1
KillWait=20
SchedulerParameters=batch_sched_delay=1,sched_interval=2,sched_min_interval=0
ReturnToService=2
MpiDefault=none
NodeName=localhost CPUs=2 RealMemory=16000 State=UNKNOWN
PartitionName=all Nodes=localhost Default=YES MaxTime=INFINITE State=UP
"""


def slurm(*words):
    done = subprocess.run(words, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, (words, done.stderr)
    return done.stdout


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    folder = tmp_path_factory.mktemp("slurm")
    for place in (folder, *folder.parents[:3]):
        place.chmod(0o755)  # munge's daemon is another user
    munge = folder / "munge"
    munge.mkdir()
    (munge / "key").write_bytes(os.urandom(128))
    user = pwd.getpwnam("munge")
    for path, mode in ((munge, 0o755), (munge / "key", 0o400)):
        path.chmod(mode)
        os.chown(path, user.pw_uid, user.pw_gid)
    for name in ("state", "spool"):
        (folder / name).mkdir()
    ports = dict(port=20000 + os.getpid() % 20000, port_node=20001 + os.getpid() % 20000)
    socket = munge / "socket"
    (folder / "slurm.conf").write_text(CONF.format(folder=folder, **ports))
    daemons = []
    before = os.environ.get("SLURM_CONF")
    os.environ["SLURM_CONF"] = str(folder / "slurm.conf")
    try:
        daemons.append(subprocess.Popen(
            ["munged", "--foreground", f"--key-file={munge}/key", f"--socket={socket}", f"--pid-file={munge}/pid",
             f"--log-file={munge}/log", f"--seed-file={munge}/seed"], user="munge", group="munge"))  # fmt: skip
        wait_for(socket.exists, 20)
        for daemon in (["slurmctld", "-D", "-c"], ["slurmd", "-D", "-N", "localhost"]):
            with open(folder / f"{daemon[0]}.out", "w") as out:
                daemons.append(subprocess.Popen(daemon, stdout=out, stderr=out))
        wait_for(lambda: "idle" in subprocess.run(["sinfo", "-h"], capture_output=True, text=True).stdout, 60)
        yield folder
    finally:
        subprocess.run(["scancel", "--full", "--signal=KILL", "--user=root"], capture_output=True)
        for daemon in reversed(daemons):
            daemon.send_signal(signal.SIGTERM)
            daemon.wait(30)
        del os.environ["SLURM_CONF"]
        if before:
            os.environ["SLURM_CONF"] = before


def submit(tmp_path, *flags, extra=TINY):
    code, _, errors = run(*flags, "--cluster", "slurm", data_dir=tmp_path, extra=extra)
    assert code == 0, errors
    return runs_of(*flags, data_dir=tmp_path, extra=extra)


def all_done(runs):
    return all(run.state()[0] == "done" for run in runs)


def logs(tmp_path):
    return "".join(path.read_text() for path in sorted((tmp_path / "slurm").glob("*.err")))


def test_sweep_of_four_runs_goes_to_its_end_on_a_node_drained_meanwhile_and_is_not_submitted_twice(cluster, tmp_path):
    short = ["--task", "p2p", "--columns", "baseline", "demos=0", "--epochs", 4, "--steps_per_epoch", 100, "--seeds", 2]
    slurm("scontrol", "update", "nodename=localhost", "state=drain", "reason=repair")
    runs = submit(tmp_path, *short)
    assert [run.state()[0] for run in runs] == ["queued"] * 4
    code, out, _ = run(*short, "--cluster", "slurm", data_dir=tmp_path)
    assert code == 0 and "4 runs, 0 to do" in out
    slurm("scontrol", "update", "nodename=localhost", "state=resume")
    wait_for(lambda: any(run.state()[0] == "running" for run in runs))
    slurm("scontrol", "update", "nodename=localhost", "state=drain", "reason=repair")  # what runs goes on
    wait_for(lambda: sum(run.state()[0] == "done" for run in runs) >= 1)
    slurm("scontrol", "update", "nodename=localhost", "state=resume")
    wait_for(lambda: all_done(runs))


def test_job_that_is_requeued_in_mid_run_ends_where_an_unbroken_run_ends(cluster, tmp_path, unbroken):  # noqa: F811
    (only,) = submit(tmp_path, *LONG, "--seeds", 1)
    wait_for(lambda: only.steps() >= 200)
    job = (only.folder / "slurm_job").read_text()
    slurm("scontrol", "requeue", job)
    wait_for(lambda: only.state()[0] == "queued")
    assert 200 <= only.steps() < only.total
    wait_for(lambda: all_done([only]))
    assert "Restarts=1" in slurm("scontrol", "show", "job", job)
    assert curves(only.folder) == unbroken[0]


def test_job_whose_time_is_up_saves_its_state_is_queued_again_and_goes_on(cluster, tmp_path):
    endless = ["--task", "p2p", "--columns", "baseline", "--epochs", 100_000_000, "--steps_per_epoch", 1000]
    flags = [*endless, "--seeds", 1, "--time", 2, "--signal_delay", 30]
    (only,) = submit(tmp_path, *flags)
    wait_for(lambda: "this job is timed-out" in logs(tmp_path), 180)
    wait_for(lambda: only.state()[0] == "queued")
    before = only.steps()
    assert before > 0 and sweep.log_lines(only.folder)[-1].endswith("state saved; go on with --resume")
    wait_for(lambda: only.steps() > before)
    slurm("scancel", (only.folder / "slurm_job").read_text())
    wait_for(lambda: only.state()[0] != "running")
