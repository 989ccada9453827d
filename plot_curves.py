"""The paper's results (`sec:results`) beside ours: every table and figure, drawn from the files in data/ alone.

    python plot_curves.py --table training --task p2p                 # tab:p2p, the paper's numbers beside all our runs
    python plot_curves.py --table test --task p2p --runs data/runs --csv p2p.csv     # tab:p2p_imp, these runs; also CSV
    python plot_curves.py --figure learning --task p2p                # figures/fig-learning-p2p.png and .pdf
    python plot_curves.py --all figures                               # all of them, and how to fill the gaps: 30 s
    python plot_curves.py --publish data/runs/NAME                    # copies a run into data/results (data/README.md)

`--runs` takes run folders, or folders with run folders anywhere below; without it, data/results and data/runs are read
and `--quick` runs left out. Runs of one algorithm, recipe, symmetry, variant (what else differs from the recipe) and
length are a group; groups are never averaged together. A run belongs to a printed column when algorithm, N_demos and
lambda_BC are the column's.

Training, per seed, over the agent's own training episodes (demonstrations are not counted):
    R10, R90    mean return of the first and of the last tenth of the episodes (a tenth of n is ceil(n / 10))
    I_R         R90 - R10 (the paper's is shown as printed, which differs from this by 0.01 to 0.03 in three cells)
    T50         first episode at which the mean of the last 50 returns exceeds R90 / 2; N/A where R90 <= 0 or never
Test, per seed, over the trials of its evaluation.csv: P_scs in percent; T_eff, R_test, E_95 over the successful ones.
Then the mean over seeds, with its 95 % bootstrap interval: BCa where it can be computed, percentile otherwise. A single
seed has none in training, and in the test one over its trials (Wilson's for P_scs), which knows nothing of other seeds.
With five seeds or fewer such an interval is narrower than it should be; read a "*" with that in mind. The paper counts
episodes, we stop at a number of environment steps: T50 depends on how long the early episodes last.
"""
import argparse
import csv
import gzip
import io
import json
import math
import os
import re
import shutil
import sys
import warnings
import zipfile
import zlib
from collections import Counter
from dataclasses import dataclass
from itertools import combinations, groupby, product
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.figure import Figure  # without pyplot: a PNG is then always drawn by Agg, no display needed
from matplotlib.lines import Line2D
from scipy.stats import binomtest, bootstrap

import logx

HERE = Path(__file__).resolve().parent
PAPER, RESULTS, RUNS, FIGURES = HERE / "data/paper", HERE / "data/results", HERE / "data/runs", HERE / "figures"
SWEEPS = {"lambda": "lambda_BC", "demos": "N_demos", "baseline": "baseline", "pid": "PID", "other": "other"}
TASKS = {"p2p": "P2P", "p2po": "P2P-O", "pnp": "P&P"}
LABELS = {"training": {"p2p": "tab:p2p", "p2po": "tab:p2p-o", "pnp": "tab:pnp"},
          "test": {"p2p": "tab:p2p_imp", "p2po": "tab:p2po_imp", "pnp": "tab:pnp_imp"}}
METRICS = {"training": {"R10": 2, "R90": 2, "I_R": 2, "T50": 0},  # and the decimals that the paper prints
           "test": {"P_scs_percent": 1, "T_eff": 1, "R_test": 2, "E_95_cm": 2}}
OF_SUCCESSFUL = {"T_eff": "effort_percent", "R_test": "return", "E_95_cm": "e95_cm"}  # means over successful trials
RANKED = {"training": "R90", "test": "P_scs_percent"}  # the metric by which columns are compared
SYMBOLS = {"R10": r"$\overline{R}_{10}$", "R90": r"$\overline{R}_{90}$", "I_R": "$I_R$", "T50": "$T_{50}$",
           "P_scs_percent": r"$P_{\mathrm{scs}}$ (\%)", "T_eff": r"$\overline{T}_{\mathrm{eff}}$",
           "R_test": r"$\overline{R}_{\mathrm{test}}$", "E_95_cm": r"$\overline{E}_{\overline{95}}$ (cm)",
           "N_demos": r"$N_{\mathrm{demos}}$", "lambda_BC": r"$\lambda_{BC}$", "*": "$^*$"}
WINDOW = 50  # episodes of the running mean, in T50 and in the figures
TIME_STEP, EPSILON = 0.02, 0.05  # s, m: as in kinova_env
INNER, OUTER, LOW, HIGH = 0.3, 0.7, 0.25, 0.65  # m: reachable rho in [INNER, OUTER), z in [LOW, HIGH)
CONFIG = {"task": str, "algo": str, "recipe": str, "symmetry": str, "num_demos": int, "lambda_bc": (int, float),
          "seed": int, "epochs": int, "steps_per_epoch": int, "quick": bool}
PID = ("pid", 0, 0.0)  # the demonstrator's column
TRIALS = ("trial", "success", "length", "return", "effort_percent", "e95_cm")
PATHS = ("length", "success", "tcp", "goal", "object")
CSV_HEADER = ["task", "sweep", "num_demos", "lambda_bc", "algo", "recipe", "symmetry", "variant", "total_env_steps",
              "seeds", "unfinished_seeds", "metric", "paper", "mean", "low", "high", "interval", "na_seeds",
              "paper_outside"]
INDEX_HEADER = ["name", "task", "algo", "recipe", "symmetry", "variant", "num_demos", "lambda_bc", "seed", "env_steps",
                "finished", "eval_success", "P_scs_percent", "git_commit"]
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")  # Okabe & Ito: safe for colour-blind eyes
DASHES = ("-", (0, (5, 1.5)), (0, (3, 1, 1, 1)), (0, (1.5, 1)), (0, (8, 1, 1, 1, 1, 1)), (0, (1, 2)))  # one a group
GREEN, GREY, BORDER = COLOURS[2], "#555555", (0, (4, 2))  # the tube of reachable positions, the borders of sectors
LOOK = {"font.family": "STIXGeneral", "mathtext.fontset": "stix", "font.size": 8, "legend.fontsize": 7,
        "legend.title_fontsize": 7, "legend.frameon": False, "axes.spines.top": False, "axes.spines.right": False,
        "axes.titlesize": 8.5, "pdf.fonttype": 42}


def fail(message):
    """Bad input: one line on standard error, exit code 2."""
    print(f"plot_curves.py: error: {' '.join(str(message).split())}", file=sys.stderr)
    sys.exit(2)


# ------------------------------------------------------------------------------------------ reading

@dataclass(frozen=True, eq=False)  # an array has no single truth
class Run:
    path: Path
    column: tuple  # (algo, N_demos, lambda_BC): what the paper varies
    group: tuple  # (algo, recipe, symmetry, variant, total environment steps): what we vary
    seed: int
    unfinished: str  # "" or how far it is
    returns: np.ndarray  # (episodes,) undiscounted return of each training episode; (0,) for the PID
    trials: dict  # {column: (trials,)} of evaluation.csv; {} where there is none


def read_csv(path, numbers, texts=()):
    """{column: (rows,) array} of a CSV file, or of the one with `.gz` behind its name; numbers are float, finite."""
    path = path if path.exists() else path.with_name(path.name + ".gz")
    try:
        data = gzip.decompress(path.read_bytes()) if path.suffix == ".gz" else path.read_bytes()
        header, *rows = list(csv.reader(io.StringIO(data.decode(), newline=""))) or [[]]
        if missing := [column for column in (*numbers, *texts) if column not in header]:
            raise ValueError(f"no column {', '.join(missing)}")
        if ragged := [line for line, row in enumerate(rows, start=2) if len(row) != len(header)]:
            raise ValueError(f"line {ragged[0]} is cut short or garbled")
        table = {column: np.array([row[header.index(column)] for row in rows]) for column in (*numbers, *texts)}
        table |= {column: table[column].astype(float) for column in numbers}
        if odd := [column for column in numbers if not np.isfinite(table[column]).all()]:
            raise ValueError(f"nan or inf in column {odd[0]}")
        return table
    except FileNotFoundError:
        fail(f"{path.with_suffix('')}: no such file (nor .gz); a table of {','.join((*numbers, *texts))} is expected")
    except (OSError, EOFError, zlib.error, ValueError, csv.Error) as error:
        fail(f"{path}: {error}; a CSV table with numbers in {','.join(numbers)} is expected")


