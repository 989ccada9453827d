"""The paper's training results (`sec:results`) beside ours: tables tab:p2p, tab:p2p-o, tab:pnp and learning curves.

    python plot_curves.py --table training --task p2p                      # the paper's numbers beside all our runs
    python plot_curves.py --table training --task p2p --runs data/runs --csv p2p.csv     # these runs only; also as CSV
    python plot_curves.py --figure learning --task p2p                     # figures/fig-learning-p2p.png and .pdf

Each takes seconds. `--runs` takes run folders, or folders with run folders anywhere below; without it, data/results and
data/runs are read and `--quick` runs left out. Runs of one algorithm, recipe, symmetry, variant (what else differs from
the recipe) and length are a group; groups are never averaged together. A run belongs to a printed column when
algorithm, N_demos and lambda_BC are the column's.

Per seed, over the agent's own training episodes (demonstrations are not counted):
    R10, R90    mean return of the first and of the last tenth of the episodes (a tenth of n is ceil(n / 10))
    I_R         R90 - R10 (the paper's is shown as printed, which differs from this by 0.01 to 0.03 in three cells)
    T50         first episode at which the mean of the last 50 returns exceeds R90 / 2; N/A where R90 <= 0 or never
Then the mean over seeds, with its 95 % bootstrap interval: BCa where it can be computed, percentile otherwise, none for
a single seed. With five seeds or fewer such an interval is narrower than it should be; read a "*" with that in mind.
The paper counts episodes, we stop at a number of environment steps: T50 depends on how long the early episodes last.
"""
import argparse
import csv
import gzip
import io
import json
import math
import os
import sys
import warnings
import zlib
from collections import Counter
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.figure import Figure  # without pyplot: a PNG is then always drawn by Agg, no display needed
from matplotlib.lines import Line2D
from scipy.stats import bootstrap

HERE = Path(__file__).resolve().parent
PAPER, RESULTS, RUNS, FIGURES = HERE / "data/paper", HERE / "data/results", HERE / "data/runs", HERE / "figures"
SWEEPS = {"lambda": "lambda_BC", "demos": "N_demos", "baseline": "baseline", "other": "other"}
TASKS = {"p2p": ("P2P", "tab:p2p"), "p2po": ("P2P-O", "tab:p2p-o"), "pnp": ("P&P", "tab:pnp")}
METRICS = {"R10": 2, "R90": 2, "I_R": 2, "T50": 0}  # and the decimals that the paper prints
WINDOW = 50  # episodes of the running mean, in T50 and in the figures
CONFIG = {"task": str, "algo": str, "recipe": str, "symmetry": str, "num_demos": int, "lambda_bc": (int, float),
          "seed": int, "epochs": int, "steps_per_epoch": int, "quick": bool}
CSV_HEADER = ["task", "sweep", "num_demos", "lambda_bc", "algo", "recipe", "symmetry", "variant", "total_env_steps",
              "seeds", "unfinished_seeds", "metric", "paper", "mean", "low", "high", "interval", "na_seeds",
              "paper_outside"]
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")  # Okabe & Ito: safe for colour-blind eyes
DASHES = ("-", (0, (5, 1.5)), (0, (3, 1, 1, 1)), (0, (1.5, 1)))  # one a group, so that colour is free for the column


def fail(message):
    """Bad input: one line on standard error, exit code 2."""
    print(f"plot_curves.py: error: {' '.join(str(message).split())}", file=sys.stderr)
    sys.exit(2)


# ------------------------------------------------------------------------------------------ reading

@dataclass(frozen=True)
class Run:
    path: Path
    column: tuple  # (algo, N_demos, lambda_BC): what the paper varies
    group: tuple  # (algo, recipe, symmetry, variant, total environment steps): what we vary
    seed: int
    unfinished: str  # "" or how far it is
    returns: np.ndarray  # (episodes,) undiscounted return of each training episode


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


def read_config(path):
    try:
        config = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        fail(f"{path}: {error}; a run's flags as JSON are expected")
    for key, kind in CONFIG.items():
        if not isinstance(config, dict) or key not in config:
            fail(f"{path}: no key {key!r}; {', '.join(CONFIG)} are expected")
        value, number = config[key], kind not in (str, bool)
        if not isinstance(value, kind) or (number and (isinstance(value, bool) or not 0 <= value < 1e12)):
            expected = {str: "text", int: "an integer >= 0", bool: "true or false"}.get(kind, "a number >= 0")
            fail(f"{path}: {key!r} is {value!r:.40}; {expected} is expected")
    return config


