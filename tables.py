"""The runs in data/ as tables: read, grouped, measured as in the paper (Sec. 5).

    runs, remarks = tables.find_runs()          # a DataFrame, one row a run
    text, in_markdown, frame = tables.make_table("test", "p2p", runs)

plot_curves.py prints and draws what is here. Runs of one algorithm, recipe,
symmetry, variant (flags that differ from the recipe's) and length are a group;
groups are never averaged together.

Training metrics (Sec. 5.1), per seed, over the agent's own episodes:
    R10, R90  mean return of the first, the last tenth of n: ceil(n / 10)
    I_R       R90 - R10, which the paper rounds otherwise in three cells
    T50       first episode at which the mean of the last 50 returns exceeds
              R90 / 2, N/A where there is none or R90 <= 0. The paper's rule
              is another: it prints 655 where its R90 is negative.
Test metrics (Sec. 5.2): evaluate.py. Then the mean over seeds and its 95 %
interval by Student's t; of a single seed none in training, and in the test the
one over its trials, which knows nothing of other seeds.
"""

import json
import math
import os
import re
import zipfile
import zlib
from collections import Counter
from contextlib import contextmanager
from functools import cached_property
from itertools import combinations

import numpy as np
import pandas as pd

import evaluate
import logx
import pid_demo
from evaluate import HERE, RESULTS, RUNS
from kinova_env import INDEX, TASKS
from logx import BadInput

PAPER = HERE / "data/paper"
TITLES = {"p2p": "P2P", "p2po": "P2P-O", "pnp": "P&P"}
NUMBERS = {"training": {"p2p": "Table 4", "p2po": "Table 5", "pnp": "Table 3"},
           "test": {"p2p": "Table 6", "p2po": "Table 7", "pnp": "Table 8"}}  # fmt: skip
METRICS = {"training": {"R10": 2, "R90": 2, "I_R": 2, "T50": 0},  # and the decimals that the paper prints
           "test": {"P_scs_percent": 1, "T_eff": 1, "R_test": 2, "E_95_cm": 2}}  # fmt: skip
OWN_SYMMETRY = {"paper": "gas", "robust": "mirror"}  # of the recipes
RANKED = {"training": "R90", "test": "P_scs_percent"}  # the metric by which columns are compared
# Tables of groups that differ in one thing alone: it, what the others are compared with, and what is the same for all.
COMPARED = {"ablations": ("variant", "", ["num_demos"]), "symmetries": ("symmetry", "none", ["recorded"]),
            "partitions": ("K", 4, ["recorded", "num_demos"])}  # fmt: skip
GROUP = ["algo", "recipe", "symmetry", "variant", "total_env_steps"]
COLUMN = ["algo", "num_demos", "lambda_bc"]  # what the paper varies
BEST, LATE = "best evaluation in training", "mean of the last fifth of evaluations in training"
WINDOW = 50  # episodes of the running mean, in T50 and in the figures


# ---- reading ---------------------------------------------------------------------------------------------------------


@contextmanager
def reading(path, expected):
    """Around a reader of `path`: whatever is wrong with the file becomes one line that names it."""
    try:
        yield
    except BadInput:
        raise
    except (OSError, EOFError, LookupError, TypeError, ValueError, zipfile.BadZipFile, zlib.error) as error:
        problem = "no such file" if isinstance(error, FileNotFoundError) else logx.one_line(error)
        raise BadInput(f"{path}: {problem}; {expected} expected") from None


def read_csv(path, numbers):
    """DataFrame of a CSV file, or of the one with .gz behind its name. `numbers`: columns that are never blank."""
    with reading(path, f"a table with numbers in {', '.join(numbers)}"):
        table = pd.read_csv(path if path.exists() else path.with_name(f"{path.name}.gz"))
        values = table[list(numbers)].apply(pd.to_numeric, errors="coerce")
        known = np.isfinite(values.astype(float)).all(axis=1)
        if not known[:-1].all():  # the last line may be cut short: its run is writing it
            raise ValueError(f"no number in line {known.argmin() + 2}")
        return table.assign(**values)[known]


def split(values, length):
    """values (sum(length + 1), ...), of t = 0 ... length of one episode after another, as a list of one each."""
    if np.min(length, initial=0) < 0 or len(values) != np.sum(length + 1):
        raise ValueError("its arrays do not fit together")
    return np.split(values, np.cumsum(length + 1)[:-1])[: len(length)]  # of no episode, np.split makes one