def read_npz(path, names):
    """{name: array} of an .npz file, without pickled objects."""
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in names}
        if odd := [name for name in names if arrays[name].dtype.kind not in "biuf" and name != "meta"]:
            raise ValueError(f"array {odd[0]} holds no numbers")
        if odd := [name for name in ("length", "success") if name in names and arrays[name].ndim != 1]:
            raise ValueError(f"array {odd[0]} is {arrays[odd[0]].shape}, not (n,)")
        return arrays
    except (OSError, EOFError, KeyError, TypeError, ValueError, zipfile.BadZipFile, zlib.error) as error:
        fail(f"{path}: {error}; a whole .npz with the arrays {', '.join(names)} is expected")


def split_trials(path, values, length):
    """values (sum(length + 1), ...), of t = 0 ... length of one trial after another, as a list of a trial each."""
    if length.dtype.kind not in "iu" or length.ndim != 1 or values.shape[:1] != (np.sum(length + 1),):
        fail(f"{path}: its arrays do not fit together; length + 1 entries for each trial are expected")
    return np.split(values, np.cumsum(length + 1)[:-1])


def read_paths(path):
    """The TCP paths in a trajectories.npz or demos-TASK.npz: [{"tcp": (length + 1, 3), "goal", "object": (3,), m,
    "success"}]; object is NaN where there is none."""
    file = read_npz(path, PATHS)
    if odd := [name for name in ("tcp", "goal", "object") if file[name].ndim != 2 or file[name].shape[1] != 3]:
        fail(f"{path}: array {odd[0]} is {file[odd[0]].shape}; (n, 3) is expected")
    file["tcp"] = split_trials(path, file["tcp"], file["length"][:len(file["goal"])])
    return [{name: file[name][i] for name in PATHS} for i in range(min(map(len, file.values())))]


def read_errors(path):
    """||e_t|| in m (length + 1,) of each successful trial in a trajectories.npz."""
    file = read_npz(path, ("length", "success", "error"))
    errors = split_trials(path, file["error"], file["length"])
    return [error for error, success in zip(errors, file["success"], strict=False) if success]


def read_config(path):
    try:
        config = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        fail(f"{path}: {error}; a run's flags as JSON are expected")
    if not isinstance(config, dict) or not isinstance(config.get("versions", {}), dict):
        fail(f"{path}: no key 'task', or 'versions' is no object; a run's flags as JSON are expected")
    if config.get("algo") == "pid":  # as evaluate.py --pid leaves it
        if config.get("task") not in TASKS or not isinstance(config.get("gains"), str):
            fail(f"{path}: 'task' and 'gains' of the PID are expected, a task of {', '.join(TASKS)}")
        return config | {"quick": False}
    for key, kind in CONFIG.items():
        if key not in config:
            fail(f"{path}: no key {key!r}; {', '.join(CONFIG)} are expected")
        value, number = config[key], kind not in (str, bool)
        if not isinstance(value, kind) or (number and (isinstance(value, bool) or not 0 <= value < 1e12)):
            expected = {str: "text", int: "an integer >= 0", bool: "true or false"}.get(kind, "a number >= 0")
            fail(f"{path}: {key!r} is {value!r:.40}; {expected} is expected")
    return config


def read_trials(folder):
    """evaluation.csv of a run folder; {} where it was not evaluated."""
    path = folder / "evaluation.csv"
    if not (path.exists() or path.with_name("evaluation.csv.gz").exists()):
        return {}
    trials = read_csv(path, TRIALS)
    n = len(trials["trial"])
    if not n or not np.array_equal(trials["trial"], np.arange(n)) or not np.isin(trials["success"], (0, 1)).all():
        fail(f"{path}: garbled; trial 0, 1, 2, ... and success 0 or 1 are expected")
    return trials


def read_run(folder, config):
    if config["algo"] == "pid":
        return Run(folder, PID, ("pid", config["gains"], "", "", 0), 0, "", np.empty(0), read_trials(folder))
    episodes = read_csv(folder / "episodes.csv", ("episode", "return"))
    if not np.array_equal(episodes["episode"], np.arange(1, len(episodes["episode"]) + 1)):
        fail(f"{folder / 'episodes.csv'}: column episode is garbled; 1, 2, 3, ... is expected")
    done = read_csv(folder / "progress.csv", ("env_steps",))["env_steps"][-1:].sum()
    total = config["epochs"] * config["steps_per_epoch"]
    return Run(path=folder, column=(config["algo"], config["num_demos"], float(config["lambda_bc"])),
               group=(config["algo"], config["recipe"], config["symmetry"], config.get("variant", ""), total),
               seed=config["seed"],
               unfinished=f"{done:,.0f} of {total:,} environment steps" if done < total else "",
               returns=episodes["return"], trials=read_trials(folder))


def find_runs(task, named, mixed=False):
    """The runs of a task below the named folders (None: data/results, data/runs), and remarks to print; mixed: those of
    other tasks may be named too, and of this one none."""
    configs, remarks = {}, []
    for folder in map(Path, named or [RESULTS, RUNS]):
        found = {path.parent: read_config(path) for path in sorted(folder.resolve().rglob("config.json"))}
        if named and not found:
            fail(f"--runs {folder}: no run there; a folder that holds config.json, or holds such folders, is expected")
        if not mixed and named and folder.resolve() in found and found[folder.resolve()]["task"] != task:
            fail(f"--runs {folder}: a run of task {found[folder.resolve()]['task']}; only --task {task} is allowed")
        configs |= found  # by real path, so that a folder named twice counts once
    mine = {path: config for path, config in configs.items() if config["task"] == task}
    if named and not mine and not mixed:
        fail(f"--runs: no run of task {task} among the {len(configs)} found; --task may be {', '.join(TASKS)}")
    if quick := 0 if named else sum(config["quick"] for config in mine.values()):
        mine = {path: config for path, config in mine.items() if not config["quick"]}
        remarks.append(f"left out: {quick} --quick run(s); name their folders with --runs to see them")
    runs = {}
    for run in (read_run(path, config) for path, config in mine.items()):
        first = runs.setdefault((run.column, run.group, run.seed), run)
        if first is not run:  # twice: fine only where one is the copy in data/results of the other, or of its beginning
            published = [r for r in (first, run) if r.path.is_relative_to(RESULTS.resolve())]
            n = min(first.returns.size, run.returns.size)
            copied = published and first.path.name == run.path.name and not (first.returns[:n] != run.returns[:n]).any()
            if not copied and (named or len(published) != 1):
                fail(f"--runs: {first.path} and {run.path} are the same configuration and seed; one only is allowed")
            if copied:
                keep = max(*published, first, run, key=lambda r: r.returns.size)
            else:  # the same seed on another machine, or with other code: the own one, once it is finished
                keep, other = sorted((first, run), key=lambda r: (bool(r.unfinished), r in published))
                remarks.append(f"left out: {other.path}; {keep.path} is of the same configuration and seed")
            runs[run.column, run.group, run.seed] = keep
    empty = [run for run in runs.values() if not run.returns.size and run.column != PID]
    remarks += [f"left out: {run.path} has no episode yet" for run in empty]
    runs = [run for run in runs.values() if run not in empty]
    return runs, remarks + [f"unfinished: {run.path}, {run.unfinished}" for run in runs if run.unfinished]


def read_paper(kind, task):
    """The printed columns of a table: {(sweep, the value that it varies): {"num_demos", ..., "R10", ...}}."""
    path, texts = PAPER / f"{kind}_metrics.csv", ("task", "sweep", "num_demos", "lambda_bc", *METRICS[kind])
    table, columns = read_csv(path, (), texts + ("algo",) * (kind == "training")), {}
    for row in (dict(zip(table, row, strict=True)) for row in zip(*table.values(), strict=True)):
        if row["task"] == task:
            varied = {"lambda": "lambda_bc", "demos": "num_demos"}.get(row["sweep"])
            numbers = {metric: float(row[metric] or "nan") for metric in METRICS[kind]}  # T50 is blank for N/A
            columns[str(row["sweep"]), float(row[varied]) if varied else 0.0] = row | numbers
    return columns


