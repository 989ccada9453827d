"""The paper's tables and figures beside ours, from the files in data/ alone.

    python plot_curves.py --table training --task p2p       # Table 4, and ours
    python plot_curves.py --table test --task p2p --csv p2p.csv       # Table 6
    python plot_curves.py --figure success --task p2p --runs data/runs
    python plot_curves.py --all figures    # all, and what our main recipe lacks
    python plot_curves.py --publish data/runs/NAME       # into data/results
    python plot_curves.py --report         # the pages' results, written anew

Without --runs the runs are those in data/results, and in data/runs beside this
file and in the present folder; runs with flags other than their recipe's stand
in --table ablations, partitions, and --figure symmetry, success alone then.
What the numbers are, and which runs form a group: tables.py.

A page's results stand between two lines, <!-- NAME --> and <!-- /NAME -->,
where NAME is results, verdicts, findings, beside-pid, parts, watched, cost,
demonstrator, figures, or training, test, ablations, symmetries, partitions,
figures with -p2p, -p2po, -pnp. --report rewrites what is between them in
README.md, DIFFERENCES.md and data/results/README.md from data/results, and
draws there.
"""

import math
import textwrap
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path

import gymnasium
import matplotlib
import numpy as np
import pandas as pd
from matplotlib.figure import Figure  # without pyplot: a PNG is then always drawn by Agg, no display needed
from matplotlib.lines import Line2D

import gas
import logx
import publish
import tables
from kinova_env import ACTIVE_JOINTS, EPSILON, RHO, TASKS, TIME_STEP, Z, pybullet
from logx import BadInput, flag
from tables import COLUMN, GROUP, TITLES, group_label, main_group, of_column

FIGURES = Path("figures")
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")  # Okabe & Ito: safe for colour-blind eyes
DASHES = ("-", (0, (5, 1.5)), (0, (1.5, 1)), (0, (3, 1, 1, 1)))  # where the colours begin again
GREEN, GREY, BORDER = COLOURS[2], "#555555", (0, (4, 2))  # the tube of reachable positions, the borders of sectors
LOOK = {"font.family": "STIXGeneral", "mathtext.fontset": "stix", "font.size": 8, "legend.fontsize": 7,
        "legend.title_fontsize": 7, "legend.frameon": False, "axes.spines.top": False, "axes.spines.right": False,
        "axes.titlesize": 8.5, "pdf.fonttype": 42}  # fmt: skip
OF_TASK = ("learning", "success", "symmetry", "error", "demos", "trajectories")
OF_NO_TASK = ("partitions", "workspace")
DRAWINGS = OF_TASK + OF_NO_TASK


@dataclass
class Flags:
    table: str | None = flag(None, "print a table", choices=(*tables.METRICS, *tables.COMPARED))
    figure: str | None = flag(None, "draw a figure", choices=DRAWINGS)
    all: Path | None = flag(
        None, "every table and figure, and the commands for what our main recipe lacks", metavar="FOLDER"
    )
    publish: tuple[Path, ...] | None = flag(None, "run folders, files of pid_demo.py --record", metavar="RUN")
    report: bool = flag(False, "rewrite the results on the pages")
    task: str | None = flag(None, "with --table and --figure", choices=tuple(TASKS))
    runs: tuple[Path, ...] | None = flag(None, "run folders, or folders with some below them", metavar="FOLDER")
    recipe: str | None = flag(None, "with --figure learning and error: whose runs; those with most", metavar="NAME")
    demos: Path | None = flag(None, "with --figure demos: a file of pid_demo.py --record", metavar="FILE")
    csv: Path | None = flag(None, "with --table: as CSV too", metavar="FILE")
    out: Path | None = flag(None, "with --figure: a .png or .pdf; figures/fig-NAME-TASK", metavar="FILE")


# ---- figures ---------------------------------------------------------------------------------------------------------
# A function a figure: (task, its runs, flags) -> Figure, or None where there is nothing to draw.


def column_label(column, sweep=None):
    """What a sweep of the paper varies in this column; all of it for other columns."""
    texts = {"lambda": rf"$\lambda_{{BC}}={column.lambda_bc:g}$", "demos": rf"$N_{{demos}}={column.num_demos}$"}
    both = f"{texts['demos']}, {texts['lambda']}"
    return (texts | {"baseline": f"{column.algo.upper()}"}).get(sweep or column.sweep, both)


def seeds_label(runs):
    return f"{len(runs)} seed{'s' * (len(runs) > 1)}" + f", {sum(~runs.finished)} unfinished" * (not all(runs.finished))