def read_errors(path):
    """||e_t|| in m (length + 1,) of each successful trial in a trajectories.npz."""
    with reading(path, "a trajectories.npz of evaluate.py"), pid_demo.open_npz(path) as file:
        errors = split(file["error"].astype(float), file["length"])
        return [error for error, success in zip(errors, file["success"], strict=True) if success]


def read_paths(path):
    """(task or None, TCP paths) in a trajectories.npz, a demos-TASK.npz, or a file of pid_demo.py --record: dicts with
    `tcp` (length + 1, 3), `goal`, `object` (3,), in m, NaN where there is none, and `success`."""
    with reading(path, "an .npz of evaluate.py, or of pid_demo.py --record"), pid_demo.open_npz(path) as file:
        task, length = None, file["length"]
        if "obs" in file:
            task = json.loads(str(file["meta"]))["task"]
            at, ends = INDEX[task], np.cumsum(length)
            states = [np.vstack((file["obs"][end - n : end], file["obs2"][end - 1 : end]))
                      for n, end in zip(length, ends, strict=True)]  # fmt: skip
            tcp = [s[:, at["P_g"]] - s[:, at["e"]] for s in states]  # P_e = P_g - e
            goal = [s[0, at["P_g"]] for s in states]
            cube = [s[0, at["P_o"]] if "P_o" in at else np.full(3, np.nan, np.float32) for s in states]
        else:
            goal, cube = file["goal"], file["object"]
            tcp = split(file["tcp"].reshape(-1, 3), length[: len(goal)])
        paths = zip(tcp, goal, cube, file["success"], strict=False)
        return task, [dict(zip(("tcp", "goal", "object", "success"), path, strict=True)) for path in paths]


class Curves:
    """One run: what its folder's files hold, each read when it is asked for. Raises BadInput that names the file."""

    def __init__(self, folder):
        self.folder, self.trajectories = folder, folder / "trajectories.npz"
        with reading(folder / "config.json", "a run's flags as JSON"):
            self.config = json.loads((folder / "config.json").read_text(encoding="utf-8"))
            c = {"variant": "", "versions": {}, "partitions": 4} | self.config
            self.pid = c["algo"] == "pid"
            if self.pid:
                c |= dict(recipe=c["gains"], symmetry="", num_demos=0, lambda_bc=0, seed=0, epochs=0, steps_per_epoch=0)
            kinds = dict.fromkeys(("task", "algo", "recipe", "symmetry", "variant"), str)
            kinds |= dict.fromkeys(("num_demos", "seed", "epochs", "steps_per_epoch", "partitions"), int)
            for name, kind in kinds.items():
                if type(c[name]) is not kind or (name, c[name]) == ("partitions", 0):
                    raise ValueError(f"{name} {logx.one_line(c[name])}")
            if c["task"] not in TASKS:
                raise ValueError(f"task {c['task']}")
            names = ("task", "algo", "recipe", "symmetry", "variant", "num_demos", "seed")
            self.row = {name: c[name] for name in names} | {"lambda_bc": float(c["lambda_bc"])}
            self.row["K"] = c["partitions"] if c["symmetry"] == "gas" else 1  # images of a recorded demonstration
            self.row["recorded"] = math.ceil(c["num_demos"] / self.row["K"])
            self.row["total_env_steps"] = int(c["epochs"] * c["steps_per_epoch"])
            self.row["commit"] = str(dict(c["versions"]).get("git_commit", "unknown"))

    @cached_property
    def episodes(self):
        return read_csv(self.folder / "episodes.csv", ("episode", "env_steps", "return", "length", "success"))

    @cached_property
    def progress(self):
        return read_csv(self.folder / "progress.csv", ("epoch", "env_steps", "demo_env_steps", "seconds"))

    @cached_property
    def evaluations(self):
        """{"" or what is not as in Sec. 5.2: its trials}."""
        found = {}
        for path in [*self.folder.glob("evaluation*.csv.gz"), *self.folder.glob("evaluation*.csv")]:
            what = re.sub(r"^evaluation-?|\.csv(\.gz)?$", "", path.name)  # start_-0.8_0.5_0.4-horizon_600
            what = ", ".join(part.replace("_", " ") for part in re.split("-(?=[a-z])", what))
            found[what] = read_csv(path, ("trial", "success", "length", "return", "effort_percent", "e95_cm"))
            if not len(found[what]):
                raise BadInput(f"{path}: no trial; run evaluate.py again")
        return dict(sorted(found.items()))

    @cached_property
    def tested(self):
        """The metrics of the test study; none where there was none."""
        return evaluate.metrics(self.evaluations[""]) if "" in self.evaluations else {}

    @property
    def success(self):
        """P_scs of the test study in percent; NaN where there was none."""
        return self.tested.get("P_scs_percent", math.nan)

    @property
    def trial_steps(self):
        """Mean steps of the test study's successful trials; NaN where there are none."""
        return self.tested.get("steps", math.nan)

    @property
    def own_length(self):
        """Whether it was asked for as many epochs as its recipe has; of runs that do not say so, their folder does."""
        return self.config.get("own_length", "-epochs=" not in self.folder.name)

    @property
    def own_flags(self):
        """Whether its symmetry, length and other flags are its recipe's: those of a main group."""
        own_symmetry = self.row["symmetry"] == OWN_SYMMETRY.get(self.row["recipe"])
        return own_symmetry and self.own_length and self.row["variant"] == ""

    @property
    def own_success(self):
        """Percent of the own episodes while training that succeeded, exploration and all."""
        return 100 * self.episodes.success.mean()

    @cached_property
    def validation(self):
        """Success in percent on the trials while training, a Series by environment steps; empty where none."""
        if self.pid or "eval_success" not in self.progress:
            return pd.Series(dtype=float)
        with reading(self.folder / "progress.csv", "eval_success in numbers"):
            return 100 * pd.to_numeric(self.progress.set_index("env_steps").eval_success).dropna()