def all_columns(kind, task, runs):
    """[{"sweep", "key": (algo, N_demos, lambda_BC), and the paper's numbers, NaN where it has none}]: the paper's
    columns in printed order, then one for each key of no printed one.

    The test table's columns are the training table's of the same sweep and value: for P2P-O's lambda sweep it prints
    N_demos = 100, but its lambda = 1 then contradicts its own N_demos = 100."""
    printed, training = read_paper(kind, task), read_paper("training", task)
    if unknown := printed.keys() - training.keys() - {("pid", 0.0)}:
        fail(f"{PAPER / f'{kind}_metrics.csv'}: column {unknown.pop()} is not one of training_metrics.csv")
    none = dict.fromkeys(METRICS[kind], math.nan)
    columns = [{"sweep": column[0], "key": (str(row["algo"]), int(row["num_demos"]), float(row["lambda_bc"])),
                **{metric: printed.get(column, none)[metric] for metric in none}} for column, row in training.items()]
    columns += [{"sweep": "pid", "key": PID, **row} for (sweep, _), row in printed.items() if sweep == "pid"]
    others = sorted({run.column for run in runs} - {column["key"] for column in columns} - {PID})
    return columns + [{"sweep": "other", "key": key, **none} for key in others]


def by_group(runs, column):
    """{group: its runs of this column}, in a fixed order."""
    mine = sorted((run for run in runs if run.column == column["key"]), key=lambda run: (run.group, run.seed))
    return {group: list(members) for group, members in groupby(mine, key=lambda run: run.group)}


def group_label(group):
    return " ".join(filter(None, group[:-1])) + f" {group[-1] / 1000:g}k steps" * bool(group[-1])


# ------------------------------------------------------------------------------------------ metrics

def running_mean(returns):
    """(n,) -> (n,): mean of the last 50 returns, of fewer where there are not yet 50."""
    return np.array([returns[max(0, i - WINDOW):i].mean() for i in range(1, len(returns) + 1)])


def training_metrics(returns):
    """The metrics of one seed (`sec:results`) from its returns (n,), n >= 1; T50 in episodes from 1, NaN for N/A."""
    tenth = math.ceil(len(returns) / 10)
    R10, R90 = returns[:tenth].mean(), returns[-tenth:].mean()
    above = np.flatnonzero(running_mean(returns)[WINDOW - 1:] > R90 / 2)  # full windows of 50 only
    return {"R10": R10, "R90": R90, "I_R": R90 - R10, "T50": above[0] + WINDOW if R90 > 0 and above.size else math.nan}


def test_metrics(trials):
    """The metrics of one seed (`Test Study`) from its evaluation.csv; NaN where no trial succeeded."""
    won = trials["success"] == 1
    return {"P_scs_percent": 100 * won.mean(), **{metric: trials[column][won].mean() if won.any() else math.nan
                                                  for metric, column in OF_SUCCESSFUL.items()}}


def interval(*samples, statistic=np.mean):
    """95 % bootstrap interval of statistic(*samples, axis=), by default the mean of one sample (seeds,): low, high,
    method; NaN, NaN, "" where a sample has fewer than two."""
    for method in ("BCa", "percentile") if min(map(len, samples)) > 1 else ():
        with warnings.catch_warnings(action="ignore"):  # BCa of equal values is NaN, and a warning
            low, high = bootstrap(samples, statistic, method=method, rng=np.random.default_rng(0)).confidence_interval
        if math.isfinite(low) and math.isfinite(high):
            return float(low), float(high), method
    return math.nan, math.nan, ""


def difference(a, b, axis=-1):
    return np.mean(a, axis=axis) - np.mean(b, axis=axis)


def over_trials(trials, metric):
    """95 % interval of a single seed's test metric: low, high, method."""
    won = trials["success"] == 1
    if metric == "P_scs_percent":
        low, high = binomtest(int(won.sum()), len(won)).proportion_ci(method="wilson")
        return 100 * low, 100 * high, "Wilson over trials"
    low, high, method = interval(trials[OF_SUCCESSFUL[metric]][won])
    return low, high, method + " over trials" * bool(method)


def over_seeds(values, paper, digits, of_one=(math.nan, math.nan, "")):
    """One cell of the table: values (seeds,), NaN for N/A, beside the paper's value, NaN for none; of_one: the interval
    where there is a single seed.

    `paper_outside` compares to the printed digits, so that the mark agrees with what the reader sees."""
    known = values[~np.isnan(values)]
    low, high, method = of_one if len(values) == 1 else interval(known)
    return {"paper": paper, "mean": known.mean() if known.size else math.nan, "low": low, "high": high,
            "interval": method, "na_seeds": len(values) - len(known), "values": known,
            "paper_outside": int(paper < round(low, digits) or paper > round(high, digits))}


def iqm(values):
    """Interquartile mean: the mean of the middle half (scipy's trim_mean, which is too slow for a bootstrap)."""
    cut = len(values) // 4
    return np.sort(values)[cut:len(values) - cut].mean()


def improvement(xs, ys):
    """P(X > Y), ties counting half, averaged over the strata: xs, ys are lists of (seeds,), one a column."""
    return np.mean([np.mean((x[:, None] > y) + 0.5 * (x[:, None] == y)) for x, y in zip(xs, ys, strict=True)])


def stratified(statistic, *groups, resamples=2000):
    """Value and 95 % percentile interval of statistic(*groups): a group is a list of (seeds,), one a column, and each
    column's seeds are drawn again among themselves (as rliable does)."""
    rng = np.random.default_rng(0)
    drawn = [statistic(*([rng.choice(x, len(x)) for x in group] for group in groups)) for _ in range(resamples)]
    return statistic(*groups), *np.quantile(drawn, (0.025, 0.975))


# ------------------------------------------------------------------------------------------ tables

def table_rows(kind, task, runs):
    """[(column, group, its runs, {metric: cell})] in the paper's order; group None where a column has no runs."""
    runs, rows = [run for run in runs if (run.returns.size if kind == "training" else run.trials)], []
    for column in all_columns(kind, task, runs):
        for group, members in (by_group(runs, column) or {None: []}).items():
            seeds = [training_metrics(run.returns) if kind == "training" else test_metrics(run.trials)
                     for run in members]
            cells = {}
            for metric, digits in METRICS[kind].items():
                single = (over_trials(members[0].trials, metric),) if kind == "test" and len(members) == 1 else ()
                cells[metric] = over_seeds(np.array([seed[metric] for seed in seeds]), column[metric], digits, *single)
            rows.append((column, group, members, cells))
    return rows


def printed(value, digits):
    return f"{value:6.{digits}f}" if math.isfinite(value) else "   N/A"


def cell_text(cell, digits):
    ends = f" [{cell['low']:.{digits}f}, {cell['high']:.{digits}f}]" if cell["interval"] else " [-]"
    not_reached = f" ({cell['na_seeds']} N/A)" if cell["na_seeds"] else ""
    return printed(cell["mean"], digits) + ends + not_reached + " *" * cell["paper_outside"]


def table_lines(kind, rows):
    """The table as lines of cells, all of one length; the first is the heading, an empty one stands between sweeps."""
    metrics, above = METRICS[kind], {}
    lines = [("sweep", "N_demos", "lambda_BC", "", *("   " + metric for metric in metrics), "seeds")]
    for column, group, members, cells in rows:
        if column is not above:
            new, unprinted = column["sweep"] != above.get("sweep"), all(math.isnan(column[m]) for m in metrics)
            N, lam = ("", "") if column["key"] == PID else (str(column["key"][1]), f"{column['key'][2]:g}")
            lines += [("",) * len(lines[0])] * new
            lines.append((SWEEPS[column["sweep"]] if new else "", N, lam,
                          "not in the paper's table" if unprinted else "paper",
                          *("" if unprinted else printed(column[m], digits) for m, digits in metrics.items()), ""))
        unfinished = sum(bool(run.unfinished) for run in members)
        lines.append(("", "", "", group_label(group), *(cell_text(cells[m], digits) for m, digits in metrics.items()),
                      f"{len(members)}" + f" ({unfinished} unfinished)" * bool(unfinished)) if group else
                     ("", "", "", "no runs", *[""] * len(metrics), ""))
        above = column
    return lines