def style(i):
    return {"color": COLOURS[i % len(COLOURS)], "linestyle": DASHES[i // len(COLOURS) % len(DASHES)]}


def title(figure, task, group, runs):
    """Says which group is drawn. Returns a sentence with the recipe's other groups, which are not."""
    label = group_label(group[GROUP].iloc[0])
    figure.suptitle(f"{TITLES[task]}: {label}", fontsize=9)
    others = runs[(runs.recipe == group.recipe.iloc[0]) & (runs.algo != "pid")][GROUP].drop_duplicates().to_numpy()
    hidden = [group_label(other) for other in others if group_label(other) != label]
    return f"Not drawn: {', '.join(hidden)}." if hidden else ""


def caption(figure, *sentences):
    """Text below all panels, for which the layout leaves room."""
    width = int(figure.get_figwidth() * 22)  # letters that fit on a line
    figure.supxlabel(textwrap.fill(" ".join(filter(None, sentences)), width), fontsize=6.5, color=GREY)


BAND = "Mean over seeds and its 95 % band (Student)."
ENDS = "A line ends with the shortest of its runs."


def draw_band(ax, x, values, label, metric="", **look):
    """The mean of values (seeds, n) over x, and its Student band where there are two seeds."""
    mean, low, high = np.transpose([tables.over_seeds(metric, seeds) for seeds in values.T])
    ax.plot(x, mean, label=label, linewidth=1.3, **look)
    ax.fill_between(x, low, high, color=look["color"], alpha=0.18, linewidth=0)


def draw_curve(ax, runs, label, **look):
    """Return over episodes, as far as every seed goes."""
    curves = [tables.running_mean(curves.episodes["return"]) for curves in runs.curves]
    every = min(map(len, curves))
    curves = np.array([curve[:every] for curve in curves])
    start = min(9, every // 2)  # the mean of one or two returns is noise that would set the scale of the axis
    shown = np.unique(np.linspace(start, every - 1, 200).astype(int))
    draw_band(ax, shown + 1, curves[:, shown], f"{label} ({seeds_label(runs)})", **look)


def named(runs, flags):
    """{label: runs} of each group and column, where --runs names runs of several groups: all of them are drawn."""
    runs = runs[runs.algo != "pid"]
    if not flags.runs or flags.recipe or len(runs[GROUP].drop_duplicates()) < 2:
        return {}
    groups = runs.groupby([*GROUP, *COLUMN[1:]])
    return {f"{group_label(group)}, $N_{{demos}}={N}$, " + rf"$\lambda_{{BC}}={lam:g}$": members
            for (*group, N, lam), members in groups}  # fmt: skip


def named_learning_figure(task, lines):
    """Return over training episodes, a line for each of `named`."""
    figure = Figure(figsize=(5.4, 3.4), layout="constrained")
    ax = figure.add_subplot()
    for i, (label, members) in enumerate(lines.items()):
        draw_curve(ax, members, label, **style(i))
    ax.set(xlabel="episode", ylabel=f"return (mean of last {tables.WINDOW} episodes)", xlim=(0, None))
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.17))
    figure.suptitle(TITLES[task], fontsize=9)
    caption(figure, BAND, ENDS)
    return figure


def learning_figure(task, runs, flags):
    """Return over training episodes, a panel for each sweep of the paper (Fig. 6, 7, 8)."""
    if lines := named(runs, flags):
        return named_learning_figure(task, lines)
    group, panels = main_group(task, runs, flags.recipe), {"lambda": [], "demos": []}
    if not len(group):
        return None
    found = [column for column in tables.columns(task, group).itertuples() if column.sweep != "pid"]
    empty = [column_label(column) for column in found if not len(of_column(group, column))]
    drawn = [column for column in found if len(of_column(group, column))]
    printed = [column for column in drawn if column.sweep != "other"]
    for column in printed or drawn:
        for sweep in panels if column.sweep in ("baseline", "other") else [column.sweep]:
            panels[sweep].append(column)
    swept = {sweep: drawn for sweep, drawn in panels.items() if sweep in [column.sweep for column in drawn]}
    panels = swept or {"lambda": panels["lambda"]}  # a panel without a run of its sweep would say nothing new
    figure = Figure(figsize=(3.2 * len(panels) + 0.8 * (len(panels) == 1), 3.4), layout="constrained")
    axes = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    for ax, (sweep, drawn) in zip(axes, panels.items(), strict=True):
        for i, column in enumerate(drawn):
            look = {"color": GREY} if column.sweep == "baseline" else style(i)
            draw_curve(ax, of_column(group, column), column_label(column), **look)
            if math.isfinite(column.R90):
                ax.axhline(column.R90, color=look["color"], linestyle=":", linewidth=0.8, zorder=1)
        ax.plot([], [], "k:", linewidth=0.8, label=r"the paper's $\overline{R}_{90}$, in its line's colour")
        varied, fixed = (r"$\lambda_{BC}$", "demos") if sweep == "lambda" else ("$N_{demos}$", "lambda")
        at = [column_label(column, fixed) for column in drawn if column.sweep == sweep]
        ax.set(title=f"effect of {varied} at {at[0]}" if at else "", xlabel="episode", xlim=(0, None))
        ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.17), ncols=2)
    heights = np.concatenate([line.get_ydata() for ax in axes for line in ax.lines])
    ends = min(heights) - 0.5, max(heights) + 0.5  # not those of the bands: two seeds' would set the scale
    axes[0].set(ylim=ends, ylabel=f"return (mean of last {tables.WINDOW} episodes)")
    hidden = title(figure, task, group, runs)
    caption(figure, BAND, ENDS, f"No runs yet: {', '.join(empty)}." if empty else "", hidden)
    return figure