def find_runs(named=None):
    """(DataFrame of the runs below the named folders, or of the default ones: one row a run, `curves` its Curves;
    remarks to print). Of one configuration and seed there is one run: the finished, longest, most tested, own
    one."""
    rows, remarks = {}, []
    for folder in {folder.resolve(): folder for folder in named or (RESULTS, *RUNS)}.values():
        found = sorted(path for path in folder.resolve().rglob("config.json") if not path.parent.name.startswith("."))
        if named and not found:
            raise BadInput(f"--runs {folder}: no run there; a folder that holds config.json, or such folders, expected")
        for path in found:
            curves = Curves(path.parent)
            if not curves.pid and not len(curves.episodes):
                remarks.append(f"left out: {path.parent} has no episode yet")
                continue
            steps = int(curves.progress.env_steps.iloc[-1:].sum()) if not curves.pid else 0
            rows[path] = curves.row | {"steps": steps, "finished": steps >= curves.row["total_env_steps"],
                                       "own": not path.is_relative_to(RESULTS.resolve()), "curves": curves}  # fmt: skip
    names = ["task", *GROUP, *COLUMN[1:], "K", "recorded", "seed", "commit", "steps", "finished", "own", "curves"]
    types = {"finished": bool, "own": bool, "num_demos": int, "lambda_bc": float}
    runs = pd.DataFrame(rows.values(), columns=names).astype(types)
    for _, twins in runs.groupby(["task", *GROUP, *COLUMN[1:], "seed"]):
        if len(twins) == 1:
            continue
        twins = twins.assign(trials=[len(curves.evaluations.get("", ())) for curves in twins.curves])
        by = ["finished", "steps", "trials", "own"]
        kept, *others = twins.sort_values(by, ascending=False, kind="stable").itertuples()
        copies = kept.commit, kept.steps, kept.curves.folder.name  # of a run and its published copy nothing is said
        told = [x for x in others if x.own == kept.own or (x.commit, x.steps, x.curves.folder.name) != copies]
        remarks += [f"left out: {other.curves.folder}; {kept.curves.folder} is of the same configuration and seed"
                    for other in told]  # fmt: skip
        runs = runs.drop([other.Index for other in others])
    remarks += [f"unfinished: {run.curves.folder}, {run.steps:,} of {run.total_env_steps:,} environment steps"
                for run in runs[~runs.finished].itertuples()]  # fmt: skip
    return runs.sort_values([*GROUP, *COLUMN[1:], "seed"], ignore_index=True), remarks