def table_notes(kind, task, rows):
    """(title, notes): what stands above and below the table, as lines of text."""
    title = (f"{TASKS[task]}, {kind} metrics ({LABELS[kind][task]}): the paper's, and ours as the mean over seeds "
             "[95 % bootstrap interval over seeds]")
    notes = ["*      the paper's value lies outside our interval"]
    if kind == "training":
        notes += ["[-]    no interval: fewer than two seeds",
                  "(N/A)  seeds without a T50 (R90 <= 0, or never exceeded); they are not in the mean"]
    else:
        notes += ["With one seed the interval is over its trials (P_scs: Wilson's), and knows nothing of other seeds.",
                  "T_eff is in percent of the largest possible effort."]
    return title, [*notes, "", *undecided(kind, rows), *(["", *comparison(rows)] if kind == "training" else [])]


def undecided(kind, rows):
    """Lines: the pairs of columns, of one sweep or with the baseline, that the paper ranks by the table's main metric
    and whose difference in our seeds has an interval that contains 0."""
    metric, digits = RANKED[kind], METRICS[kind][RANKED[kind]]
    lines, few, seen = [], 0, set()
    for (one, group, _, ours), (other, its_group, _, theirs) in combinations(rows, 2):
        pair = group, frozenset((one["key"], other["key"]))
        ranked = abs(one[metric] - other[metric]) > 0  # not where either is NaN
        compared = one["sweep"] == other["sweep"] or "baseline" in (one["sweep"], other["sweep"])
        if group is None or group != its_group or pair in seen or not ranked or not compared:
            continue
        seen.add(pair)
        low, high, method = interval(ours[metric]["values"], theirs[metric]["values"], statistic=difference)
        few += not method
        if method and low <= 0 <= high:
            names = [f"N_demos={N} lambda_BC={lam:g}" for _, N, lam in (one["key"], other["key"])]
            gap = ours[metric]["mean"] - theirs[metric]["mean"]
            lines.append(f"  {names[0]} and {names[1]}: the paper's {one[metric]:g} and {other[metric]:g}, our "
                         f"difference {gap:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}] ({group_label(group)})")
    head = f"Pairs that the paper's {metric} ranks but our seeds cannot tell apart (95 % interval contains 0):"
    return [head, *(lines or ["  none"])] + [f"  not compared: {few} pairs with fewer than two seeds"] * bool(few)


def comparison(rows):
    """Lines: groups compared over the seeds of all columns that have two or more, after Agarwal et al. (2021)."""
    metrics, values = {"R90": 2, "P_scs_percent": 1}, {}  # {(metric, group): {column key: (seeds,)}}
    for column, group, members, cells in rows:
        tested = [test_metrics(run.trials)["P_scs_percent"] for run in members if run.trials]
        for metric, seeds in zip(metrics, (cells["R90"]["values"], np.array(tested)), strict=True):
            if len(seeds) > 1:
                values.setdefault((metric, group), {})[column["key"]] = seeds
    lines = []
    for metric, digits in metrics.items():
        groups = {group: columns for (name, group), columns in values.items() if name == metric}
        for group, columns in groups.items():
            pooled = list(columns.values())
            middle, low, high = stratified(lambda strata: iqm(np.concatenate(strata)), pooled)
            lines.append(f"  {group_label(group)}: {metric} mean {np.mean(np.concatenate(pooled)):.{digits}f}, IQM "
                         f"{middle:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}], {sum(map(len, pooled))} runs in "
                         f"{len(pooled)} column(s)")
        for (one, ours), (other, theirs) in combinations(groups.items(), 2):
            if both := [key for key in ours if key in theirs]:
                p, low, high = stratified(improvement, [ours[key] for key in both], [theirs[key] for key in both])
                lines.append(f"  P({group_label(one)} > {group_label(other)}) in {metric}: {p:.2f} [{low:.2f}, "
                             f"{high:.2f}], {len(both)} column(s)")
    head = ("Groups over the seeds of all columns with two or more: mean, interquartile mean (IQM) and probability of "
            "improvement [95 % stratified bootstrap interval]:")
    return [head, *(lines or ["  no column with two seeds"])]


def table_text(kind, task, rows):
    """The table as aligned text."""
    lines, (title, notes) = table_lines(kind, rows), table_notes(kind, task, rows)
    widths = [max(map(len, texts)) for texts in zip(*lines, strict=True)]
    return "\n".join([title, "", *("  ".join(map(str.ljust, line, widths)).rstrip() for line in lines), "", *notes])


def table_latex(kind, task, rows):
    """The table for booktabs, the notes as comments."""
    def tex(text):
        text = "".join(SYMBOLS.get(word, re.sub(r"([%&_])", r"\\\1", word)) for word in re.split("( +)", text.strip()))
        return re.sub(" +", " ", text)

    (head, *lines), (title, notes) = table_lines(kind, rows), table_notes(kind, task, rows)
    body = ["\\midrule" if not any(line) else " & ".join(map(tex, line)) + r" \\" for line in lines]
    return "\n".join([*(f"% {note}".rstrip() for note in notes), r"\begin{table}[htbp]", r"\centering\footnotesize",
                      rf"\caption{{{tex(title)}; * the paper's value lies outside our interval}}",
                      rf"\label{{{LABELS[kind][task]}-ours}}", rf"\begin{{tabular}}{{@{{}}{'l' * len(head)}@{{}}}}",
                      r"\toprule", " & ".join(map(tex, head)) + r" \\", *body, r"\bottomrule", r"\end{tabular}",
                      r"\end{table}", ""])