def success_figure(task, runs, flags):
    """Success in the trials while training over environment steps, a line a method: of a recipe and symmetry the
    paper's best column, with other demonstrations (--demos) too, and the one without any; of other algorithms, and
    where --runs names runs, all."""
    best = tables.best_column(task, runs)
    if not flags.runs:
        runs = pd.concat((tables.of_task(runs, task), runs[runs.variant.str.fullmatch("demos=[^=]*")]))
    runs = runs[np.array([len(curves.validation) > 0 for curves in runs.curves], bool)]
    plain, other = (runs.num_demos == 0) & (runs.lambda_bc == 0), runs.algo != best.algo
    at_best = (runs[COLUMN] == [getattr(best, name) for name in COLUMN]).all(axis=1)
    shown, lines = runs if flags.runs else runs[plain | other | at_best], {}
    for (algo, *rest, N, lam), members in shown.groupby([*GROUP[:-1], *COLUMN[1:]]):
        members = members[members.total_env_steps == members.total_env_steps.max()]
        label = group_label([algo.upper() * (algo != best.algo), *rest, 0])
        if (N, lam) != (best.num_demos, best.lambda_bc):
            label += f", $N_{{demos}}={N}$" + rf", $\lambda_{{BC}}={lam:g}$" * (lam != (best.lambda_bc if N else 0))
        trials = pd.concat([curves.validation for curves in members.curves], axis=1).sort_index()
        lines[f"{label} ({seeds_label(members)})"] = trials
    if not lines:
        return None
    figure = Figure(figsize=(5.4, 2.9 + 0.07 * len(lines)), layout="constrained")
    ax = figure.add_subplot()
    for i, (label, trials) in enumerate(sorted(lines.items(), key=lambda line: -line[1].mean(axis=None))):
        draw_band(ax, trials.index, trials.to_numpy().T, label, "P_scs_percent", marker=".", markersize=4, **style(i))
    ax.set(xlabel="environment steps", ylabel="success in validation trials (%)", ylim=(-2, 102), xscale="log")
    ticks = [n * 10**k for k in range(3, 7) for n in (1, 2, 5) if ax.get_xlim()[0] <= n * 10**k <= ax.get_xlim()[1]]
    ax.set_xticks(ticks, [f"{tick:,}" for tick in ticks])
    ax.minorticks_off()
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=2)
    figure.suptitle(f"{TITLES[task]}: {best.algo.upper()} at {column_label(best, 'both')} where not said otherwise")
    hidden = len(runs[COLUMN].drop_duplicates()) - len(shown[COLUMN].drop_duplicates())
    caption(figure, BAND, "Where lengths alone differ, the longest runs.",
            f"Not drawn: {hidden} other pairs of $N_{{demos}}$ and $\\lambda_{{BC}}$." if hidden else "")  # fmt: skip
    return figure