def own_symmetry(runs):
    """Whether each run has its recipe's symmetry; runs of no recipe (the PID, Stable-Baselines3) have."""
    return runs.symmetry == runs.recipe.map(OWN_SYMMETRY).fillna(runs.symmetry)


def of_task(runs, task, variants=False):
    """The runs of a task; of the recipes alone, each with its own symmetry, unless `variants`."""
    return runs[(runs.task == task) & (variants | ((runs.variant == "") & own_symmetry(runs)))]


def columns(task, runs=None):
    """DataFrame of the paper's columns in printed order (sweep, algo, num_demos, lambda_bc and all metrics, NaN where
    it has none), then of those that only these runs have.

    The test tables' columns are the training tables' of the same sweep and value: P2P-O's lambda sweep (Table 7) prints
    N_demos = 100, but its lambda = 1 then contradicts its own N_demos = 100."""
    printed = []
    for kind, metrics in METRICS.items():
        table = read_csv(PAPER / f"{kind}_metrics.csv", list(metrics)[:1])
        demos = table.num_demos.where(table.sweep == "demos", 0)
        table["value"] = table.lambda_bc.where(table.sweep == "lambda", demos)
        printed.append(table[table.task == task].drop(columns="task"))
    training, test = printed
    found = training.merge(test.drop(columns=COLUMN[1:]), on=["sweep", "value"], how="left")
    found = pd.concat([found, test[test.sweep == "pid"].assign(algo="pid", num_demos=0, lambda_bc=0.0)])
    found = found.drop(columns="value").astype({"num_demos": int, "lambda_bc": float})
    if runs is not None:
        ours = runs[COLUMN].drop_duplicates().merge(found[COLUMN].drop_duplicates(), how="left", indicator="where")
        ours = ours[ours["where"] == "left_only"].drop(columns="where").sort_values(COLUMN)
        found = pd.concat([found, ours.assign(sweep="other")])
    return found.reset_index(drop=True)


def of_column(runs, column):
    """The runs of a column, which is a row of `columns`."""
    return runs[(runs[COLUMN] == [column.algo, column.num_demos, column.lambda_bc]).all(axis=1)]


def best_column(task, runs=None):
    """The printed column with the highest R90, a row as `itertuples` gives it. Of a task that the paper does not have,
    the column of `runs` with most demonstrations, None where there is none."""
    found = columns(task, runs).sort_values(["R90", "num_demos"], ascending=False, kind="stable")
    return next(found.itertuples(), None)


# ---- metrics ---------------------------------------------------------------------------------------------------------


def running_mean(returns):
    """(n,) -> (n,): mean of the last 50 returns, of fewer where there are not yet 50."""
    return pd.Series(returns, dtype=float).rolling(WINDOW, min_periods=1).mean().to_numpy()


def training_metrics(returns):
    """The training metrics of one seed from its returns (n,), n >= 1; T50 in episodes from 1, NaN for N/A."""
    tenth = math.ceil(len(returns) / 10)
    R10, R90 = np.mean(returns[:tenth]), np.mean(returns[-tenth:])
    reached = np.flatnonzero(running_mean(returns)[WINDOW - 1 :] > R90 / 2)  # full windows of 50 only
    T50 = reached[0] + WINDOW if R90 > 0 and reached.size else math.nan
    return {"R10": R10, "R90": R90, "I_R": R90 - R10, "T50": T50}


def over_seeds(metric, values):
    """evaluate.over_seeds, which does not know that a percentage lies in 0 ... 100."""
    mean, *ends = evaluate.over_seeds(values)
    return mean, *(np.clip(ends, 0, 100) if metric == "P_scs_percent" else ends)


def difference(metric, a, b):
    """evaluate.difference, which does not know that percentages differ by 100 points at most."""
    gap, *ends = evaluate.difference(a, b)
    return gap, *(np.clip(ends, -100, 100) if metric == "P_scs_percent" else ends)


def separated(a, b):
    """Whether all of a lie above, or all below, all of b, where chance alone does so at most 1 time in 20 (permutation
    test): near 100 %, seeds are not normal, and Welch's interval is wide."""
    return math.comb(len(a) + len(b), len(a)) >= 40 and bool(np.min(a) > np.max(b) or np.max(a) < np.min(b))