def read_run(folder, config):
    episodes = read_csv(folder / "episodes.csv", ("episode", "return"))
    if not np.array_equal(episodes["episode"], np.arange(1, len(episodes["episode"]) + 1)):
        fail(f"{folder / 'episodes.csv'}: column episode is garbled; 1, 2, 3, ... is expected")
    done = read_csv(folder / "progress.csv", ("env_steps",))["env_steps"][-1:].sum()
    total = config["epochs"] * config["steps_per_epoch"]
    return Run(path=folder, column=(config["algo"], config["num_demos"], float(config["lambda_bc"])),
               group=(config["algo"], config["recipe"], config["symmetry"], config.get("variant", ""), total),
               seed=config["seed"],
               unfinished=f"{done:,.0f} of {total:,} environment steps" if done < total else "",
               returns=episodes["return"])


def find_runs(task, named):
    """The runs of a task below the named folders (None: data/results, data/runs), and remarks to print."""
    configs, remarks = {}, []
    for folder in map(Path, named or [RESULTS, RUNS]):
        found = {path.parent: read_config(path) for path in sorted(folder.resolve().rglob("config.json"))}
        if named and not found:
            fail(f"--runs {folder}: no run there; a folder that holds config.json, or holds such folders, is expected")
        configs |= found  # by real path, so that a folder named twice counts once
    mine = {path: config for path, config in configs.items() if config["task"] == task}
    if named and not mine:
        fail(f"--runs: no run of task {task} among the {len(configs)} found; --task may be {', '.join(TASKS)}")
    if quick := 0 if named else sum(config["quick"] for config in mine.values()):
        mine = {path: config for path, config in mine.items() if not config["quick"]}
        remarks.append(f"left out: {quick} --quick run(s); name their folders with --runs to see them")
    runs = {}
    for run in (read_run(path, config) for path, config in mine.items()):
        first = runs.setdefault((run.column, run.group, run.seed), run)
        if first is not run:  # twice: fine only where one is the copy published in data/results of the other
            published = [r for r in (first, run) if r.path.is_relative_to(RESULTS.resolve())]
            if not published or first.path.name != run.path.name or not np.array_equal(first.returns, run.returns):
                fail(f"--runs: {first.path} and {run.path} are the same configuration and seed; one only is allowed")
            runs[run.column, run.group, run.seed] = published[0]
    remarks += [f"left out: {run.path} has no episode yet" for run in runs.values() if not run.returns.size]
    runs = [run for run in runs.values() if run.returns.size]
    return runs, remarks + [f"unfinished: {run.path}, {run.unfinished}" for run in runs if run.unfinished]


def paper_columns(task):
    """The paper's columns of a task in printed order: {"sweep", "key": (algo, N_demos, lambda_BC), "R10", ...}."""
    table = read_csv(PAPER / "training_metrics.csv", ("num_demos", "lambda_bc", "R10", "R90", "I_R"),
                     ("task", "algo", "sweep", "T50"))
    rows = [dict(zip(table, row, strict=True)) for row in zip(*table.values(), strict=True)]
    return [{**row, "key": (str(row["algo"]), int(row["num_demos"]), float(row["lambda_bc"])),
             "T50": float(row["T50"] or "nan")} for row in rows if row["task"] == task]  # T50 is blank for N/A


def all_columns(task, runs):
    """The paper's columns, then one, with NaN for the paper's numbers, for each (algo, N, lambda) of no printed one."""
    columns = paper_columns(task)
    others = sorted({run.column for run in runs} - {column["key"] for column in columns})
    return columns + [{"sweep": "other", "key": key, **dict.fromkeys(METRICS, math.nan)} for key in others]


def by_group(runs, column):
    """{group: its runs of this column}, in a fixed order."""
    mine = sorted((run for run in runs if run.column == column["key"]), key=lambda run: (run.group, run.seed))
    return {group: list(members) for group, members in groupby(mine, key=lambda run: run.group)}


def group_label(group):
    return f"{' '.join(filter(None, group[:-1]))} {group[-1] / 1000:g}k steps"


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


def interval(values):
    """95 % bootstrap interval of the mean of values (seeds,): low, high, method; NaN, NaN, "" for fewer than two."""
    for method in ("BCa", "percentile") if len(values) > 1 else ():
        with warnings.catch_warnings(action="ignore"):  # BCa of equal values is NaN, and a warning
            low, high = bootstrap((values,), np.mean, method=method, rng=np.random.default_rng(0)).confidence_interval
        if math.isfinite(low) and math.isfinite(high):
            return float(low), float(high), method
    return math.nan, math.nan, ""


def over_seeds(values, paper, digits):
    """One cell of the table: values (seeds,), NaN for N/A, beside the paper's value, NaN for none.

    `paper_outside` compares to the printed digits, so that the mark agrees with what the reader sees."""
    known = values[~np.isnan(values)]
    low, high, method = interval(known)
    return {"paper": paper, "mean": known.mean() if known.size else math.nan, "low": low, "high": high,
            "interval": method, "na_seeds": len(values) - len(known),
            "paper_outside": int(paper < round(low, digits) or paper > round(high, digits))}