def symmetry_figure(task, runs, flags):
    """Test success over the number of recorded demonstrations, a line a symmetry; and of `gas` over the number of
    partitions K, at as many recorded and at as many after mapping. Robust runs, of the length of most symmetries."""
    best = tables.best_column(task, runs)
    runs = runs[(runs.algo == best.algo) & (runs.recipe == "robust") & (runs.lambda_bc == best.lambda_bc)]
    runs = runs[(runs.num_demos > 0) & runs.variant.str.fullmatch(r"(partitions=\d+)?")]
    runs = runs[runs.finished].assign(success=lambda runs: [curves.success for curves in runs.curves])
    runs = runs.dropna(subset="success")
    lengths = runs.groupby("total_env_steps").symmetry.agg(["nunique", "size"]).sort_values(["nunique", "size"])
    runs = runs[runs.total_env_steps.isin(lengths.index[-1:])]
    over_K, over_n = runs[runs.symmetry == "gas"], runs[runs.variant == ""]
    if over_n.recorded.nunique() < 2:
        return None
    lines = {"recorded": dict(list(over_n.groupby("symmetry"))), "K": {}}
    for fixed, text in (("recorded", "recorded demonstrations"), ("num_demos", r"$N_{demos}$")):
        counts = over_K.groupby(fixed).K.nunique()
        if counts.max() > 1:  # where most K are
            n = counts[counts == counts.max()].index[0]
            lines["K"][f"{n} {text}" if fixed == "recorded" else f"{text[:-1]}={n}$"] = over_K[over_K[fixed] == n]
    panels = [x for x in lines if lines[x]]
    figure = Figure(figsize=(3.2 * len(panels) + 0.8 * (len(panels) == 1), 3.2), layout="constrained")
    axes = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    labels = dict.fromkeys((*gas.SYMMETRIES, *lines["recorded"], *lines["K"]))
    looks = {label: style(i) for i, label in enumerate(labels)}  # of a symmetry the same on every task
    for ax, x in zip(axes, panels, strict=True):
        for i, (label, part) in enumerate(lines[x].items()):
            look = looks[label]
            part = part.sort_values("num_demos").drop_duplicates(["seed", x], keep="last")
            values = part.groupby(x).success.agg(list)
            n = sorted(set(map(len, values)))
            label += f" ({' to '.join(map(str, dict.fromkeys((n[0], n[-1]))))} seed{'s' * (n[-1] > 1)})"
            mean, low, high = np.transpose([tables.over_seeds("P_scs_percent", seeds) for seeds in values])
            at = values.index * 1.03 ** (i - (len(lines[x]) - 1) / 2)  # side by side
            ax.plot(at, mean, label=label, linewidth=1.1, marker=".", **look)
            ax.errorbar(at, mean, (mean - low, high - mean), fmt="none", ecolor=look["color"], elinewidth=0.7)
            single = values.map(len) == 1
            ax.scatter(at[single], mean[single], 4, color="w", zorder=3)
        texts = {"recorded": ("recorded demonstrations", "all symmetries, $K=4$"),
                 "K": ("number of partitions $K$", "the paper's map (gas), all $K$")}  # fmt: skip
        ax.set(xscale="log", xlabel=texts[x][0], title=texts[x][1], ylim=(-2, 102))
        ticks = []  # those of which the texts do not overlap
        for tick in sorted({value for part in lines[x].values() for value in part[x]}, reverse=True):
            ticks += [tick] * (not ticks or ticks[-1] / tick > 1.4)
        ax.set_xticks(ticks, [f"{tick}" for tick in ticks])
        ax.minorticks_off()
        ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.17), ncols=1 + (x == "recorded"))
    axes[0].set_ylabel("success in test trials (%)")
    steps = int(over_n.total_env_steps.iloc[0])
    figure.suptitle(f"{TITLES[task]}: {best.algo.upper()} robust, {steps:,} environment steps", fontsize=9)
    caption(figure, "Mean over seeds and its 95 % interval (Student); hollow: a single seed.")
    return figure


def error_figure(task, runs, flags):
    """||e_t|| over all successful test trials, a panel a column with more than 5 % of them (Fig. 10, 11, 12). A trial
    that has ended keeps its last error: each counts alike at every t."""
    group, panels = main_group(task, runs, flags.recipe), {}
    of_all = named(runs, flags)
    parts = of_all or {column_label(column, "both"): of_column(group, column)
                       for column in tables.columns(task, group).drop_duplicates(COLUMN).itertuples()
                       if column.sweep != "pid"}  # fmt: skip
    for label, part in parts.items():
        tested = [curves for curves in part.curves if curves.trajectories.exists()]
        errors = [error for curves in tested for error in tables.read_errors(curves.trajectories)]
        tried = sum(len(curves.evaluations[""]) for curves in tested if "" in curves.evaluations)
        if 100 * len(errors) > publish.LEAST * tried:  # of fewer, those of the nearest goals alone
            seeds = f"{len(tested)} seed{'s' * (len(tested) > 1)}"
            head = textwrap.fill(label, 34) if of_all else label
            panels[f"{head}\n{len(errors):,} of {max(tried, len(errors)):,} trials, {seeds}"] = errors
    if not panels:
        return None
    rows, across = math.ceil(len(panels) / 3), min(3, len(panels))
    figure = Figure(figsize=(2 * across + 1.6 * (across == 1), 1.7 * rows + 0.8), layout="constrained")
    axes = figure.subplots(rows, across, sharex=True, sharey=True, squeeze=False).flat
    for ax, (label, errors) in zip(axes, panels.items(), strict=False):
        longest = max(map(len, errors))
        errors = 100.0 * np.array([np.pad(error, (0, longest - len(error)), mode="edge") for error in errors], float)
        t, mean, deviation = TIME_STEP * np.arange(longest), errors.mean(axis=0), errors.std(axis=0)
        ax.fill_between(t, np.maximum(mean - deviation, 0), mean + deviation, color=COLOURS[0], alpha=0.2, linewidth=0)
        ax.plot(t, mean, color=COLOURS[0], linewidth=1.2)
        ax.axhline(100 * EPSILON, color="k", linestyle=":", linewidth=0.8)
        ax.set(xlabel="$t$ (s)", ylabel=r"$\Vert e_t\Vert$ (cm)")
        ax.set_title(label, fontsize=7)
    axes[0].set(xlim=(0, None), ylim=(0, None))  # of all that is drawn
    for ax in figure.axes:
        ax.label_outer()
        ax.set_visible(ax.has_data())
    for ax in figure.axes[max(0, len(panels) - across) : len(panels)]:  # the lowest of each column
        ax.tick_params(labelbottom=True)
        ax.set_xlabel("$t$ (s)")
    if of_all:
        hidden = ""
        figure.suptitle(TITLES[task], fontsize=9)
    else:
        hidden = title(figure, task, group, runs)
    caption(figure, r"Mean $\pm$ standard deviation over all successful test trials; dotted: $\epsilon$. A trial that "
            "has ended keeps its last error.", f"Not drawn: columns with success in at most {publish.LEAST} %.",
            hidden)  # fmt: skip
    return figure