def late(validation):
    """Mean success in percent of the last fifth of a run's evaluations while training; NaN where there are none."""
    return validation.iloc[-math.ceil(len(validation) / 5) :].mean()


def measured(kind, runs):
    """{evaluation: [(run, its metrics)]} of a group: "" as in the paper, other studies; of runs as published, whose
    success swings, BEST and LATE."""
    found = {}
    for run in runs.itertuples():
        if kind == "training" and not run.curves.pid:
            found.setdefault("", []).append((run, training_metrics(run.curves.episodes["return"].to_numpy())))
        for what, trials in run.curves.evaluations.items() if kind == "test" else ():
            found.setdefault(what, []).append((run, evaluate.metrics(trials)))
        if kind == "test" and run.recipe == "paper" and len(run.curves.validation):
            values = run.curves.validation
            for what, value in ((BEST, values.max()), (LATE, late(values))):
                found.setdefault(what, []).append((run, {"P_scs_percent": value}))
    return dict(sorted(found.items(), key=lambda item: (item[0] in (BEST, LATE), item[0])))


def table(kind, task, runs):
    """The table as DataFrame: a row for each column, group, evaluation and metric, in the paper's order; of a printed
    column without (tested) runs, rows with 0 seeds. Unfinished runs count, and are counted."""
    rows = []
    for column in columns(task, runs).itertuples():
        about, begun = {"task": task} | {name: getattr(column, name) for name in ("sweep", *COLUMN)}, len(rows)
        for group, members in of_column(runs, column).groupby(GROUP):
            for what, seeds in measured(kind, members).items():
                of_group = about | dict(zip(GROUP, group, strict=True)) | {"evaluation": what, "seeds": len(seeds)}
                of_group["unfinished"] = sum(not run.finished for run, _ in seeds)
                tested = [
                    run.curves.evaluations[what] for run, _ in seeds if kind == "test" and what not in (BEST, LATE)
                ]
                of_group["trials"] = " ".join(map(str, sorted(set(map(len, tested)))))
                of_group["commits"] = " ".join(sorted({run.commit[:7] + run.commit[40:] for run, _ in seeds}))
                for metric, digits in METRICS[kind].items():
                    values = np.array([metrics.get(metric, math.nan) for _, metrics in seeds])
                    (mean, low, high), method = over_seeds(metric, values), "over seeds"
                    if what == BEST:  # of a maximum, Student's t says nothing
                        low = high = math.nan
                    if kind == "test" and len(seeds) == 1 and what not in (BEST, LATE):
                        trials = seeds[0][0].curves.evaluations[what]
                        (low, high), method = evaluate.over_trials(trials)[metric], "over trials"
                    paper = getattr(column, metric)
                    rows.append(of_group | {
                        "metric": metric, "paper": paper, "mean": mean, "low": low, "high": high,
                        "interval": method if low == low else "", "na_seeds": int(np.isnan(values).sum()),
                        # as printed, so that the mark agrees with what the reader sees
                        "paper_outside": int((paper < round(low, digits) or paper > round(high, digits)) and not what
                                             and group[1] in ("paper", "authors")),  # of the paper's method alone
                        "values": values})  # fmt: skip
        if len(rows) == begun and column.sweep != "other" and (column.sweep != "pid" or kind == "test"):
            none = dict.fromkeys([*GROUP[1:], "trials"], "") | {"evaluation": "", "seeds": 0, "unfinished": 0}
            rows += [about | none | {"metric": m, "paper": getattr(column, m)} for m in METRICS[kind]]
    names = ["task", "sweep", *COLUMN[1:], *GROUP, "evaluation", "seeds", "trials", "unfinished", "metric", "paper",
             "mean", "low", "high", "interval", "na_seeds", "paper_outside", "commits", "values"]  # fmt: skip
    return pd.DataFrame(rows, columns=names)


# ---- tables as text --------------------------------------------------------------------------------------------------


def group_label(group):
    *words, total = group
    return " ".join(filter(None, [*words, f"{total / 1000:g}k steps" if total else ""]))


def between(mean, low, high, digits):
    """mean [low, high] as text, - where there is none, as of a single seed or of seeds that show no spread."""
    ends = f" [{low:.{digits}f}, {high:.{digits}f}]" if low < high else " [-]"
    return f"{mean:.{digits}f}{ends}" if mean == mean else "-"