# ------------------------------------------------------------------------------------------ table

def training_rows(task, runs):
    """[(column, group, its runs, {metric: cell})] in the paper's order; group None where a column has no runs."""
    rows = []
    for column in all_columns(task, runs):
        for group, members in (by_group(runs, column) or {None: []}).items():
            seeds = [training_metrics(run.returns) for run in members]
            cells = {metric: over_seeds(np.array([seed[metric] for seed in seeds]), column[metric], digits)
                     for metric, digits in METRICS.items()}
            rows.append((column, group, members, cells))
    return rows


def printed(value, digits):
    return f"{value:6.{digits}f}" if math.isfinite(value) else "   N/A"


def cell_text(cell, digits):
    ends = f" [{cell['low']:.{digits}f}, {cell['high']:.{digits}f}]" if cell["interval"] else " [-]"
    not_reached = f" ({cell['na_seeds']} N/A)" if cell["na_seeds"] else ""
    return printed(cell["mean"], digits) + ends + not_reached + " *" * cell["paper_outside"]


def training_text(task, rows):
    """The table as aligned text."""
    lines, above = [("sweep", "N_demos", "lambda_BC", "", *("   " + metric for metric in METRICS), "seeds")], {}
    for column, group, members, cells in rows:
        if column is not above:
            new, other = column["sweep"] != above.get("sweep"), column["sweep"] == "other"
            lines += [("",) * 9] * new
            lines.append((SWEEPS[column["sweep"]] if new else "", str(column["key"][1]), f"{column['key'][2]:g}",
                          "not in the paper's table" if other else "paper",
                          *("" if other else printed(column[m], digits) for m, digits in METRICS.items()), ""))
        unfinished = sum(bool(run.unfinished) for run in members)
        lines.append(("", "", "", group_label(group), *(cell_text(cells[m], digits) for m, digits in METRICS.items()),
                      f"{len(members)}" + f" ({unfinished} unfinished)" * bool(unfinished)) if group else
                     ("", "", "", "no runs", "", "", "", "", ""))
        above = column
    widths = [max(map(len, texts)) for texts in zip(*lines, strict=True)]
    return "\n".join([f"{TASKS[task][0]}, training metrics ({TASKS[task][1]}): the paper's, and ours as the mean over "
                      "seeds [95 % bootstrap interval over seeds]", "",
                      *("  ".join(map(str.ljust, line, widths)).rstrip() for line in lines), "",
                      "*      the paper's value lies outside our interval", "[-]    no interval: fewer than two seeds",
                      "(N/A)  seeds without a T50 (R90 <= 0, or never exceeded); they are not in the mean"])


def training_csv(task, rows):
    """The table as CSV text, one line a column, group and metric; blank where there is no number."""
    out = io.StringIO()
    writer = csv.DictWriter(out, CSV_HEADER, restval="", lineterminator="\n")
    writer.writeheader()
    for column, group, members, cells in rows:
        about = dict(zip(("task", "sweep", "algo", "num_demos", "lambda_bc"), (task, column["sweep"], *column["key"]),
                         strict=True))
        about |= dict(zip(("algo", "recipe", "symmetry", "variant", "total_env_steps"), group or (), strict=False))
        about |= {"seeds": len(members), "unfinished_seeds": sum(bool(run.unfinished) for run in members)}
        for metric, cell in cells.items():
            cell = {k: round(v, 6) if isinstance(v, float) else v for k, v in cell.items() if v == v}  # NaN is blank
            writer.writerow({**about, "metric": metric, **cell})
    return out.getvalue()


# ------------------------------------------------------------------------------------------ figure