CIRCLE = np.linspace(0, 2 * math.pi, 181)


def draw_ring(ax, borders):
    """The workspace seen from above: the tube of reachable rho and the sectors' borders (their angles, rad)."""
    for rho in RHO:
        ax.plot(rho * np.cos(CIRCLE), rho * np.sin(CIRCLE), color=GREEN, linewidth=0.8)
    for theta in borders:
        x, y = np.multiply(RHO, math.cos(theta)), np.multiply(RHO, math.sin(theta))
        ax.plot(x, y, color=GREY, linewidth=0.8, linestyle=BORDER)
    ax.set(aspect="equal", xlabel="$x$ (m)", ylabel="$y$ (m)", xticks=[-0.5, 0, 0.5], yticks=[-0.5, 0, 0.5])


def draw_paths(task, paths, text):
    """TCP paths (tables.read_paths) from above and in 3-D, in the tube of reachable positions; the colour is the goal's
    sector."""
    if not paths:
        return None
    first = TASKS[task].sector_offset * math.pi / 2  # S_1's start angle, the centre of its sector
    borders, (low, high) = first + math.pi / 4 + math.pi / 2 * np.arange(4), Z
    figure = Figure(figsize=(5.4, 3.1), layout="constrained")
    plan, space = figure.add_subplot(1, 2, 1), figure.add_subplot(1, 2, 2, projection="3d")
    draw_ring(plan, borders)
    for rho, z in product(RHO, Z):
        space.plot(rho * np.cos(CIRCLE), rho * np.sin(CIRCLE), z, color=GREEN, linewidth=0.6, alpha=0.8)
    for k, theta in enumerate(borders):
        corners = np.array([*RHO, *RHO[::-1], RHO[0]])
        space.plot(corners * math.cos(theta), corners * math.sin(theta), [low, low, high, high, low], color=GREY,
                   linewidth=0.6, linestyle=BORDER)  # fmt: skip
        x, y = 0.2 * math.cos(theta - math.pi / 4), 0.2 * math.sin(theta - math.pi / 4)
        plan.text(x, y, rf"$\mathcal{{S}}_{k + 1}$", ha="center", va="center", color=COLOURS[k])
    marks = {"start": ("o", "k", 3), "goal": ("*", None, 6), "obstacle" if task == "p2po" else "cube": ("s", GREY, 3)}
    for path in paths:
        k = round((math.atan2(path["goal"][1], path["goal"][0]) - first) / (math.pi / 2)) % 4
        for ax, n in ((plan, 2), (space, 3)):
            ax.plot(*path["tcp"].T[:n], color=COLOURS[k], linewidth=0.9, alpha=0.85)
            points = path["tcp"][0], path["goal"], path["object"]  # NaN: nothing is drawn
            for point, (marker, colour, size) in zip(points, marks.values(), strict=True):
                ax.plot(*point[:n, None], marker, color=colour or COLOURS[k], markersize=size, markeredgecolor="k",
                        markeredgewidth=0.3)  # fmt: skip
    space.text2D(0.98, 0.8, "$z$ (m)", ha="right", transform=space.transAxes)  # zlabel would be cut off
    limits = (-RHO[1], RHO[1])
    space.set(xlabel="$x$ (m)", ylabel="$y$ (m)", xticks=[-0.5, 0, 0.5], yticks=[-0.5, 0, 0.5],
              zticks=[0.2, 0.4, 0.6], xlim=limits, ylim=limits, zlim=(low - 0.1, high + 0.1))  # fmt: skip
    space.set_box_aspect((1.4, 1.4, 0.6), zoom=1.0)
    space.view_init(elev=28, azim=-60)
    space.tick_params(pad=-2)
    figure.suptitle(f"{TITLES[task]}: {text}; colours: the goal's sector", fontsize=8.5)
    lines = [Line2D([], [], linestyle="", marker=marker, color=colour or "w", markeredgecolor="k", markersize=5,
                    markeredgewidth=0.4, label=label)
             for label, (marker, colour, _) in list(marks.items())[: 2 if task == "p2p" else 3]]  # fmt: skip
    for colour, dashes, label in ((GREEN, "-", r"reachable $\rho$, $z$"), (GREY, BORDER, r"border of $\mathcal{S}_k$")):
        lines.append(Line2D([], [], color=colour, linewidth=0.8, linestyle=dashes, label=label))
    figure.legend(handles=lines, loc="outside lower center", ncols=len(lines))
    return figure