def table_lines(kind, rows):
    """`table` as lines of cells, all of one length, the heading first."""
    digits, by = METRICS[kind], [*GROUP, "evaluation", "seeds", "unfinished"]
    lines = [["sweep", "N_demos", "lambda_BC", "", *digits, "seeds"]]
    for (sweep, _, N, lam), column in rows.groupby(["sweep", *COLUMN], sort=False):
        paper = column.drop_duplicates("metric").set_index("metric").paper
        printed = ["N/A" if x != x else f"{x:.{digits[m]}f}" for m, x in paper.items()]
        key = [sweep, "", ""] if sweep == "pid" else [sweep, f"{N}", f"{lam:g}"]
        lines.append([*key, "paper", *printed, ""] if paper.notna().any() else
                     [*key, "not in the paper's table", *[""] * len(digits), ""])  # fmt: skip
        for (*group, what, seeds, unfinished), cells in column.groupby(by, sort=False):
            if not seeds:
                lines.append(["", "", "", "no runs", *[""] * len(digits), ""])
                continue
            texts = []
            for cell in cells.itertuples():
                text = between(cell.mean, cell.low, cell.high, digits[cell.metric]) + " *" * int(cell.paper_outside)
                if cell.metric == "T50" and cell.mean == WINDOW:  # the least that the rule can give
                    text = f"<= {WINDOW}"
                if cell.na_seeds and what not in (BEST, LATE):
                    text = "N/A" if cell.na_seeds == seeds else f"{text} ({cell.na_seeds:.0f} N/A)"
                texts.append(text)
            lines.append(["", "", "", group_label(group) + f", {what}" * bool(what), *texts,
                          f"{seeds}" + f" ({unfinished} unfinished)" * bool(unfinished)])  # fmt: skip
    return lines


def table_notes(kind, rows):
    """What stands below the table, as lines."""
    notes = [
        "Ours: the mean over seeds and its 95 % interval by Student's t; [-]: none, of a single seed or of seeds all "
        "alike. *: the paper's number lies outside it (runs as published and the PID with the authors' gains)."
    ]
    if kind == "training":
        notes += ["R10, R90: mean return of the first and the last tenth (rounded up) "
                  "of the agent's own episodes; I_R: R90 - R10.",
                  "T50: the first episode at which the mean of the last 50 exceeds half of R90; N/A where R90 <= 0 or "
                  "none does. The paper's rule is another (DIFFERENCES 56)."]  # fmt: skip
    else:
        notes += ["A single seed: its interval over trials (P_scs: Wilson's), which knows nothing of other seeds.",
                  "Evaluations in training, of validation trials: the best one is not the last policy's."]  # fmt: skip
        if "p2po" in rows.task.values:
            notes += ["The paper's Table 7 says N_demos = 100 of its lambda sweep, its Table 5 250 (DIFFERENCES 39)."]
    ours = rows[(rows.seeds > 0) & (rows.algo != "pid")]
    for group, texts in ours.groupby(GROUP, sort=False).commits:
        notes.append(f"Commits of {group_label(group)}: {', '.join(sorted(set(' '.join(texts).split())))}")
    for group, mixed in ours[ours.trials.str.contains(" ")].groupby(GROUP, sort=False).trials:
        trials = sorted(set(" ".join(mixed).split()), key=int)
        notes.append(f"Seeds of {group_label(group)} were tested in {' or '.join(trials)} trials.")
    return [*notes, *ranked(kind, ours)]


