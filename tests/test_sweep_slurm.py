"""The sweep on a real Slurm: a cluster of one node that the tests start (Debian's slurm-wlm and munge, as root)."""

import os
import pwd
import signal
import subprocess

import pytest

import sweep
from test_sweep import ENDLESS, SHORT, ends_as_an_unbroken_run, jobs_of, wait_for

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


def submit(data_dir, *flags):
    """Submits a sweep and returns its jobs."""
    flags = [*flags, "--cluster", "slurm", "--data_dir", str(data_dir)]
    assert not sweep.main(flags)
    return jobs_of(*flags)


def states(jobs):
    return [job.state()[0] for job in jobs]


def test_sweep_of_four_runs_goes_to_its_end_on_a_node_drained_meanwhile_and_is_not_submitted_twice(
    cluster, tmp_path, capsys
):
    flags = [*SHORT, "--columns", "baseline", "demos=0", "--seeds", "2"]
    slurm("scontrol", "update", "nodename=localhost", "state=drain", "reason=repair")
    jobs = submit(tmp_path, *flags)
    assert states(jobs) == ["queued"] * 4
    submit(tmp_path, *flags)
    assert capsys.readouterr().out.endswith("4 runs, 0 to do\n")
    slurm("scontrol", "update", "nodename=localhost", "state=resume")
    wait_for(lambda: "running" in states(jobs))
    slurm("scontrol", "update", "nodename=localhost", "state=drain", "reason=repair")  # what runs goes on
    wait_for(lambda: "done" in states(jobs))
    slurm("scontrol", "update", "nodename=localhost", "state=resume")
    wait_for(lambda: states(jobs) == ["done"] * 4)


def test_job_that_is_requeued_in_mid_run_ends_where_an_unbroken_run_ends(cluster, tmp_path):
    (job,) = submit(tmp_path / "runs", *ENDLESS, "--seeds", "1")
    wait_for(lambda: job.steps() >= 200)
    number = job.text("slurm_job")
    slurm("scontrol", "requeue", number)
    wait_for(lambda: states([job]) == ["queued"])
    before = job.steps()
    wait_for(lambda: job.steps() > before)
    assert "Restarts=1" in slurm("scontrol", "show", "job", number)
    slurm("scancel", number)
    wait_for(lambda: states([job]) == ["stopped"])
    assert ends_as_an_unbroken_run(job, tmp_path / "unbroken")


def test_job_whose_time_is_up_saves_its_state_is_queued_again_and_goes_on(cluster, tmp_path):
    (job,) = submit(tmp_path, *ENDLESS, "--seeds", "1", "--time", "2", "--signal_delay", "30")
    logs = tmp_path / "slurm"
    wait_for(lambda: any("this job is timed-out" in path.read_text() for path in logs.glob("*.err")), 180)
    wait_for(lambda: states([job]) == ["queued"])
    before = job.steps()
    assert before > 0 and job.text("log.txt").splitlines()[-1].endswith("state saved; go on with --resume")
    wait_for(lambda: job.steps() > before)
    slurm("scancel", job.text("slurm_job"))
    wait_for(lambda: states([job]) == ["stopped"])