def demos_figure(task, runs, flags):
    """The first 20 successful demonstrations of --demos, or of data/results (Fig. 5)."""
    path = flags.demos or tables.RESULTS / f"demos-{task}.npz"
    recorded, paths = tables.read_paths(path) if flags.demos or path.exists() else (task, [])
    if recorded not in (task, None):
        raise BadInput(f"--demos {path}: recorded on task {recorded}, not on --task {task}")
    return draw_paths(task, [path for path in paths if path["success"]][:20], "demonstrations")


def trajectories_figure(task, runs, flags):
    """The successful ones of the first 20 test trials of the run with the highest P_scs, of the main group where one of
    it has been tested (Fig. 9)."""
    tested = [run for run in runs.itertuples()
              if not run.curves.pid and run.curves.trajectories.exists() and run.curves.success >= 0]  # fmt: skip
    main = main_group(task, runs).index
    best = max(tested, key=lambda run: (run.Index in main, run.curves.success), default=None)
    if best is None:
        return None
    paths = [path for path in tables.read_paths(best.curves.trajectories)[1] if path["success"]]
    label = group_label([getattr(best, name) for name in GROUP])
    return draw_paths(task, paths, f"successful test trials, {label}, seed {best.seed}")


def random_paths(rng, n, sectors, K):
    """n 2-D paths as Fig. 4 has them: a random way point (theta, rho) in each of these sectors out of K, linear in
    between in cylinder coordinates. Returns (n, M, 2) points x, y in m; every 50th is a way point."""
    t = np.linspace(0, len(sectors) - 1, 50 * (len(sectors) - 1) + 1)
    weight = np.maximum(0, 1 - np.abs(t - np.arange(len(sectors))[:, None]))  # of each way point at each t
    theta = 2 * math.pi / K * (np.asarray(sectors) + rng.random((n, len(sectors)))) @ weight
    rho = rng.uniform(*RHO, (n, len(sectors))) @ weight
    return np.stack([rho * np.cos(theta), rho * np.sin(theta)], axis=-1)