def ranked(kind, rows):
    """Lines: of the pairs of columns, of a sweep or with the baseline, that the paper ranks by the table's main metric,
    how many our seeds rank alike, and those that they rank the other way."""
    metric, found = RANKED[kind], {}
    for _, group in rows[(rows.metric == metric) & (rows.evaluation == "")].groupby(GROUP):
        for one, other in combinations(group.itertuples(), 2):
            compared = one.sweep == other.sweep or "baseline" in (one.sweep, other.sweep)
            if not (compared and abs(one.paper - other.paper) > 0):  # not where either is NaN
                continue
            gap, low, high = difference(metric, one.values, other.values)
            verdict = ("" if low != low else "cannot tell apart" if low <= 0 <= high else
                       "agree on" if (gap > 0) == (one.paper > other.paper) else "rank the other way")  # fmt: skip
            pair = " and ".join(f"N_demos={row.num_demos} lambda_BC={row.lambda_bc:g}" for row in (one, other))
            label = group_label([getattr(one, name) for name in GROUP])
            line = (f"  {pair}: the paper's {one.paper:g} and {other.paper:g}, our difference "
                    f"{between(gap, low, high, METRICS[kind][metric])} ({label})")  # fmt: skip
            found[line] = verdict
    counts = Counter(found.values())
    heads = [f"Pairs that the paper's {metric} ranks, by Welch's 95 % interval of our difference: "
             + ", ".join(f"{counts[v]} we {v}" for v in ("rank the other way", "cannot tell apart", "agree on"))
             + f"; {counts['']} of a single seed" * (counts[""] > 0)] * bool(found)  # fmt: skip
    return [*heads, *(line for line, verdict in found.items() if verdict == "rank the other way")]


def compared_lines(kind, runs):
    """The table `kind` of COMPARED as lines of cells: success in the test study, the steps that its successful trials
    take, success of all own episodes while training, each with Welch's difference; of finished runs. Where the recipe
    has no runs of a variant's length, the test study of its longest is the reference."""
    by, base, held = COMPARED[kind]
    wanted = {"variant": own_symmetry(runs), "symmetry": runs.variant == "",
              "K": (runs.symmetry == "gas") & runs.variant.str.fullmatch(r"(partitions=\d+)?")}[by]  # fmt: skip
    runs = runs[runs.finished & (runs.algo != "pid") & wanted]
    alike = [name for name in GROUP[:-1] if name != by and (by, name) != ("K", "variant")]
    lines = [["group", "lambda_BC", by, "recorded", "N_demos", "success in the test study, by seed (%)", "mean",
              "difference", "steps", "difference", "own episodes (%)", "difference"]]  # fmt: skip
    groups = [members for same in held for _, members in runs.groupby([*alike, "lambda_bc", same])]
    for members in groups:
        if members[by].nunique() == 1 and (by != "variant" or "" in members.variant.values):
            continue  # nothing to compare
        found = {key: list(part.curves) for key, part in members.groupby([by, GROUP[-1], "recorded", "num_demos"])}
        bases = {steps: part for (value, steps, *_), part in found.items() if value == base}
        for key in sorted(found, key=lambda key: (key[0] != base and by != "K", key)):
            (value, steps, recorded, N), part = key, found[key]
            same = bases.get(steps, ()) if value != base else ()
            if by != "variant" and bases and not same and value != base:
                continue  # of another length than what it is compared with
            longest = bases.get(max(bases, default=0), ()) if (by, value != base) == ("variant", True) else ()
            cells = []
            for name, digits, reference in (
                ("success", 1, same or longest),
                ("trial_steps", 0, same or longest),
                ("own_success", 1, same),
            ):
                values, others = ([getattr(curves, name) for curves in side] for side in (part, reference))
                metric = "" if name == "trial_steps" else "P_scs_percent"
                gap = between(*difference(metric, values, others), digits) + " †" * separated(values, others)
                cells += [between(*over_seeds(metric, values), digits), gap]
            by_seed = " ".join("-" if (x := curves.success) != x else f"{x:.1f}" for curves in part)
            about, label = members.iloc[0], group_label([f"{value}" or "the recipe's", steps])
            lines.append([" ".join(about[name] for name in alike if about[name]), f"{about.lambda_bc:g}", label,
                          f"{recorded}", f"{N}", by_seed, *cells])  # fmt: skip
    return lines


