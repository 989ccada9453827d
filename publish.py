"""Putting runs into data/results, and their figures on the pages: `plot_curves.py --publish RUN...`, `--report`."""

import gzip
import io
import json
import os
import re
import shutil
from functools import partial

import numpy as np
import pandas as pd

import logx
import tables
from kinova_env import TASKS
from logx import BadInput
from tables import GROUP, HERE

PAGES = (HERE / "README.md", HERE / "DIFFERENCES.md", HERE / "data/results/README.md")
INDEX = ["name", "task", *GROUP[:-1], "num_demos", "lambda_bc", "seed", "env_steps", "finished", "eval_success",
         "P_scs_percent", "git_commit"]  # fmt: skip


def write(path, content):
    """A whole file (logx.atomic_write), in a folder that is made where there is none."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        logx.atomic_write(path, content)
    except OSError as error:
        raise BadInput(f"{path}: {error.strerror}; a file that can be written is expected") from None


def packed(paths, **arrays):
    """Bytes of an .npz with TCP paths (tables.read_paths) and `arrays`; positions to half a millimetre."""
    tcp = np.concatenate([*(path["tcp"] for path in paths), np.empty((0, 3))]).astype(np.float16)
    rows = {name: np.array([path[name] for path in paths]) for name in ("goal", "object", "success")}
    rows["length"] = np.array([len(path["tcp"]) - 1 for path in paths])
    out = io.BytesIO()
    np.savez_compressed(out, tcp=tcp, **(rows | arrays))
    return out.getvalue()


def files_of_run(folder):
    """{file name: bytes} that --publish writes of a run. Raises BadInput where it is not whole, or of no commit."""
    run, flag = tables.Curves(folder), f"--publish {folder}"
    if folder.resolve().is_relative_to(tables.RESULTS.resolve()):
        raise BadInput(f"{flag}: is published already")
    if not re.fullmatch("[0-9a-f]{40}", run.row["commit"]):
        raise BadInput(f"{flag}: made with git commit {run.row['commit']}; a clean one is expected")
    if run.pid and "" not in run.evaluations:
        raise BadInput(f"{flag}: no evaluation.csv; run evaluate.py --pid first")
    # no path of a machine is published: of each text with folders, or FLAG=FOLDER/NAME, the name stays
    config = re.sub(r'"([^"/=]*=)?[^"]*/([^"/]*)"', r'"\1\2"', json.dumps(run.config, indent=1))
    files = {"config.json": config.encode()}
    if not run.pid:
        steps, end = run.episodes.env_steps, run.progress.env_steps.max()
        # an episode may be under way at the end of the last epoch, and a killed run has episodes after it
        slack = run.episodes.length.max() + run.config.get("max_ep_len", 1000), run.config["steps_per_epoch"]
        if not (steps == run.episodes.length.cumsum()).all() or not -slack[0] <= steps.max() - end <= slack[1]:
            raise BadInput(f"{flag}: episodes.csv and progress.csv do not fit together")
    if (folder / "policy.pt").exists():
        logx.load_torch(folder / "policy.pt")
        files["policy.pt"] = (folder / "policy.pt").read_bytes()
    for path in sorted(folder.glob("*.csv")):
        files[f"{path.name}.gz"] = gzip.compress(path.read_bytes(), mtime=0)  # the same bytes each time
    printed = tables.columns(run.row["task"])
    drawn = run.row["variant"] == "" and ((run.row["num_demos"], run.row["lambda_bc"])
                                          in set(zip(printed.num_demos, printed.lambda_bc, strict=True)))  # fmt: skip
    if "" in run.evaluations and run.trajectories.exists() and drawn:  # the successful trials alone
        won = run.evaluations[""].query("success == 1")
        errors, (_, paths) = tables.read_errors(run.trajectories), tables.read_paths(run.trajectories)
        if [len(error) - 1 for error in errors] != won.length.to_list():
            raise BadInput(f"{flag}: trajectories.npz is not of evaluation.csv's trials; run evaluate.py again")
        error = np.concatenate([*errors, []]).astype(np.float16)
        files["trajectories.npz"] = packed([path for path in paths if path["success"]], error=error,
                                           length=won.length.to_numpy(), success=np.ones(len(won), bool))  # fmt: skip
    return files


def publish(sources):
    """Copies run folders and demonstration files into data/results, keeps the weights of the best run of each task and
    recipe, and writes index.csv. Returns remarks."""
    results, found = tables.RESULTS, {}
    if twins := {path.name for path in sources if [other.name for other in sources].count(path.name) > 1}:
        raise BadInput(f"--publish: two are called {min(twins)}; one would replace the other")
    for path in sources:  # all of them are read before anything is written
        if path.suffix == ".npz":
            task, paths = tables.read_paths(path)
            if not task:
                raise BadInput(f"--publish {path}: a file of pid_demo.py --record is expected")
            found[results / f"demos-{task}.npz"] = packed(paths[:40])
        else:
            found[results / path.resolve().name] = files_of_run(path)
    for target, files in found.items():
        if isinstance(files, bytes):
            write(target, files)
            continue
        part = results / f".{target.name}.part"
        shutil.rmtree(part, ignore_errors=True)
        for name, data in reversed(files.items()):  # config.json last: without it, half a copy is no run
            write(part / name, data)
        shutil.rmtree(target, ignore_errors=True)
        os.replace(part, target)
    rows, best = [], {}
    for path in sorted(results.glob("[!.]*/config.json")):
        for run in tables.find_runs([path.parent])[0].to_dict("records"):
            success, last = run["curves"].success, run["curves"].validation[-1:].max() / 100
            rows.append({"name": path.parent.name} | run | {
                "env_steps": run["steps"], "finished": int(run["finished"]), "eval_success": last,
                "P_scs_percent": success, "git_commit": run["commit"]})  # fmt: skip
            if (path.parent / "policy.pt").exists():
                rank = run["variant"] != "", -np.nan_to_num(success, nan=-1), -run["steps"], path.parent.name
                best.setdefault((run["task"], run["recipe"]), []).append(rank)
    for *_, name in (rank for ranks in best.values() for rank in sorted(ranks)[1:]):
        (results / name / "policy.pt").unlink()
    write(results / "index.csv", pd.DataFrame(rows, columns=INDEX).to_csv(index=False, float_format="%g"))
    return [*(f"published {target}" for target in found), f"wrote {results / 'index.csv'}, {len(rows)} runs"]


# ---- pages -----------------------------------------------------------------------------------------------------------


def report(figures):
    """{page: its text with each marked block made anew from data/results}. figures: its .png files, in their order."""
    runs, _ = tables.find_runs([tables.RESULTS])

    def block(marks, page):
        name = marks[1]
        if name in ("figures", *(f"figures-{task}" for task in TASKS)):
            shown = [path for path in figures if path.stem.split("-")[2:3] == name.split("-")[1:]]
            text = "\n\n".join(f"![{path.stem}]({os.path.relpath(path, page.parent)})" for path in shown)
        elif name in tables.BLOCKS:
            text = tables.BLOCKS[name](runs)
        else:
            raise BadInput(f"{page}: <!-- {name} --> is no block of --report; --help lists them")
        return f"<!-- {name} -->\n{text}\n<!-- /{name} -->"

    marked = re.compile(r"^<!-- (\S+) -->$.*?^<!-- /\1 -->$", re.MULTILINE | re.DOTALL)
    texts = {page: page.read_text(encoding="utf-8") for page in PAGES if page.exists()}
    return {page: marked.sub(partial(block, page=page), text) for page, text in texts.items()}
