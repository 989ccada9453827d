"""Run folders with curves and trials whose numbers follow by hand, and what the tables make of them."""

import json

import numpy as np
import torch

import plot_curves
import tables
from plot_curves import Flags

CONFIG = {"task": "p2p", "algo": "ddpg", "recipe": "robust", "num_demos": 100, "lambda_bc": 1.8, "symmetry": "mirror",
          "seed": 0, "epochs": 2, "steps_per_epoch": 2000, "max_ep_len": 400, "gains": "fast",
          "partitions": 4}  # fmt: skip
COMMIT = "0123456789" * 4
PID = {"task": "p2p", "algo": "pid", "gains": "fast", "versions": {"git_commit": COMMIT}}
HEADER = "trial,success,failure,grasped,length,return,effort_percent,final_error_cm,e95_cm\n"


def trials(success):
    """evaluation.csv of trials that take 3 + i steps, with return 10 + i and effort 20 + i."""
    return HEADER + "".join(f"{i},{won},,0,{3 + i},{10 + i},{20 + i},5,6\n" for i, won in enumerate(success))


def of_200(won):
    return (1,) * won + (0,) * (200 - won)


def write_run(folder, returns=(1.0,) * 60, steps=4000, success=None, own=(0,), columns="L_C,Q_mean",
              validated=0.5, **config):  # fmt: skip
    """A run folder like a training script's; `steps`: environment steps after the last epoch; own: success of own
    episodes, in turn; success: of each trial in evaluation.csv and trajectories.npz, where the error falls from 50 to 5
    cm in equal steps."""
    folder.mkdir(parents=True)
    config = {**CONFIG, "versions": {"git_commit": COMMIT}, **config} if config != PID else PID
    (folder / "config.json").write_text(json.dumps(config))
    if config != PID:
        rows = "".join(f"{i},{20 * i},{value},20,{own[i % len(own)]},\n" for i, value in enumerate(returns, start=1))
        (folder / "episodes.csv").write_text("episode,env_steps,return,length,success,collision\n" + rows)
        (folder / "progress.csv").write_text(
            f"epoch,env_steps,demo_env_steps,seconds,{columns},eval_success,eval_return\n"
            f"1,{steps // 2},0,60,,,{validated},1\n2,{steps},0,120,,,,\n")  # fmt: skip
        torch.save({"weights": torch.zeros(2)}, folder / "policy.pt")
    if success is not None:
        (folder / "evaluation.csv").write_text(trials(success))
        n = np.arange(len(success)) + 3
        np.savez(folder / "trajectories.npz", length=n, success=np.array(success, bool), goal=np.full((len(n), 3), 0.4),
                 error=np.concatenate([np.linspace(0.5, 0.05, k + 1) for k in n]).astype(np.float32),
                 tcp=np.full((np.sum(n + 1), 3), 0.5, np.float32), object=np.full((len(n), 3), np.nan))  # fmt: skip
    return folder


def table(kind="training", task="p2p", named=None, variants=False):
    return tables.table(kind, task, tables.of_task(tables.find_runs(named)[0], task, variants))


def cell(rows, metric, sweep="lambda", num_demos=100, lambda_bc=1.8, evaluation=""):
    """The one row of this metric and column."""
    found = rows[(rows.metric == metric) & (rows.sweep == sweep) & (rows.num_demos == num_demos)
                 & (rows.lambda_bc == lambda_bc) & (rows.evaluation == evaluation)]  # fmt: skip
    (one,) = found.to_dict("records")
    return one


def figure(name, task="p2p", named=None, **flags):
    runs = tables.of_task(tables.find_runs(named)[0], task, variants=name in ("symmetry", "success"))
    return getattr(plot_curves, f"{name}_figure")(task, runs, Flags(**flags))