def make_table(kind, task, runs, variants=False):
    """A task's table, kind one of METRICS, COMPARED, as (text, Markdown, DataFrame). variants: of METRICS, show runs
    with flags other than their recipe's."""
    if kind in METRICS:
        rows = table(kind, task, of_task(runs, task, variants))
        lines, notes, rows = table_lines(kind, rows), table_notes(kind, rows), rows.drop(columns="values")
        title = f"{TITLES[task]}, {kind} metrics: {NUMBERS[kind].get(task, 'no table of the paper')}, and ours"
    else:
        lines = compared_lines(kind, of_task(runs, task, variants=True))
        base = {"ablations": "the recipe", "symmetries": "no symmetry", "partitions": "K = 4"}[kind]
        notes = [
            f"Mean over seeds, difference from {base}; 95 % intervals by Student and Welch; [-]: no spread to see.",
            "†: all seeds on one side of all of the other's, by chance at most 1 time in 20 (two-sided permutation "
            "test; 3 against 3 are too few for one); near 0 or 100 % it says more than the interval.",
            "Own episodes: all of the training's, exploration included.",
        ]
        if kind == "ablations":
            notes += [
                "Where the recipe was not run at a variant's length, the reference is its longest runs, and own "
                "episodes are not compared.",
                "While training, each row explores in its own way; without `clone_iters` it begins untrained.",
            ]
        notes, rows = notes if len(lines) > 1 else ["  no runs"], pd.DataFrame(lines[1:], columns=lines[0])
        title = f"{TITLES[task]}, {kind}"
    text = "\n".join([title, "", aligned(lines), "", *notes])
    return text, "\n".join([markdown(lines), "", *(f"{note}  " for note in notes)]), rows


def aligned(lines):
    widths = [max(map(len, texts)) for texts in zip(*lines, strict=True)]
    return "\n".join("  ".join(map(str.ljust, line, widths)).rstrip() for line in lines)


def markdown(lines):
    lines = [[cell.replace("|", r"\|").replace(" *", r" \*") for cell in line] for line in lines]
    return "\n".join("| " + " | ".join(line) + " |" for line in [lines[0], ["---"] * len(lines[0]), *lines[1:]])


# ---- a task's runs as a whole ----------------------------------------------------------------------------------------


def main_group(task, runs, recipe=None):
    """The runs of the group (of this recipe) with its recipe's own symmetry and length and most runs, of the paper's
    columns where it can be."""
    runs = runs[(runs.task == task) & (runs.algo != "pid") & ((runs.recipe == recipe) | (recipe is None))]
    printed = runs.merge(columns(task)[COLUMN].drop_duplicates())
    groups = (printed if len(printed) else runs).groupby(GROUP).curves.agg(list).reset_index(name="members")
    length = [all(curves.own_length for curves in members) for members in groups.members]
    own = groups.symmetry == groups.recipe.map(OWN_SYMMETRY)  # not own_symmetry: a recipe goes before none
    groups = groups.assign(own=own, length=length, size=groups.members.map(len))
    groups = groups.sort_values(["own", "length", "size"], kind="stable")[GROUP]
    return runs[(runs[GROUP] == list(groups.iloc[-1])).all(axis=1)] if len(groups) else runs


def gaps(task, runs):
    """The commands that fill the gaps that a task's main group leaves in tables and figures, as lines to print."""
    main, lines, names = main_group(task, runs), [], []
    for column in columns(task).drop_duplicates(COLUMN).itertuples():  # P&P's (400, 15) stands in both of its sweeps
        value = {"lambda": f"={column.lambda_bc:g}", "demos": f"={column.num_demos}"}.get(column.sweep, "")
        if column.sweep != "pid" and not len(of_column(main, column)):
            names.append(column.sweep + value)
    if names:
        recipe = next(iter(set(main.recipe) & set(OWN_SYMMETRY)), "robust")
        lines.append(f"python sweep.py --task {task} --recipe {recipe} --columns {' '.join(names)} --seeds 5 --jobs 2")
    untested = [run.curves.folder for run in runs[runs.finished].itertuples() if "" not in run.curves.evaluations]
    lines += [f"python evaluate.py {os.path.relpath(folder)} --trials 500 --jobs 2" for folder in untested]
    lines += [f"python evaluate.py --pid --task {task} --gains {gains} --trials 500 --jobs 2 --out "
              f"data/runs/pid-{task}-{gains}" for gains in ("authors", "fast")
              if gains not in runs[runs.algo == "pid"].recipe.to_list()]  # fmt: skip
    if not (RESULTS / f"demos-{task}.npz").exists():
        lines += [f"python pid_demo.py --task {task} --record 40 --gains fast --out data/demos-{task}.npz",
                  f"python plot_curves.py --publish data/demos-{task}.npz"]  # fmt: skip
    return ["", f"{TITLES[task]}: to fill the gaps", *("    " + line for line in lines)] if lines else []