def table_csv(task, rows):
    """The table as CSV text, one line a column, group and metric; blank where there is no number."""
    out = io.StringIO()
    writer = csv.DictWriter(out, CSV_HEADER, restval="", extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    for column, group, members, cells in rows:
        about = dict(zip(("task", "sweep", "algo", "num_demos", "lambda_bc"), (task, column["sweep"], *column["key"]),
                         strict=True))
        about |= dict(zip(("algo", "recipe", "symmetry", "variant", "total_env_steps"), group or (), strict=False))
        about |= {"seeds": len(members), "unfinished_seeds": sum(bool(run.unfinished) for run in members)}
        for metric, cell in cells.items():
            numbers = {k: round(v, 6) for k, v in cell.items() if isinstance(v, float) and v == v}  # NaN is blank
            writer.writerow(about | {"metric": metric} | {k: cell[k] for k in ("interval", "na_seeds", "paper_outside")}
                            | numbers)
    return out.getvalue()


# ------------------------------------------------------------------------------------------ figures

def column_label(column, algo):
    """What the paper varies in this column; algo: of the task's printed columns."""
    name, N, lam = column["key"]
    both = rf"$N_{{demos}}={N}$, $\lambda_{{BC}}={lam:g}$"
    return {"lambda": both.split(", ")[1], "demos": both.split(", ")[0], "baseline": name.upper(),
            "other": both if name == algo else f"{name.upper()}, {both}"}[column["sweep"]]


def groups_of(runs):
    """The groups, that with the most runs first: it gets the solid line and the first colour."""
    return [group for group, _ in Counter(sorted(run.group for run in runs)).most_common()]


def draw_curve(ax, runs, colour, dashes, label):
    """Mean over seeds and its band as far as every seed goes; then a thin line, the mean of those that go on."""
    curves = [running_mean(run.returns) for run in runs]
    every, longest = min(map(len, curves)), max(map(len, curves))
    curves = np.array([np.pad(curve, (0, longest - len(curve)), constant_values=np.nan) for curve in curves])
    episode, mean = np.arange(1, longest + 1), np.nanmean(curves, axis=0)
    start = min(9, every // 2)  # the mean of one or two returns is noise that would set the scale of the axis
    ax.plot(episode[start:every], mean[start:every], color=colour, linestyle=dashes, linewidth=1.3, label=label)
    ax.plot(episode[every - 1:], mean[every - 1:], color=colour, linestyle=dashes, linewidth=0.6, alpha=0.7)
    if len(runs) > 1:
        low, high = bootstrap((curves[:, start:every],), np.mean, axis=0, method="percentile", n_resamples=1000,
                              batch=100, rng=np.random.default_rng(0)).confidence_interval
        ax.fill_between(episode[start:every], low, high, color=colour, alpha=0.18, linewidth=0)


def draw_panel(ax, sweep, columns, runs, groups):
    """One sweep of the paper and the baseline; runs of no printed column are in both panels, under both values."""
    colours = iter(COLOURS * len(columns))
    for column in (column for column in columns if column["sweep"] in (sweep, "baseline", "other")):
        label = column_label(column, columns[0]["key"][0])
        colour = GREY if column["sweep"] == "baseline" else next(colours)
        mine = sorted(by_group(runs, column).items(), key=lambda item: groups.index(item[0]))
        seeds = " + ".join(str(len(members)) for _, members in mine)
        unfinished = sum(bool(run.unfinished) for _, members in mine for run in members)
        label += f" ({seeds} seed{'s' * (seeds != '1')}{f', {unfinished} unfinished' if unfinished else ''})"
        for i, (group, members) in enumerate(mine):
            draw_curve(ax, members, colour, DASHES[groups.index(group) % len(DASHES)], label if i == 0 else None)
        if mine and math.isfinite(column["R90"]):
            ax.axhline(column["R90"], color=colour, linestyle=":", linewidth=0.8, zorder=1)


def mark_gap(ax, drawn):
    """Says in the middle of an empty panel that there are no runs for it."""
    draw_text = ax.text2D if ax.name == "3d" else ax.text
    draw_text(0.5, 0.5, "" if drawn else "no runs", ha="center", va="center", color="#777777", transform=ax.transAxes)


def learning_figure(task, runs):
    """Figures fig:p2p_hyp, fig:p2p_obs_hyp, fig:pnp_hyp: a Figure at column width with one panel a sweep."""
    runs = [run for run in runs if run.returns.size]
    columns, groups = all_columns("training", task, runs), groups_of(runs)
    keys = {column["sweep"]: column["key"] for column in columns}
    titles = {"lambda": rf"{TASKS[task]}: effect of $\lambda_{{BC}}$ at $N_{{demos}}={keys['lambda'][1]}$",
              "demos": rf"{TASKS[task]}: effect of $N_{{demos}}$ at $\lambda_{{BC}}={keys['demos'][2]:g}$"}
    figure = Figure(figsize=(3.6, 5.6), layout="constrained")
    for ax, (sweep, title) in zip(figure.subplots(2, sharex=True, sharey=True), titles.items(), strict=True):
        draw_panel(ax, sweep, columns, runs, groups)
        ax.set_ylabel(f"return (mean of last {WINDOW} episodes)")
        drawn, _ = ax.get_legend_handles_labels()
        ax.legend(handles=drawn, title=title, title_fontsize=8.5, ncols=2, loc="lower center", bbox_to_anchor=(0.5, 1))
        mark_gap(ax, drawn)
    ax.set(xlabel="episode", xlim=(0, None))  # shared; after both panels, for it ends autoscaling
    lines = [Line2D([], [], color="k", linestyle=DASHES[i % len(DASHES)], linewidth=1.3, label=group_label(group))
             for i, group in enumerate(groups)]
    lines.append(Line2D([], [], color="k", linestyle=":", linewidth=0.8, label=r"the paper's $\overline{R}_{90}$"))
    figure.legend(handles=lines, loc="outside lower center", ncols=2, title=(
        "mean over seeds and 95 % band (percentile bootstrap over seeds);\n"
        "thin: mean of the seeds that go on after the shortest has ended"
        + ";\na + b seeds: of the lines below, in their order" * (len(groups) > 1)))
    return figure


def error_figure(task, runs):
    """Figures fig:p2p_errors, fig:p2po_errors, fig:pnp_errors: ||e_t|| over the successful test trials, a panel for
    each of the paper's six columns. A trial that has ended keeps its last error: each counts alike at every t."""
    runs = [run for run in runs if run.column != PID and (run.path / "trajectories.npz").exists()]
    columns, groups = all_columns("test", task, runs), groups_of(runs)
    figure = Figure(figsize=(3.6, 4.8), layout="constrained")
    panels = figure.subplots(3, 2, sharex=True, sharey=True)
    for side, sweep, fixed in ((0, "lambda", 0), (1, "demos", 1)):
        mine = [column for column in columns if column["sweep"] == sweep]
        others = column_label(mine[-1] | {"sweep": "other"}, mine[-1]["key"][0]).split(", ")
        for ax, column in zip(panels[:, side], mine, strict=True):
            drawn = False
            for group, members in by_group(runs, column).items():
                errors = [error for run in members for error in read_errors(run.path / "trajectories.npz")]
                if not errors:
                    continue
                drawn, longest = True, max(map(len, errors))
                errors = 100 * np.array([np.pad(error, (0, longest - len(error)), mode="edge") for error in errors])
                t, mean, deviation = TIME_STEP * np.arange(longest), errors.mean(axis=0), errors.std(axis=0)
                colour = COLOURS[groups.index(group) % len(COLOURS)]
                ax.fill_between(t, np.maximum(mean - deviation, 0), mean + deviation, color=colour, alpha=0.2, lw=0)
                ax.plot(t, mean, color=colour, linewidth=1.2)
            ax.axhline(100 * EPSILON, color="k", linestyle=":", linewidth=0.8)
            ax.set_title(f"{column_label(column, None)} ({others[fixed]})")
            mark_gap(ax, drawn)
    panels[0, 0].set(xlim=(0, None), ylim=(0, None))
    for ax in figure.axes:
        ax.set(xlabel="$t$ (s)", ylabel=r"$\Vert e_t\Vert$ (cm)")
        ax.label_outer()
    lines = [Line2D([], [], color=COLOURS[i % len(COLOURS)], label=group_label(g)) for i, g in enumerate(groups)]
    lines.append(Line2D([], [], color="k", linestyle=":", linewidth=0.8, label=r"$\epsilon=5$ cm"))
    figure.legend(handles=lines, loc="outside lower center", ncols=2, title=(
        f"{TASKS[task]}: mean $\\pm$ standard deviation over all successful test trials;\n"
        "a trial that has ended keeps its last error"))
    return figure


def draw_ring(ax, borders):
    """The workspace from above: the tube of reachable rho and the sectors' borders (their angles, rad)."""
    circle = np.linspace(0, 2 * math.pi, 181)
    for rho in (INNER, OUTER):
        ax.plot(rho * np.cos(circle), rho * np.sin(circle), color=GREEN, linewidth=0.8)
    for theta in borders:
        ax.plot([INNER * math.cos(theta), OUTER * math.cos(theta)], [INNER * math.sin(theta), OUTER * math.sin(theta)],
                color=GREY, linewidth=0.8, linestyle=BORDER)
    ax.set(aspect="equal", xlabel="$x$ (m)", ylabel="$y$ (m)", xticks=[-0.5, 0, 0.5], yticks=[-0.5, 0, 0.5])


def draw_paths(figure, task, paths, title):
    """TCP paths of `read_paths` from above and in 3-D, in the tube of reachable positions; the colour is the goal's."""
    first = -math.pi / 4 if task == "p2p" else 0.0  # the centre of S_1: its sector's start angle (sec:exp)
    borders = first + math.pi / 4 + math.pi / 2 * np.arange(4)
    circle, corners = np.linspace(0, 2 * math.pi, 181), np.array([INNER, OUTER, OUTER, INNER, INNER])
    above, space = figure.add_subplot(1, 2, 1), figure.add_subplot(1, 2, 2, projection="3d")
    draw_ring(above, borders)
    for rho, z in product((INNER, OUTER), (LOW, HIGH)):
        space.plot(rho * np.cos(circle), rho * np.sin(circle), z, color=GREEN, linewidth=0.6, alpha=0.8)
    for k, theta in enumerate(borders):
        space.plot(corners * math.cos(theta), corners * math.sin(theta), [LOW, LOW, HIGH, HIGH, LOW], color=GREY,
                   linewidth=0.6, linestyle=BORDER)
        above.text(0.2 * math.cos(theta - math.pi / 4), 0.2 * math.sin(theta - math.pi / 4),
                   rf"$\mathcal{{S}}_{k + 1}$", ha="center", va="center", color=COLOURS[k])
    for path in paths:
        k = round((math.atan2(path["goal"][1], path["goal"][0]) - first) / (math.pi / 2)) % 4
        for ax, n in ((above, 2), (space, 3)):
            ax.plot(*path["tcp"].T[:n], color=COLOURS[k], linewidth=0.9, alpha=0.85)
            ax.plot(*path["tcp"][:1].T[:n], "o", color="k", markersize=3)
            ax.plot(*path["goal"][:n, None], "*", color=COLOURS[k], markersize=6, markeredgecolor="k",
                    markeredgewidth=0.3)
            ax.plot(*path["object"][:n, None], "s", color="#888888", markersize=3, zorder=1)  # NaN: nothing
    space.text2D(0.98, 0.8, "$z$ (m)", ha="right", transform=space.transAxes)  # zlabel would be cut off
    space.set(xlabel="$x$ (m)", ylabel="$y$ (m)", xticks=[-0.5, 0, 0.5], yticks=[-0.5, 0, 0.5],
              zticks=[0.2, 0.4, 0.6], xlim=(-OUTER, OUTER), ylim=(-OUTER, OUTER), zlim=(0.15, 0.75))
    space.set_box_aspect((1.4, 1.4, 0.6), zoom=1.0)
    space.view_init(elev=28, azim=-60)
    space.tick_params(pad=-2)
    for ax in (above, space):
        mark_gap(ax, paths)
    figure.suptitle(f"{TASKS[task]}: {title}", fontsize=8.5)
    marks = [("o", "k", "start"), ("*", "#FFFFFF", "goal")]
    marks += [("s", "#888888", "obstacle" if task == "p2po" else "cube")] * (task != "p2p")
    lines = [Line2D([], [], linestyle="", marker=marker, color=colour, markeredgecolor="k", markeredgewidth=0.4,
                    markersize=5, label=label) for marker, colour, label in marks]
    lines += [Line2D([], [], color=GREEN, linewidth=0.8, label=r"reachable $\rho$, $z$"),
              Line2D([], [], color=GREY, linewidth=0.8, linestyle=BORDER, label=r"border of $\mathcal{S}_k$")]
    figure.legend(handles=lines, loc="outside lower center", ncols=len(lines))
    return figure


def demos_figure(task, runs):
    """Figure fig:demo: the first 20 successful demonstrations in data/results."""
    file = RESULTS / f"demos-{task}.npz"
    paths = [path for path in (read_paths(file) if file.exists() else []) if path["success"]][:20]
    return draw_paths(Figure(figsize=(5.4, 3.1), layout="constrained"), task, paths, "demonstrations")


def trajectories_figure(task, runs):
    """Figure fig:ease: the successful ones of the first 20 test trials of the run with the highest P_scs."""
    runs = [run for run in runs if run.trials and (run.path / "trajectories.npz").exists() and run.column != PID]
    best = max(runs, key=lambda run: run.trials["success"].mean(), default=None)
    paths = [path for path in (read_paths(best.path / "trajectories.npz") if best else []) if path["success"]]
    title = "successful test trials" + (f", {group_label(best.group)}, seed {best.seed}" if best else "")
    return draw_paths(Figure(figsize=(5.4, 3.1), layout="constrained"), task, paths, title)


def random_paths(rng, n, sectors, K):
    """n 2-D paths as fig:partitions has them: a random way point (theta, rho) in each of these sectors out of K, linear
    in between in cylinder coordinates. Returns (n, M, 2) points x, y in m; every 50th is a way point."""
    t = np.linspace(0, len(sectors) - 1, 50 * (len(sectors) - 1) + 1)
    weight = np.maximum(0, 1 - np.abs(t - np.arange(len(sectors))[:, None]))  # of each way point at each t
    theta = 2 * math.pi / K * (np.asarray(sectors) + rng.random((n, len(sectors)))) @ weight
    rho = rng.uniform(INNER, OUTER, (n, len(sectors))) @ weight
    return np.stack([rho * np.cos(theta), rho * np.sin(theta)], axis=-1)


def path_lengths(K, n=1000, seed=0):
    """Lengths (n,) in m of random demonstrations, from a point of a sector to another of the same, and of random
    regular paths, from one sector to the furthest opposite one with a way point in each between. K = 1: the same."""
    rng = np.random.default_rng(seed)
    demos, regular = (np.linalg.norm(np.diff(random_paths(rng, n, sectors, K), axis=1), axis=2).sum(axis=1)
                      for sectors in ([0, 0], range(K // 2 + 1)))
    return demos, demos if K == 1 else regular


def partitions_figure(task=None, runs=None):
    """Figure fig:partitions: left the paths at K = 4, right their lengths over K = 1 ... 12."""
    figure = Figure(figsize=(5.4, 2.6), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1, 1.3))
    rng = np.random.default_rng(3)
    draw_ring(left, math.pi / 2 * np.arange(4))
    for colour, label, routes in ((COLOURS[0], r"demonstrations $\tau^d$", [[k, k] for k in (0, 1, 2, 3) * 2]),
                                  (COLOURS[1], r"regular paths $\tau$", [range(3), range(2, 5)])):
        left.plot([], [], color=colour, label=label)
        for sectors in routes:
            path, = random_paths(rng, 1, sectors, 4)
            left.plot(*path.T, color=colour, linewidth=1.2)
            left.plot(*path[:-1:50].T, "o", color=colour, markersize=2.5)
            left.plot(*path[-1], "*", color=colour, markersize=6)
    left.legend(loc="lower center", bbox_to_anchor=(0.5, 1), ncols=2, columnspacing=0.8, handlelength=1.4)
    K, lengths = np.arange(1, 13), [path_lengths(K) for K in range(1, 13)]
    for colour, marker, label, curves in (
            (COLOURS[0], "o", r"$L(\tau^d)/R$", [demo / OUTER for demo, _ in lengths]),
            (COLOURS[1], "s", r"$L(\tau^d)/L(\tau)$", [demo / path.mean() for demo, path in lengths])):
        right.plot(K, [curve.mean() for curve in curves], color=colour, marker=marker, markersize=3, linewidth=1.2,
                   label=label)
        right.fill_between(K, *np.transpose([np.quantile(curve, (0.25, 0.75)) for curve in curves]), color=colour,
                           alpha=0.18, linewidth=0)
    right.axvspan(3.6, 4.4, color="#CC79A7", alpha=0.3, linewidth=0, label="$K=4$")
    right.set(xlabel="number of partitions $K$", ylabel="length", xticks=K, ylim=(0, None))
    right.legend(title="mean and middle half\nof 1,000 random paths")
    return figure


def workspace_figure(task=None, runs=None):
    """Figure fig:workspace: the arm in the tube of reachable rho and z, which is drawn over PyBullet's picture."""
    import gymnasium

    from kinova_env import ACTIVE_JOINTS, pybullet
    from kinova_env import TASKS as ENVS

    env = gymnasium.make(ENVS["p2p"].env_id, render_mode="rgb_array", disable_env_checker=True).unwrapped
    env.reset(seed=0, options={"start": (-math.pi / 4, 0.52, 0.42), "goal": (2.4, 0.6, 0.5)})
    width, height, client = 1200, 1000, env._client
    view = pybullet.computeViewMatrixFromYawPitchRoll([0, 0, 0.3], 2.0, 20, -20, 0, 2)
    lens = pybullet.computeProjectionMatrixFOV(42, width / height, 0.1, 5)
    *_, rgba, depth, link = pybullet.getCameraImage(
        width, height, view, lens, lightDirection=[0.6, -0.8, 1.6], renderer=pybullet.ER_TINY_RENDERER,
        physicsClientId=client)
    robot = np.reshape(link, (height, width)) == env._robot
    image = np.reshape(rgba, (height, width, 4)).astype(np.uint8)
    joints = {joint: pybullet.getLinkState(env._robot, joint, physicsClientId=client)[4] for joint in ACTIVE_JOINTS}
    env.close()
    camera = np.reshape(lens, (4, 4)).T @ np.reshape(view, (4, 4)).T

    def pixels(points):
        clip = np.column_stack((points, np.ones(len(points)))) @ camera.T
        return (clip[:, :2] / clip[:, 3:] * (0.5, -0.5) + 0.5) * (width, height)

    figure = Figure(figsize=(3.6, 2.3), layout="constrained")
    ax = figure.add_subplot()
    arm = np.where(robot[..., None], image, 0)
    arm[..., 3] = 255 * robot
    ax.imshow(arm, zorder=2)
    theta = np.linspace(0, 2 * math.pi, 73)
    to_camera = math.radians(20 - 90)  # azimuth of the camera, seen from the base
    for radius in (INNER, OUTER):
        for a, b in zip(theta[:-1], theta[1:], strict=True):
            over = radius == OUTER and math.cos((a + b) / 2 - to_camera) > 0
            corners = [(radius * math.cos(angle), radius * math.sin(angle), z)
                       for angle, z in ((a, LOW), (b, LOW), (b, HIGH), (a, HIGH))]
            x, y = pixels(np.array(corners)).T
            ax.fill(x, y, color=GREEN, alpha=0.12, linewidth=0, zorder=3 if over else 1)
            for i in (0, 2):
                ax.plot(x[i:i + 2], y[i:i + 2], color="#00664B", linewidth=0.8, zorder=3 if over else 1)
    for n, joint in enumerate(ACTIVE_JOINTS, start=1):
        x, y = pixels(np.array([joints[joint]]))[0]
        ax.annotate(f"#{n}", (x, y), (x - 170, y - 40), va="center", ha="right", fontsize=7.5, zorder=5,
                    arrowprops={"arrowstyle": "-", "linewidth": 0.6})
    ax.set(xlim=(70, width - 70), ylim=(height - 160, 190))
    ax.axis("off")
    ax.set_title(rf"${INNER}\leq\rho<{OUTER}$ m,  ${LOW}\leq z<{HIGH}$ m", y=-0.02, color="#00664B")
    return figure


DRAW = {"learning": learning_figure, "error": error_figure, "partitions": partitions_figure, "demos": demos_figure,
        "trajectories": trajectories_figure, "workspace": workspace_figure}
OF_NO_TASK = ("partitions", "workspace")


def save_figure(flag, name, task, runs, paths):
    with matplotlib.rc_context(LOOK):  # some texts come into being while it is drawn
        figure = DRAW[name](task, runs)
        for path in paths:
            stable = {"CreationDate": None} if path.suffix == ".pdf" else {}
            write(flag, path, lambda temporary, stable=stable: figure.savefig(temporary, dpi=200, metadata=stable))
            figure.set_layout_engine("none")  # laid out once is enough


# ------------------------------------------------------------------------------------------ publishing

def without_folders(value):
    """A JSON value whose texts have lost their folders: no path of a machine is published."""
    if isinstance(value, dict):
        return {key: without_folders(item) for key, item in value.items()}
    if isinstance(value, list):
        return [without_folders(item) for item in value]
    return "=".join(Path(part).name for part in value.split("=")) if isinstance(value, str) and "/" in value else value


def check_whole(run, config):
    """Exits with 2 and a line that names the run where it is of no clean commit or its files do not fit together."""
    commit = str(config.get("versions", {}).get("git_commit"))
    if run.column != PID and not re.fullmatch("[0-9a-f]{40}", commit):
        fail(f"--publish {run.path}: made with git commit {commit!r}; a clean one of 40 hex digits is expected")
    if run.column != PID:
        episodes = read_csv(run.path / "episodes.csv", ("env_steps", "length"))
        progress = read_csv(run.path / "progress.csv", ("epoch", "env_steps"))
        steps, last = episodes["env_steps"], progress["env_steps"][-1:].sum()
        # an episode may be under way at the end of the last epoch, and a killed run has episodes after it
        around = episodes["length"].max(initial=0) + config.get("max_ep_len", 1000), config["steps_per_epoch"]
        if not (np.array_equal(steps, np.cumsum(episodes["length"])) and len(steps)
                and np.array_equal(progress["epoch"], np.arange(1, len(progress["epoch"]) + 1))
                and last - around[0] <= steps[-1] <= last + around[1]):
            fail(f"--publish {run.path}: episodes.csv and progress.csv do not fit together; a run's own are expected")
    if (run.path / "trajectories.npz").exists():
        trials = read_npz(run.path / "trajectories.npz", ("length", "success"))
        read_errors(run.path / "trajectories.npz"), read_paths(run.path / "trajectories.npz")
        if not run.trials or any(not np.array_equal(trials[name], run.trials[name]) for name in trials):
            fail(f"--publish {run.path}: trajectories.npz is not of evaluation.csv's trials; run evaluate.py again")
    elif run.column == PID and not run.trials:
        fail(f"--publish {run.path}: no evaluation.csv; run evaluate.py --pid first")


def files_of_run(folder):
    """What --publish writes of a run: (RESULTS/NAME, {file name: bytes}); exits with 2 where it is not whole, or of no
    clean commit."""
    config = read_config(folder / "config.json")
    run = read_run(folder, config)
    check_whole(run, config)
    config = without_folders({key: value for key, value in config.items() if run.column != PID or key != "quick"})
    config |= {"data_dir": "data/runs"} if run.column != PID else {}
    files = {"config.json": json.dumps(config, indent=1).encode()}
    for name in ("episodes.csv", "progress.csv", "evaluation.csv"):
        for path in (folder / name, folder / f"{name}.gz"):
            if path.exists() and name + ".gz" not in files:
                data = path.read_bytes() if path.suffix == ".csv" else gzip.decompress(path.read_bytes())
                files[name + ".gz"] = gzip.compress(data, mtime=0)  # the same bytes each time
    for name in ("trajectories.npz", "policy.pt"):
        if (folder / name).exists():
            files[name] = (folder / name).read_bytes()
    if "policy.pt" in files:
        try:
            logx.load_torch(folder / "policy.pt")
        except ValueError as error:
            fail(f"--publish {error}; weights alone are expected")
    elif run.column != PID and not folder.resolve().is_relative_to(RESULTS.resolve()):
        fail(f"--publish {folder}: no policy.pt; a run with a checkpoint is expected")
    return RESULTS / folder.resolve().name, files


def put_run(target, files):
    """Puts a run in place of what is there."""
    temporary = RESULTS / f".{target.name}.part"
    shutil.rmtree(temporary, ignore_errors=True)
    for name, data in reversed(files.items()):  # config.json last: without it, half a copy is no run
        write("--publish", temporary / name, lambda path, data=data: path.write_bytes(data))
    shutil.rmtree(target, ignore_errors=True)
    os.replace(temporary, target)


def files_of_demos(path, episodes=40):
    """What --publish writes of a demonstration file: (RESULTS/demos-TASK.npz, its bytes), the TCP paths of the first
    episodes for `read_paths`; exits with 2 where it is none."""
    file = read_npz(path, ("obs", "obs2", "length", "partition", "success", "meta"))
    try:
        task, length = json.loads(str(file["meta"]))["task"], file["length"][:episodes]
        states = [np.concatenate((file["obs"][end - n:end], file["obs2"][end - 1:end]))
                  for n, end in zip(length, np.cumsum(length), strict=True)]
        cube = np.array([s[0, 22:25] if s.shape[1] == 25 else [np.nan] * 3 for s in states], np.float32)
        arrays = {"tcp": np.concatenate([s[:, 16:19] - s[:, 19:22] for s in states]),  # P_e = P_g - e
                  "goal": np.array([s[0, 16:19] for s in states]), "object": cube, "length": length,
                  "partition": file["partition"][:episodes], "success": file["success"][:episodes]}
        if task not in TASKS or len(arrays["tcp"]) != np.sum(length + 1):
            raise ValueError("its arrays do not fit together")
    except (IndexError, KeyError, TypeError, ValueError) as error:
        fail(f"--publish {path}: not a demonstration file of pid_demo.py --record ({error})")
    out = io.BytesIO()
    np.savez_compressed(out, **arrays)
    return RESULTS / f"demos-{task}.npz", out.getvalue()


def index_row(run, config):
    """A line of index.csv."""
    row = {key: config.get(key, "") for key in INDEX_HEADER}
    row |= {"name": run.path.name, "git_commit": config.get("versions", {}).get("git_commit", "")}
    if run.column == PID:
        row |= {"recipe": config["gains"], "finished": 1}
    else:
        progress = read_csv(run.path / "progress.csv", ("env_steps",), ("eval_success",))
        measured = [value for value in progress["eval_success"] if value]
        row |= {"env_steps": int(progress["env_steps"][-1:].sum()), "finished": int(not run.unfinished),
                "eval_success": measured[-1] if measured else ""}
    return row | {"P_scs_percent": f"{test_metrics(run.trials)['P_scs_percent']:g}" if run.trials else ""}


def publish(sources):
    """Copies run folders (and demonstration files) into data/results and writes its index.csv. Returns remarks."""
    found = [files_of_demos(path) if path.suffix == ".npz" else files_of_run(path) for path in sources]  # or ends here
    for target, files in found:
        if isinstance(files, dict):
            put_run(target, files)
        else:
            write("--publish", target, lambda path, files=files: path.write_bytes(files))
    configs = {path.parent: read_config(path) for path in sorted(RESULTS.glob("[!.]*/config.json"))}
    rows = [index_row(read_run(folder, config), config) for folder, config in configs.items()]
    best = {}  # the run of each task and recipe that keeps its weights
    for row in rows:
        folder = RESULTS / row["name"]
        if not (folder / "policy.pt").exists() or configs[folder]["quick"]:
            continue
        best.setdefault((row["task"], row["recipe"]), []).append((-float(row["P_scs_percent"] or -1), row["name"]))
    kept = [RESULTS / min(names)[1] / "policy.pt" for names in best.values()]
    for path in set(RESULTS.glob("*/policy.pt")) - set(kept):
        path.unlink()
    size = sum(path.stat().st_size for path in kept)
    out = io.StringIO()
    writer = csv.DictWriter(out, INDEX_HEADER, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write("--publish", RESULTS / "index.csv", lambda path: path.write_text(out.getvalue(), encoding="utf-8"))
    return [*(f"published {target}" for target, _ in found), f"wrote {RESULTS / 'index.csv'}, {len(rows)} runs",
            *[f"the policies there take {size / 1e6:.1f} MB: much for a repository"] * (size > 10e6)]


# ------------------------------------------------------------------------------------------ main

def missing(task, runs):
    """The commands that fill the gaps in a task's tables and figures, as lines to print."""
    have, lines = {run.column for run in runs if run.returns.size}, []
    gaps = {column["key"]: column for column in reversed(all_columns("training", task, runs))}  # a key's first column
    value = {"lambda": lambda key: f"={key[2]:g}", "demos": lambda key: f"={key[1]}", "baseline": lambda key: ""}
    words = [column["sweep"] + value[column["sweep"]](key) for key, column in reversed(gaps.items()) if key not in have]
    if words:
        recipe = next((group[1] for group in groups_of(runs) if group[0] != "pid"), "robust")
        lines.append(f"python sweep.py --task {task} --recipe {recipe} --columns {' '.join(words)} --seeds 5 --jobs 2")
    untested = [f"data/runs/{run.path.name}" for run in runs if run.column != PID and not run.unfinished
                and not (run.trials and (run.path / "trajectories.npz").exists())]
    lines += [f"python evaluate.py {name} --trials 500 --jobs 2" for name in untested]
    gains = {run.group[1] for run in runs if run.column == PID and run.trials}
    lines += [f"python evaluate.py --pid --task {task} --gains {name} --trials 500 --jobs 2 "
              f"--out data/runs/pid-{task}-{name}" for name in ("authors", "fast") if name not in gains]
    if not (RESULTS / f"demos-{task}.npz").exists():
        lines += [f"python pid_demo.py --task {task} --record 40 --gains fast --out data/demos-{task}.npz",
                  f"python plot_curves.py --publish data/demos-{task}.npz"]
    return ["", f"{TASKS[task]}: to fill the gaps", *("    " + line for line in lines)] if lines else []


def draw_all(out, named):
    """Writes every table and figure into the folder `out`. Returns remarks."""
    remarks, gaps = [], []
    for task in TASKS:
        runs, remarks_of_task = find_runs(task, named, mixed=True)
        remarks += remarks_of_task
        gaps += missing(task, runs)
        for kind in METRICS:
            rows = table_rows(kind, task, runs)
            for suffix, text in ((".txt", table_text(kind, task, rows) + "\n"), (".csv", table_csv(task, rows)),
                                 (".tex", table_latex(kind, task, rows))):
                write("--all", out / f"table-{kind}-{task}{suffix}",
                      lambda path, text=text: path.write_text(text, encoding="utf-8"))
        for name in (name for name in DRAW if name not in OF_NO_TASK):
            save_figure("--all", name, task, runs, [out / (figure_name(name, task) + end) for end in (".pdf", ".png")])
    for name in OF_NO_TASK:
        save_figure("--all", name, None, [], [out / (figure_name(name, None) + end) for end in (".pdf", ".png")])
    return [*remarks, f"wrote the tables and figures into {out}", *gaps]


def write(flag, path, save):
    """Let save(temporary path) write, then move the file into place: nobody ever meets half a file."""
    temporary = path.parent / f".{os.getpid()}-{path.name}"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            save(temporary)
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)
    except OSError as error:
        fail(f"{flag} {path}: {error.strerror}; a file that can be written is expected")


def figure_name(name, task):
    return f"fig-{name}" + f"-{task}" * (name not in OF_NO_TASK)


def main(argv=None):
    parser = argparse.ArgumentParser(prog="plot_curves.py", usage=argparse.SUPPRESS, description=__doc__,
                                     allow_abbrev=False, formatter_class=argparse.RawDescriptionHelpFormatter)
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--table", choices=METRICS, help="print the paper's metrics beside ours")
    what.add_argument("--figure", choices=DRAW, help="draw a figure of the paper")
    what.add_argument("--all", type=logx.path, metavar="OUT", help="write every table and figure into this folder")
    what.add_argument("--publish", nargs="+", type=logx.path, metavar="RUN",
                      help="copy run folders, or a demonstration file of pid_demo.py, into data/results")
    parser.add_argument("--task", choices=TASKS, help="with --table and --figure")
    parser.add_argument("--runs", nargs="+", type=logx.path, metavar="FOLDER",
                        help="run folders, or folders that hold some")
    parser.add_argument("--csv", type=logx.path, metavar="FILE", help="with --table: write it as CSV too")
    parser.add_argument("--out", type=logx.path, metavar="FILE", help="with --figure: the .png or .pdf to write")
    args = parser.parse_args(argv)
    if (args.csv and not args.table) or (args.out and not args.figure):
        fail("--csv goes with --table, --out with --figure")
    if args.out and args.out.suffix not in (".png", ".pdf"):
        fail(f"--out {args.out}: a name that ends in .png or .pdf is expected")
    if bool(args.task) != bool(args.table or args.figure and args.figure not in OF_NO_TASK):
        fail(f"--task: one of {', '.join(TASKS)} is expected with --table and with --figure of a task, not with others")
    if args.runs and (args.publish or args.figure in OF_NO_TASK):
        fail("--runs goes with --table, --all and --figure of a task")
    if args.publish:
        remarks = publish(args.publish)
    elif args.all:
        remarks = draw_all(args.all, args.runs)
    elif args.table:
        runs, remarks = find_runs(args.task, args.runs)
        rows = table_rows(args.table, args.task, runs)
        if args.csv:
            write("--csv", args.csv, lambda path: path.write_text(table_csv(args.task, rows), encoding="utf-8"))
        remarks.append(f"as CSV: {args.csv}" if args.csv else "as CSV: add --csv FILE")
        remarks = [table_text(args.table, args.task, rows), "", *remarks]
    else:
        runs, remarks = find_runs(args.task, args.runs) if args.task else ([], [])
        if args.figure == "learning" and not any(run.returns.size for run in runs):
            fail(f"--figure: no run of task {args.task} with an episode; --runs FOLDER names some")
        name = figure_name(args.figure, args.task)
        paths = [args.out] if args.out else [FIGURES / f"{name}{kind}" for kind in (".png", ".pdf")]
        save_figure("--out", args.figure, args.task, runs, paths)
        remarks += [f"wrote {path}" for path in paths] + (missing(args.task, runs) if args.task else [])
    print("\n".join(remarks))


if __name__ == "__main__":
    main()