def draw_curve(ax, runs, colour, dashes, label):
    """Mean over seeds and its band as far as every seed goes; then a thin line, the mean of those that go on."""
    curves = [running_mean(run.returns) for run in runs]
    every, longest = min(map(len, curves)), max(map(len, curves))
    curves = np.array([np.pad(curve, (0, longest - len(curve)), constant_values=np.nan) for curve in curves])
    episode, mean = np.arange(1, longest + 1), np.nanmean(curves, axis=0)
    start = min(9, every // 2)  # the mean of one or two returns is noise that would set the scale of the axis
    unfinished = sum(bool(run.unfinished) for run in runs)
    label += f" ({len(runs)} seed{'s' * (len(runs) > 1)}{f', {unfinished} unfinished' if unfinished else ''})"
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
        algo, N, lam = column["key"]
        both = rf"$N_{{demos}}={N}$, $\lambda_{{BC}}={lam:g}$"
        label = {"lambda": both.split(", ")[1], "demos": both.split(", ")[0], "baseline": algo.upper(),
                 "other": both if algo == columns[0]["key"][0] else f"{algo.upper()}, {both}"}[column["sweep"]]
        colour = "#555555" if column["sweep"] == "baseline" else next(colours)
        mine = by_group(runs, column)
        for group, members in mine.items():
            draw_curve(ax, members, colour, DASHES[groups.index(group) % len(DASHES)], label)
        if mine and math.isfinite(column["R90"]):
            ax.axhline(column["R90"], color=colour, linestyle=":", linewidth=0.8, zorder=1)


def learning_figure(task, runs):
    """Figures fig:p2p_hyp, fig:p2p_obs_hyp, fig:pnp_hyp: a Figure at column width with one panel a sweep."""
    columns, groups = all_columns(task, runs), Counter(sorted(run.group for run in runs)).most_common()
    groups = [group for group, _ in groups]  # the group with the most runs gets the solid line
    keys = {column["sweep"]: column["key"] for column in columns}
    titles = {"lambda": rf"{TASKS[task][0]}: effect of $\lambda_{{BC}}$ at $N_{{demos}}={keys['lambda'][1]}$",
              "demos": rf"{TASKS[task][0]}: effect of $N_{{demos}}$ at $\lambda_{{BC}}={keys['demos'][2]:g}$"}
    with matplotlib.rc_context({"font.family": "STIXGeneral", "mathtext.fontset": "stix", "font.size": 8,
                                "legend.fontsize": 7, "legend.title_fontsize": 7, "legend.frameon": False,
                                "axes.spines.top": False, "axes.spines.right": False}):
        figure = Figure(figsize=(3.6, 5.6), layout="constrained")
        for ax, (sweep, title) in zip(figure.subplots(2, sharex=True, sharey=True), titles.items(), strict=True):
            draw_panel(ax, sweep, columns, runs, groups)
            ax.set_ylabel(f"return (mean of last {WINDOW} episodes)")
            drawn, _ = ax.get_legend_handles_labels()
            ax.legend(handles=drawn, title=title, title_fontsize=8.5, ncols=2, loc="lower center",
                      bbox_to_anchor=(0.5, 1))
            ax.text(0.5, 0.5, "" if drawn else "no runs", ha="center", transform=ax.transAxes)
        ax.set(xlabel="episode", xlim=(0, None))  # shared; after both panels, for it ends autoscaling
        lines = [Line2D([], [], color="k", linestyle=DASHES[i % len(DASHES)], linewidth=1.3, label=group_label(group))
                 for i, group in enumerate(groups)]
        lines.append(Line2D([], [], color="k", linestyle=":", linewidth=0.8, label=r"the paper's $\overline{R}_{90}$"))
        figure.legend(handles=lines, loc="outside lower center", ncols=2, title=(
            "mean over seeds and 95 % band (percentile bootstrap over seeds);\n"
            "thin: mean of the seeds that go on after the shortest has ended"))
    return figure


# ------------------------------------------------------------------------------------------ main

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


def main(argv=None):
    parser = argparse.ArgumentParser(prog="plot_curves.py", usage=argparse.SUPPRESS, description=__doc__,
                                     allow_abbrev=False, formatter_class=argparse.RawDescriptionHelpFormatter)
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--table", choices=["training"], help="print the paper's metrics beside ours")
    what.add_argument("--figure", choices=["learning"], help="draw the learning curves")
    parser.add_argument("--task", choices=TASKS, required=True)
    parser.add_argument("--runs", nargs="+", metavar="FOLDER", help="run folders, or folders that hold some")
    parser.add_argument("--csv", type=Path, metavar="FILE", help="with --table: write it as CSV too")
    parser.add_argument("--out", type=Path, metavar="FILE", help="with --figure: the .png or .pdf to write")
    args = parser.parse_args(argv)
    if (args.csv and args.figure) or (args.out and args.table):
        fail("--csv goes with --table, --out with --figure")
    if args.out and args.out.suffix not in (".png", ".pdf"):
        fail(f"--out {args.out}: a name that ends in .png or .pdf is expected")
    runs, remarks = find_runs(args.task, args.runs)
    if args.table:
        rows = training_rows(args.task, runs)
        if args.csv:
            write("--csv", args.csv, lambda path: path.write_text(training_csv(args.task, rows), encoding="utf-8"))
        remarks.append(f"as CSV: {args.csv}" if args.csv else "as CSV: add --csv FILE")
        print("\n".join([training_text(args.task, rows), "", *remarks]))
        return
    if not runs:
        fail(f"--figure: no run of task {args.task} with an episode; --runs FOLDER names some, {RUNS} is the default")
    figure = learning_figure(args.task, runs)
    for path in [args.out] if args.out else [FIGURES / f"fig-learning-{args.task}{kind}" for kind in (".png", ".pdf")]:
        write("--out", path, lambda temporary: figure.savefig(temporary, dpi=300))
        remarks.append(f"wrote {path}")
    print("\n".join(remarks))


if __name__ == "__main__":
    main()