def path_lengths(K, n=1000, seed=0):
    """Lengths (n,) in m of random demonstrations, from a point of a sector to another of the same, and of random
    regular paths, from one sector to the furthest opposite one with a way point in each between. K = 1: the same."""
    rng = np.random.default_rng(seed)
    demos, regular = (np.linalg.norm(np.diff(random_paths(rng, n, sectors, K), axis=1), axis=2).sum(axis=1)
                      for sectors in ([0, 0], range(K // 2 + 1)))  # fmt: skip
    return demos, demos if K == 1 else regular


def partitions_figure(task=None, runs=None, flags=None):
    """What partitions do to path lengths (Fig. 4): paths at K = 4, and their lengths over K = 1 ... 12."""
    figure = Figure(figsize=(5.4, 2.6), layout="constrained")
    plan, curves = figure.subplots(1, 2, width_ratios=(1, 1.3))
    rng = np.random.default_rng(3)
    draw_ring(plan, math.pi / 2 * np.arange(4))
    for colour, label, routes in ((COLOURS[0], r"demonstrations $\tau^d$", [[k, k] for k in (0, 1, 2, 3) * 2]),
                                  (COLOURS[1], r"regular paths $\tau$", [range(3), range(2, 5)])):  # fmt: skip
        plan.plot([], [], color=colour, label=label)
        for sectors in routes:
            (path,) = random_paths(rng, 1, sectors, 4)
            plan.plot(*path.T, color=colour, linewidth=1.2)
            plan.plot(*path[:-1:50].T, "o", color=colour, markersize=2.5)
            plan.plot(*path[-1], "*", color=colour, markersize=6)
    plan.legend(loc="lower center", bbox_to_anchor=(0.5, 1), ncols=2, columnspacing=0.8, handlelength=1.4)
    K, lengths = np.arange(1, 13), [path_lengths(K) for K in range(1, 13)]
    for colour, marker, label, lines in (
            (COLOURS[0], "o", r"$L(\tau^d)/R$", [demo / RHO[1] for demo, _ in lengths]),
            (COLOURS[1], "s", r"$L(\tau^d)/L(\tau)$", [demo / path.mean() for demo, path in lengths])):  # fmt: skip
        means, ends = [line.mean() for line in lines], np.transpose([np.quantile(line, (0.25, 0.75)) for line in lines])
        curves.plot(K, means, color=colour, marker=marker, markersize=3, linewidth=1.2, label=label)
        curves.fill_between(K, *ends, color=colour, alpha=0.18, linewidth=0)
    curves.axvspan(3.6, 4.4, color=COLOURS[3], alpha=0.3, linewidth=0, label="$K=4$")
    curves.set(xlabel="number of partitions $K$", ylabel="ratio of lengths", xticks=K, ylim=(0, None))
    curves.legend(title="mean and middle half\nof 1,000 random paths")
    return figure


def workspace_figure(task=None, runs=None, flags=None):
    """The arm in the tube of reachable rho and z (Fig. 3), which is drawn over PyBullet's picture."""
    env = gymnasium.make(TASKS["p2p"].env_id, render_mode="rgb_array", disable_env_checker=True).unwrapped
    env.reset(seed=0, options={"start": (-math.pi / 4, 0.52, 0.42), "goal": (2.4, 0.6, 0.5)})
    width, height, client = 1200, 1000, env._client
    view = pybullet.computeViewMatrixFromYawPitchRoll([0, 0, 0.3], 2.0, 20, -20, 0, 2)
    lens = pybullet.computeProjectionMatrixFOV(42, width / height, 0.1, 5)
    *_, rgba, _, link = pybullet.getCameraImage(width, height, view, lens, lightDirection=[0.6, -0.8, 1.6],
                                                renderer=pybullet.ER_TINY_RENDERER, physicsClientId=client)  # fmt: skip
    robot = np.reshape(link, (height, width)) == env._robot
    arm = np.where(robot[..., None], np.reshape(rgba, (height, width, 4)).astype(np.uint8), 0)
    arm[..., 3] = 255 * robot
    joints = [pybullet.getLinkState(env._robot, joint, physicsClientId=client)[4] for joint in ACTIVE_JOINTS]
    env.close()
    camera = np.reshape(lens, (4, 4)).T @ np.reshape(view, (4, 4)).T

    def pixels(points):
        clip = np.column_stack((points, np.ones(len(points)))) @ camera.T
        return (clip[:, :2] / clip[:, 3:] * (0.5, -0.5) + 0.5) * (width, height)

    figure = Figure(figsize=(3.6, 2.3), layout="constrained")
    ax = figure.add_subplot()
    ax.imshow(arm, zorder=2)
    to_camera = math.radians(20 - 90)  # azimuth of the camera, seen from the base
    for rho, (a, b) in product(RHO, zip(CIRCLE[:-1:3], CIRCLE[3::3], strict=True)):
        before = 3 if rho == RHO[1] and math.cos((a + b) / 2 - to_camera) > 0 else 1  # the arm
        around = [(a, Z[0]), (b, Z[0]), (b, Z[1]), (a, Z[1])]
        corners = [(rho * math.cos(theta), rho * math.sin(theta), z) for theta, z in around]
        x, y = pixels(np.array(corners)).T
        ax.fill(x, y, color=GREEN, alpha=0.12, linewidth=0, zorder=before)
        for i in (0, 2):
            ax.plot(x[i : i + 2], y[i : i + 2], color="#00664B", linewidth=0.8, zorder=before)
    for n, (x, y) in enumerate(pixels(np.array(joints)), start=1):
        ax.annotate(f"#{n}", (x, y), (x - 170, y - 40), va="center", ha="right", fontsize=7.5, zorder=5,
                    arrowprops={"arrowstyle": "-", "linewidth": 0.6})  # fmt: skip
    ax.set(xlim=(70, width - 70), ylim=(height - 160, 190))
    ax.axis("off")
    ax.set_title(rf"${RHO[0]}\leq\rho<{RHO[1]}$ m,  ${Z[0]}\leq z<{Z[1]}$ m", y=-0.02, color="#00664B")
    return figure


# ---- files -----------------------------------------------------------------------------------------------------------


def save_figure(name, task, runs, flags, paths, dpi=200):
    """Whether there was something to draw."""
    methods = name in ("symmetry", "success")  # K's, and other demonstrations too
    runs = tables.of_task(runs, task, variants=bool(flags.runs) or methods) if task else None
    if methods and not len(runs):
        return False
    with matplotlib.rc_context(LOOK):  # some texts come into being while it is drawn
        figure = globals()[f"{name}_figure"](task, runs, flags)
        for path in paths if figure else ():
            kind, stable = path.suffix[1:], {"CreationDate": None} if path.suffix == ".pdf" else {}
            publish.write(path, partial(figure.savefig, format=kind, dpi=dpi, metadata=stable))
            figure.set_layout_engine("none")  # laid out once is enough
    return bool(figure)


def save_figures(folder, runs, flags, ends, dpi=200):
    """Every figure; learning and error of each recipe of the paper's algorithm. Returns their names, without ending."""
    names = []
    for task, name in [*product(TASKS, OF_TASK), *product([None], OF_NO_TASK)]:
        recipes = [None]
        if name in ("learning", "error") and len(shown := tables.of_task(runs, task, variants=bool(flags.runs))):
            of_paper = shown[shown.algo == tables.best_column(task, shown).algo].recipe
            recipes += sorted(set(of_paper) - set(main_group(task, shown).recipe))
        for recipe in recipes:
            file = "-".join(filter(None, ("fig", name, task, recipe)))
            paths = [folder / (file + end) for end in ends]
            names += [file] * save_figure(name, task, runs, replace(flags, recipe=recipe), paths, dpi)
    return names


# ---- main ------------------------------------------------------------------------------------------------------------


def draw_all(flags):
    """Every table and figure into the folder --all. Returns remarks."""
    runs, remarks = tables.find_runs(flags.runs)
    for kind, task in product((*tables.METRICS, *tables.COMPARED), TASKS):
        text, _, frame = tables.make_table(kind, task, runs, bool(flags.runs))
        publish.write(flags.all / f"table-{kind}-{task}.txt", text + "\n")
        publish.write(flags.all / f"table-{kind}-{task}.csv", frame.to_csv(index=False))
    names = save_figures(flags.all, runs, flags, (".png", ".pdf"))
    remarks.append(f"wrote the tables and {len(names)} figures into {flags.all}")
    return remarks + [line for task in TASKS for line in tables.gaps(task, tables.of_task(runs, task))]


def check(flags):
    """Raises BadInput where flags do not go together."""
    jobs = [name for name in ("table", "figure", "all", "publish", "report") if getattr(flags, name)]
    if len(jobs) != 1:
        raise BadInput("--table, --figure, --all, --publish, --report: one of them is expected")
    of_task = bool(flags.table or flags.figure) and flags.figure not in OF_NO_TASK
    if bool(flags.task) != of_task:
        raise BadInput(f"--task: one of {', '.join(TASKS)}, with --table, and --figure {', '.join(OF_TASK)}")
    for name, allowed in (("runs", of_task or flags.all), ("recipe", flags.figure in ("learning", "error")),
                          ("demos", flags.figure == "demos"), ("csv", flags.table), ("out", flags.figure)):  # fmt: skip
        if getattr(flags, name) and not allowed:
            raise BadInput(f"--{name}: does not go with --{jobs[0]}; see --help")
    if flags.out and flags.out.suffix not in (".png", ".pdf"):
        raise BadInput(f"--out {flags.out}: a name that ends in .png or .pdf is expected")


def main(argv=None):
    flags = logx.parse_flags(Flags, __doc__, argv)
    check(flags)
    if flags.publish:
        return print("\n".join(publish.publish(flags.publish)))
    if flags.all:
        return print("\n".join(draw_all(flags)))
    if flags.report:
        publish.marked_pages()  # what is wrong with one is said before anything is written
        names = save_figures(tables.RESULTS, tables.find_runs([tables.RESULTS])[0], flags, (".png",), dpi=130)
        figures = [tables.RESULTS / f"{name}.png" for name in names]
        for path in set(tables.RESULTS.glob("fig-*.png")) - set(figures):
            path.unlink()
        for page, text in publish.report(figures).items():
            publish.write(page, text)
            print(f"wrote {page}")
        return
    runs, remarks = tables.find_runs(flags.runs) if flags.task else (None, [])
    if flags.runs and not len(tables.of_task(runs, flags.task, variants=True)):
        raise BadInput(f"--runs: no run of task {flags.task} among the {len(runs)} found")
    if flags.recipe and flags.recipe not in (recipes := sorted(set(runs[runs.task == flags.task].recipe))):
        raise BadInput(f"--recipe {flags.recipe}: the runs of task {flags.task} are of {', '.join(recipes) or 'none'}")
    if flags.table:
        text, _, frame = tables.make_table(flags.table, flags.task, runs, bool(flags.runs))
        if flags.csv:
            publish.write(flags.csv, frame.to_csv(index=False))
        return print(text, "", *remarks, sep="\n")
    name = "-".join(filter(None, ("fig", flags.figure, flags.task, flags.recipe)))
    paths = [flags.out] if flags.out else [FIGURES / f"{name}{end}" for end in (".png", ".pdf")]
    if not save_figure(flags.figure, flags.task, runs, flags, paths):
        raise BadInput(f"--figure {flags.figure}: nothing to draw for --task {flags.task}; --runs FOLDER names runs")
    print(*remarks, *(f"wrote {path}" for path in paths), sep="\n")


if __name__ == "__main__":
    logx.run_script(main)
