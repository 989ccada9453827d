"""Runs into data/results (`plot_curves.py --publish RUN...`), and what they say onto the pages (`--report`).

The pages' tables are made here, of what tables.py measures: the results, the findings (each claim of the paper, and the
difference that stands for it), what went on inside the agents, the demonstrator.
"""

import gzip
import io
import json
import math
import os
import re
import shutil
from collections import Counter
from functools import partial
from itertools import product

import numpy as np
import pandas as pd

import evaluate
import logx
import pid_demo
import tables
from kinova_env import TASKS
from logx import BadInput
from tables import (
    COLUMN,
    COMPARED,
    GROUP,
    HERE,
    METRICS,
    NUMBERS,
    TITLES,
    best_column,
    between,
    columns,
    group_label,
    main_group,
    make_table,
    markdown,
    of_column,
)

TRIALS = 500  # of the test study
PRINTED = tuple(NUMBERS["training"])  # a task that the paper does not have is on no page
PAGES = (HERE / "README.md", HERE / "DIFFERENCES.md", HERE / "data/results/README.md")
INDEX_COLUMNS = ["name", "task", *GROUP[:-1], "num_demos", "lambda_bc", "seed", "env_steps", "finished", "eval_success",
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
    """{file name: bytes} that --publish writes of a run, which may lie in another clone's data/results. Raises BadInput
    where its files do not fit together, and of a run without a clean commit."""
    run, flag = tables.Curves(folder), f"--publish {folder}"
    if folder.resolve().is_relative_to(tables.RESULTS.resolve()):
        raise BadInput(f"{flag}: is published already")
    if not re.fullmatch("[0-9a-f]{40}", run.row["commit"]):
        raise BadInput(f"{flag}: made with git commit {run.row['commit']}; a clean one is expected")
    if "" in run.evaluations and run.evaluations[""].trial.to_list() != list(range(TRIALS)):
        raise BadInput(f"{flag}: evaluation.csv is not of trials 0 to {TRIALS - 1}; run evaluate.py {folder} again")
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
    for path in sorted([*folder.glob("*.csv.gz"), *folder.glob("*.csv")]):  # mtime=0: the same bytes each time
        data = path.read_bytes() if path.suffix == ".gz" else gzip.compress(path.read_bytes(), mtime=0)
        files[f"{path.name.removesuffix('.gz')}.gz"] = data
    printed = tables.columns(run.row["task"])
    column = (run.row["num_demos"], run.row["lambda_bc"]) in set(zip(printed.num_demos, printed.lambda_bc, strict=True))
    drawn = (run.pid or run.own_flags) and column
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
    """Copies run folders and demonstration files into data/results, keeps the weights of one run of each task,
    algorithm and recipe, of the best column the best in validation, and writes index.csv. Returns remarks."""
    results, found = tables.RESULTS, {}
    for path in sources:  # all of them are read before anything is written
        if path.suffix == ".npz":
            task, paths = tables.read_paths(path)
            if not task:
                raise BadInput(f"--publish {path}: a file of pid_demo.py --record is expected")
            target, files = results / f"demos-{task}.npz", packed(paths[:40])
        else:
            target, files = results / path.resolve().name, files_of_run(path)
        if target in found:
            raise BadInput(f"--publish {path}: is a second {target.name}; one would replace the other")
        found[target] = files
    for target, files in found.items():
        if isinstance(files, bytes):
            write(target, files)
            continue
        part = results / f".{target.name}.part"
        shutil.rmtree(part, ignore_errors=True)
        for name, data in reversed(files.items()):  # config.json last: without it, half a copy is no run
            write(part / name, data)
        shutil.rmtree(target, ignore_errors=True)
        try:
            os.replace(part, target)
        except OSError as error:
            raise BadInput(f"{target}: {error.strerror}; a run's folder is expected there") from None
    rows, trained = [], {}
    for path in sorted(results.glob("[!.]*/config.json")):
        for run in tables.find_runs([path.parent])[0].to_dict("records"):
            success, last = run["curves"].success, run["curves"].validation.iloc[-1:].max() / 100
            rows.append({"name": path.parent.name} | run | {
                "env_steps": run["steps"], "finished": int(run["finished"]), "eval_success": last,
                "P_scs_percent": success, "git_commit": run["commit"]})  # fmt: skip
            if (path.parent / "policy.pt").exists():
                late = tables.late(run["curves"].validation)  # the test trials choose nothing
                best = best_column(run["task"], pd.DataFrame([run]))
                column = run["num_demos"], run["lambda_bc"]
                other = not run["curves"].own_flags or column != (best.num_demos, best.lambda_bc)
                rank = other, -np.nan_to_num(late, nan=-1), -run["steps"], path.parent.name
                trained.setdefault((run["task"], run["algo"], run["recipe"]), []).append(rank)
    for *_, name in (rank for ranks in trained.values() for rank in sorted(ranks)[1:]):
        (results / name / "policy.pt").unlink()
    write(results / "index.csv", pd.DataFrame(rows, columns=INDEX_COLUMNS).to_csv(index=False, float_format="%g"))
    return [*(f"published {target}" for target in found), f"wrote {results / 'index.csv'}, {len(rows)} runs"]


# ---- the pages' tables -----------------------------------------------------------------------------------------------

CLAIMS = {  # of the paper: Sec. 5, 3.4 (mask) and 3.2 (symmetry)
    "lambda": "A larger λ_BC is better",
    "demos": "More demonstrations are better",
    "plain": "Demo-EASE beats the plain algorithm",
    "mask": "Cloning with the mask is better than without",
    "mapping": "Demonstrations of one partition, mapped to all, are better than as many of all",
    "symmetry": "Symmetric demonstrations cost less: mapped ones are as good as recorded ones, within 5 points",
    "P_scs_percent": "The agent beats its demonstrator",
    "E_95_cm": "The agent's E_95 is smaller than its demonstrator's",
    "R_test": "The agent's return is larger than its demonstrator's",
    "T_eff": "The agent needs more effort than its demonstrator",
    "steps": "The agent is quicker than its demonstrator (ours)",
    "final_error_cm": "The agent ends nearer to the goal than its demonstrator (ours)",
}
BESIDE_PID = {  # {metric of evaluate.paired: (its column, unit, 1 where more is claimed or -1 where less, decimals)}
    "P_scs_percent": ("success (points)", "points", 1, 1),
    "E_95_cm": ("E_95 (cm)", "cm", -1, 2),
    "R_test": ("return", "of return", 1, 2),
    "T_eff": ("effort (points)", "points", 1, 1),
    "steps": ("steps", "steps", -1, 0),
    "final_error_cm": ("last error (cm)", "cm", -1, 2),
}
MARGIN = 5  # points of test success that mapped demonstrations may be worse than as many recorded ones
CEILING = 99  # percent of the trials; beside a PID with more an agent cannot be better, only quicker
LEAST = 5  # percent of the trials: with less, next to none is one that both succeed in
UNSEEN = f"first trial {evaluate.UNSEEN}"  # 500 trials that were seen of PPO alone while the recipes came about


def comparisons(task, runs):
    """(claim, what is compared, one side, the other, margin) that a task's finished runs allow; a side is a list of
    Curves, or None. The claim is that the first is better, or with a margin that it is not worse by more."""
    best, printed = best_column(task), columns(task)
    key, ends = (best.num_demos, best.lambda_bc), {}
    for sweep, value in (("lambda", "lambda_bc"), ("demos", "num_demos")):
        rows = printed[(printed.sweep == sweep) & (printed[value] > 0)].sort_values(value)
        ends[sweep] = tuple((row.num_demos, row.lambda_bc) for row in (rows.iloc[-1], rows.iloc[0]))
    pid = {run.recipe: [run.curves] for run in runs[runs.algo == "pid"].itertuples()}
    groups = runs[(runs.algo != "pid") & runs.finished].groupby(GROUP)
    at = {group: {key: list(part.curves) for key, part in members.groupby(COLUMN[1:])} for group, members in groups}
    for group, found in at.items():
        (algo, recipe, symmetry, variant, total), label = group, group_label(group)
        own_group = (algo, recipe, symmetry, "", total)  # with all of the recipe's flags
        own = at.get(own_group, {})
        plain = [curves for (N, _), part in own.items() if not N for curves in part]
        if variant == "mask=none":
            yield "mask", f"{group_label(own_group)}, and with mask=none", own.get(key), found.get(key), 0
        if variant in ("", "clone_iters=0"):
            yield "plain", f"{label}: with demonstrations, and without", found.get(key), plain, 0
        for (N, lam), curves in found.items() if (symmetry, variant) == ("gas", "") else ():
            recorded, none = curves[0].row["recorded"], at.get((algo, recipe, "none", "", total), {})
            mapped = f"{label}: {recorded} recorded in one partition and mapped to {N}"
            yield ("mapping", f"{mapped}, and {recorded} recorded in all", curves, none.get((recorded, lam)), 0)
            yield ("symmetry", f"{mapped}, and {N} recorded in all: at most {MARGIN} points worse", curves,
                   none.get((N, lam)), MARGIN)  # fmt: skip
        own_length = all(curves.own_length for side in found.values() for curves in side)
        own_symmetry = symmetry == tables.OWN_SYMMETRY.get(recipe)
        if own_symmetry and (variant == "" and own_length or variant.removeprefix("gains=") in pid_demo.GAINS):
            gains = found[key][0].config["gains"] if key in found else None
            for metric in BESIDE_PID:
                yield metric, label, found.get(key), pid.get(gains), 0
        if variant or recipe not in tables.OWN_SYMMETRY or own_symmetry and not own_length:
            continue  # a recipe of another length is there for the ablations
        pairs, counts = list(ends.items()), sorted(n for n in found if n[0] and n[1] == best.lambda_bc)
        if len(counts) > 1:  # as in the study of the symmetries
            pairs.append(("demos", (counts[-1], counts[0])))
        for sweep, (high, low) in dict.fromkeys(pairs):
            names = [f"{N} demonstrations, λ_BC = {lam:g}" for N, lam in (high, low)]
            yield sweep, f"{label}: {' and '.join(names)}", found.get(high), found.get(low), 0


def findings(runs):
    """A dict for each comparison: its claim of CLAIMS, its task, what is compared, the sides' Curves and success, their
    difference in the claim's direction and what that says. The interval is Welch's over seeds; beside the PID, which is
    one controller, Student's of the differences from it in the same trials. Comparisons with a single seed on a side
    have no interval and say nothing."""
    found = ((task, *sides) for task in PRINTED for sides in comparisons(task, runs[runs.task == task]))
    for task, claim, compared, one, other, margin in found:
        of_both = claim in BESIDE_PID and claim != "P_scs_percent"  # of the trials that both succeed in
        sides = [[curves for curves in side or () if curves.success >= LEAST * of_both] for side in (one, other)]
        if not all(sides):
            continue
        by_seed = [[curves.success for curves in side] for side in sides]
        means, apart = [np.mean(side) for side in by_seed], False
        _, unit, sign, digits = BESIDE_PID.get(claim, ("", "points", 1, 1))
        if claim in BESIDE_PID:
            ours, (pid,) = ([curves.evaluations[""] for curves in side] for side in sides)
            gap, *ends = evaluate.over_seeds([sign * evaluate.paired(trials, pid)[claim][0] for trials in ours])
            low, high = ends if of_both else np.clip(ends, -100, 100)
        else:
            gap, low, high = tables.difference("P_scs_percent", *by_seed)
            apart = tables.separated(*by_seed)
        full = claim == "P_scs_percent" and means[1] >= CEILING
        if not low < high and not (full and low == high):  # a single seed says nothing, nor do seeds without a spread
            continue
        verdict = "holds" if low > -margin else "does not hold" if high < -margin else "cannot be told apart"
        if full and low > -MARGIN:
            verdict = "no room above it" + ", and below" * bool(high < 0)
        yield {"claim": claim, "task": TITLES[task], "compared": compared, "verdict": verdict, "sides": sides,
               "success": " and ".join(f"{mean:.1f}" for mean in means),
               "difference": between(gap, low, high, digits) + " †" * apart, "unit": unit,
               "seeds": " and ".join(str(len(side)) for side in sides if not side[0].pid)}  # fmt: skip


def findings_lines(runs):
    """The comparisons of agents with agents, in the order of CLAIMS."""
    lines, found = [["claim", "task", "compared", "success (%)", "difference (points)", "seeds", ""]], [*findings(runs)]
    for claim in (claim for claim in CLAIMS if claim not in BESIDE_PID):
        said = [[x["task"], x["compared"], x["success"], x["difference"], x["seeds"], f"*{x['verdict']}*"]
                for x in found if x["claim"] == claim]  # fmt: skip
        said = said or [["", "not yet run with two seeds a side", *[""] * 4]]
        lines += [[CLAIMS[claim] * (i == 0), *line] for i, line in enumerate(said)]
    return lines


def beside_pid_lines(runs):
    """Agents beside the PID that they were shown, in the same trials: a line an agent, a column a claim."""
    lines, beside = [["task", "agent", "seeds", "PID's gains", "success (%)", "PID, given longer (%)", "both succeed",
                      *(f"{name}, {('', 'agent minus PID', 'PID minus agent')[sign]}"
                        for name, _, sign, _ in BESIDE_PID.values())]], {}  # fmt: skip
    for x in findings(runs):
        if x["claim"] in BESIDE_PID:
            beside.setdefault((x["task"], x["compared"]), {})[x["claim"]] = x
    for (title, agent), found in beside.items():
        ours, (pid,) = (x := next(iter(found.values())))["sides"]
        longer = [f"{what}: {evaluate.metrics(trials)['P_scs_percent']:.1f}" for what, trials in pid.evaluations.items()
                  if what.startswith("horizon")]  # fmt: skip
        both = [sum(c.evaluations[""].success * pid.evaluations[""].success) for c in ours if c.success >= LEAST]
        cells = [f"{found[m]['difference']}: {found[m]['verdict']}" if m in found else "-" for m in BESIDE_PID]
        lines.append([title, agent, x["seeds"], pid.config["gains"], x["success"], ", ".join(longer) or "-",
                      f"{np.mean(both):.0f}" if both else "-", *cells])  # fmt: skip
    return lines


def verdicts_lines(runs):
    """The findings at a glance: by claim and task the verdict with its number, of several comparisons in how many."""
    lines, found = [["claim", *(TITLES[task] for task in PRINTED)]], [*findings(runs)]
    for claim, sentence in CLAIMS.items():
        cells = []
        for title in lines[0][1:]:
            said = [x for x in found if (x["claim"], x["task"]) == (claim, title)]
            counts = Counter(x["verdict"] for x in said).most_common()
            if len(said) == 1:
                cells += ["{verdict}: {difference} {unit}, {seeds} seeds".format(**said[0])]
            else:
                cells += ["; ".join(f"{verdict} in {n} of {len(said)}" for verdict, n in counts) or "-"]
        lines.append([sentence, *cells])
    return lines


def results_lines(runs):
    """For the first page: by task and recipe the paper's best column and the plain algorithm, and the PID."""
    lines = [["task", "agent", "paper", "ours: success in test trials (%)", "in 500 others (%)", "seeds",
              "steps: demonstrated + own", "command", "minutes"]]  # fmt: skip
    for task in PRINTED:
        printed, best = columns(task), best_column(task)
        (plain,), (pid,) = (printed[printed.sweep == sweep].itertuples() for sweep in ("baseline", "pid"))
        of_task, agents = runs[(runs.task == task) & (runs.variant == "")], []
        for (recipe, name), algo in product((("robust", "robust"), ("paper", "as published")), ("ddpg", "ppo")):
            group = main_group(task, of_task[of_task.algo == algo], recipe)
            command = f"{algo}_demoease.py --task {task} --recipe {recipe}"
            agents += [(f"Demo-EASE {algo.upper()}, {name}", best._replace(algo=algo), command,
                        of_column(group, best._replace(algo=algo))),
                       (f"{algo.upper()}, {name}", plain._replace(algo=algo),
                        f"{command} --num_demos 0 --lambda_bc 0", group[group.num_demos == 0])]  # fmt: skip
        agents += [(f"PID, {gains} gains", pid, f"evaluate.py --pid --task {task} --gains {gains}",
                    of_task[of_task.recipe == gains]) for gains in pid_demo.GAINS]  # fmt: skip
        for name, column, command, part in agents:
            trained = [run.progress for run in part.curves if not run.pid]
            theirs = column.P_scs_percent if column.algo in (best.algo, "pid") and "fast" not in name else math.nan
            about = [TITLES[task], name, "-" if theirs != theirs else f"{theirs:g}"]
            if not len(part) and column == best:
                lines.append([*about, "not run yet", "", "", "", f"`{command}`", ""])
            steps, demo_steps, seconds = ([table[name].max() for table in trained]
                                          for name in ("env_steps", "demo_env_steps", "seconds"))  # fmt: skip
            found = tables.measured("test", part)
            if "" not in found:
                continue
            success = success_in(found, "")
            if tables.LATE in found:
                late = np.mean([metrics["P_scs_percent"] for _, metrics in found[tables.LATE]])
                success += f"; in validation, over the last fifth of training: {late:.1f}"
            for what in found if column.algo == "pid" else ():
                success += f"; {what}: {success_in(found, what)}" * what.startswith("horizon")
            unfinished = f" ({sum(~part.finished)} unfinished)" * (not all(part.finished))
            lines.append([*about, success, success_in(found, UNSEEN) if UNSEEN in found else "-",
                          f"{len(found[''])}{unfinished}" if trained else "-",
                          f"{np.mean(demo_steps) / 1000:.0f}k + {np.mean(steps) / 1000:.0f}k" if trained else "-",
                          f"`{command}`", f"{np.median(seconds) / 60:.0f}" if trained else "-"])  # fmt: skip
    return lines


def success_in(found, what):
    """Success in the study `what` of tables.measured, with its interval: over seeds, of a single one over trials."""
    mean, *ends = tables.over_seeds("P_scs_percent", [metrics["P_scs_percent"] for _, metrics in found[what]])
    if len(found[what]) == 1:
        ends = evaluate.over_trials(found[what][0][0].curves.evaluations[what])["P_scs_percent"]
    return between(mean, *ends, 1)


WATCHED = {"L_O": ("L_O",), "L_BC": ("L_BC",), "L_keep": ("L_keep",),
           "pretanh_own (PPO: mean_action_own)": ("pretanh_own", "mean_action_own"),
           "pretanh_demo (mean_action_demo)": ("pretanh_demo", "mean_action_demo"),
           "mask_fraction": ("mask_fraction",), "bc_relative_error": ("bc_relative_error",),
           "Q_max (PPO: V_max)": ("Q_max", "V_max")}  # fmt: skip


def watched_lines(runs):
    """What went on inside the first page's agents: means over the tenth of a run's epochs that ends at a tenth, half,
    all of them."""
    lines = [["task", "agent", *WATCHED, "own success (%)"]]
    for task, recipe, algo in product(PRINTED, ("robust", "paper"), ("ddpg", "ppo")):
        of_recipe = runs[(runs.task == task) & (runs.variant == "") & (runs.algo == algo)]
        part = of_column(main_group(task, of_recipe, recipe), best_column(task)._replace(algo=algo))
        histories, cells = [run.progress for run in part.curves], []
        for names in (*WATCHED.values(), ("Success",)) if histories else ():
            unit = 100 if names == ("Success",) else 1
            at = [unit * pd.Series([mean_of_tenth(history[name], share) for history in histories for name in names
                                    if name in history], dtype=float).mean() for share in (0.1, 0.5, 1)]  # fmt: skip
            shown = ["-" if x != x else f"{x:.2g}" if x < 99.5 else f"{x:.0f}" for x in at]
            cells.append(", ".join(shown) if set(shown) != {"-"} else "-")
        lines += [[TITLES[task], f"{algo.upper()}, {recipe}", *cells]] * bool(cells)
    return lines


def mean_of_tenth(values, share):
    """Mean over the tenth of a column of progress.csv that ends at this share of it."""
    end = math.ceil(share * len(values))
    return values.iloc[max(0, end - math.ceil(len(values) / 10)) : end].mean()


def parts_lines(runs):
    """The ablations at a glance: by flag, task and algorithm the differences in success and in a trial's steps."""
    found, heads = {}, []
    for task in PRINTED:
        for line in tables.compared_lines("ablations", tables.of_task(runs, task, variants=True))[1:]:
            algo, recipe, _ = line[0].split()
            part, head = re.sub(r" \S+k steps$", "", line[2]), f"{TITLES[task]}, {algo.upper()}"
            if recipe == "robust" and part != "the recipe's":
                heads += [head] * (head not in heads)
                found.setdefault(part, {}).setdefault(head, []).append(f"{line[7]}; {line[9]}")
    return [["instead of the recipe's", *heads], *([part, *(" / ".join(cells.get(head, "-")) for head in heads)]
                                                   for part, cells in sorted(found.items()))]  # fmt: skip


def study(run, printed):
    """What a run, a row of tables.find_runs, is there for. printed: [N_demos, lambda_BC] of its task's columns."""
    if run.recipe not in tables.OWN_SYMMETRY:
        return "other libraries"
    if run.recipe == "paper":
        return "as published"
    if run.symmetry != tables.OWN_SYMMETRY[run.recipe] or [run.num_demos, run.lambda_bc] not in printed:
        return "robust, symmetries and K"
    return "robust, ablations" if run.variant or not run.curves.own_length else "robust, the paper's columns"


def cost_lines(runs):
    """What the published runs took on one core, validation trials included, the test study not."""
    trained = runs[runs.algo != "pid"]
    printed = {task: columns(task)[COLUMN[1:]].values.tolist() for task in trained.task.unique()}
    trained = trained.assign(study=[study(run, printed[run.task]) for run in trained.itertuples()],
                             hours=[run.progress.seconds.max() / 3600 for run in trained.curves])  # fmt: skip
    lines = [["what for", "task", "algorithm", "runs", "environment steps", "core-hours"]]
    for (what, task, algo), part in [*trained.groupby(["study", "task", "algo"]), (("all", "", ""), trained)]:
        cells = f"{len(part)}", f"{part.steps.sum():,}", f"{part.hours.sum():.1f}"
        lines.append([what, TITLES.get(task, ""), algo, *cells])
    return lines


def pid_lines(runs):
    """The demonstrator in the test study and in other ones."""
    lines = [["task", "", *METRICS["test"], "steps"]]
    for run in runs[(runs.algo == "pid") & runs.task.isin(PRINTED)].sort_values(["task", "recipe"]).itertuples():
        (printed,) = columns(run.task).query("sweep == 'pid'").to_dict("records")
        if TITLES[run.task] not in [line[0] for line in lines]:
            lines.append([TITLES[run.task], "paper", *(f"{printed[m]:g}" for m in METRICS["test"]), ""])
        for what, trials in run.curves.evaluations.items():
            metrics, ends = evaluate.metrics(trials), evaluate.over_trials(trials)
            cells = [between(metrics[m], *ends[m], digits) for m, digits in {**METRICS["test"], "steps": 0}.items()]
            lines.append([TITLES[run.task], f"{run.recipe} gains" + f", {what}" * bool(what), *cells])
    return lines


def table_markdown(kind, task, runs):
    """A table in Markdown; those of the paper without columns of our own recipes that it does not have."""
    printed = columns(task)[COLUMN[1:]].values.tolist() if kind in METRICS else []
    kept = [kind not in METRICS or run.recipe not in tables.OWN_SYMMETRY or [run.num_demos, run.lambda_bc] in printed
            for run in runs.itertuples()]  # fmt: skip
    return make_table(kind, task, runs[np.array(kept, bool)])[1]


BLOCKS = {f"{kind}-{task}": partial(table_markdown, kind, task) for kind in (*METRICS, *COMPARED) for task in PRINTED}
BLOCKS |= {name: lambda runs, lines=lines: markdown(lines(runs)) for name, lines in (
    ("results", results_lines), ("verdicts", verdicts_lines), ("findings", findings_lines), ("parts", parts_lines),
    ("beside-pid", beside_pid_lines), ("watched", watched_lines), ("cost", cost_lines),
    ("demonstrator", pid_lines))}  # fmt: skip


# ---- pages -----------------------------------------------------------------------------------------------------------


MARKED = re.compile(r"^<!-- (\S+) -->$.*?^<!-- /\1 -->$", re.MULTILINE | re.DOTALL)
FIGURE_BLOCKS = ("figures", *(f"figures-{task}" for task in TASKS))


def marked_pages():
    """{page: its text}. Raises BadInput for a mark that is alone or of no block, and where no run is published."""
    if not any(tables.RESULTS.glob("[!.]*/config.json")):
        raise BadInput(f"--report: no run in {tables.RESULTS}; --publish puts them there")
    texts = {}
    for page in (page for page in PAGES if page.exists()):
        with tables.reading(page, "a page in UTF-8"):
            texts[page] = page.read_text(encoding="utf-8")
    for page, text in texts.items():
        for name in set(MARKED.findall(text)) - {*BLOCKS, *FIGURE_BLOCKS}:
            raise BadInput(f"{page}: <!-- {name} --> is no block of --report; --help lists them")
        for mark, name in re.findall(r"^(<!-- /?(\S+) -->)$", MARKED.sub("", text), re.MULTILINE):
            raise BadInput(f"{page}: {mark} is one mark alone; <!-- {name} --> and <!-- /{name} --> are expected")
    return texts


def report(figures):
    """{page: its text with each marked block made anew from data/results}. figures: its .png files, in their order."""
    texts, (runs, _) = marked_pages(), tables.find_runs([tables.RESULTS])

    def block(marks, page):
        name = marks[1]
        if name in FIGURE_BLOCKS:
            shown = [path for path in figures if path.stem.split("-")[2:3] == name.split("-")[1:]]
            text = "\n\n".join(f"![{path.stem}]({os.path.relpath(path, page.parent)})" for path in shown)
        else:
            text = BLOCKS[name](runs)
        return f"<!-- {name} -->\n{text}\n<!-- /{name} -->"

    return {page: MARKED.sub(partial(block, page=page), text) for page, text in texts.items()}
