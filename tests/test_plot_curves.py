"""tables.py and plot_curves.py: metrics on curves whose numbers follow by hand, which runs are read and averaged, what
is drawn, published and written into the pages, and what bad input says."""

import csv
import gzip
import json
import math
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

import plot_curves
import publish
import tables
from logx import BadInput
from plot_curves import Flags, main

CONFIG = {"task": "p2p", "algo": "ddpg", "recipe": "robust", "num_demos": 100, "lambda_bc": 1.8, "symmetry": "mirror",
          "seed": 0, "epochs": 2, "steps_per_epoch": 2000, "max_ep_len": 400, "gains": "fast",
          "partitions": 4}  # fmt: skip
COMMIT = "0123456789" * 4
PID = {"task": "p2p", "algo": "pid", "gains": "fast", "versions": {"git_commit": COMMIT}}
HEADER = "trial,success,failure,grasped,length,return,effort_percent,final_error_cm,e95_cm\n"


@pytest.fixture(autouse=True)
def folders(tmp_path, monkeypatch):
    """The default folders lie in an empty place, so that no test sees or writes real results."""
    monkeypatch.setattr(tables, "RESULTS", tmp_path / "results")
    monkeypatch.setattr(tables, "RUNS", (tmp_path / "runs",))
    monkeypatch.setattr(plot_curves, "FIGURES", tmp_path / "figures")
    monkeypatch.setattr(publish, "TRIALS", 2)
    monkeypatch.setattr(publish, "PAGES", (tmp_path / "README.md", tmp_path / "results/README.md"))


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


# ---- metrics ---------------------------------------------------------------------------------------------------------


def test_R10_and_R90_are_means_over_a_tenth_of_the_episodes_rounded_up():
    metrics = tables.training_metrics(np.arange(11.0))  # a tenth of 11 is 2 episodes: (0 + 1) / 2 and (9 + 10) / 2
    assert (metrics["R10"], metrics["R90"], metrics["I_R"]) == (0.5, 9.5, 9.0)


def test_T50_is_the_first_full_window_above_half_of_R90():
    # R90 = 10; 25 tens among the last 50 (episode 125) make exactly 5, the 26th exceeds it
    assert tables.training_metrics(np.repeat([0.0, 10.0], 100))["T50"] == 126
    assert tables.training_metrics(np.full(200, 10.0))["T50"] == 50


@pytest.mark.parametrize("returns", [np.full(49, 10.0), np.repeat([5.0, -1.0], 100), np.repeat([5.0, 0.0], 100),
                                     np.repeat([0.0, 10.0], [90, 10])])  # fmt: skip
def test_T50_is_not_available_without_a_full_window_a_positive_R90_or_half_of_it(returns):
    assert math.isnan(tables.training_metrics(returns)["T50"])


def test_the_running_mean_is_over_the_last_50_returns():
    smooth = tables.running_mean(np.repeat([0.0, 10.0], 50))
    assert smooth[[49, 50, 74, 99]] == pytest.approx([0, 0.2, 5, 10])


# ---- tables ----------------------------------------------------------------------------------------------------------


def test_without_runs_the_table_is_the_papers_in_its_order():
    text, _, rows = tables.make_table("training", "p2p", tables.find_runs()[0])
    printed = [line.split() for line in text.splitlines() if " paper " in line]
    assert printed[0] == ["lambda", "100", "0.1", "paper", "-0.44", "3.72", "4.16", "657"]
    assert printed[6] == ["baseline", "0", "0", "paper", "-0.56", "0.90", "1.49", "486"]  # I_R as printed, not 1.46
    assert text.count("no runs") == 7 and len(rows) == 7 * 4


@pytest.mark.parametrize("recipe, symmetry", [("paper", "gas"), ("robust", "mirror")])
def test_the_mean_over_seeds_has_students_interval_and_as_published_a_mark_where_the_papers_value_lies_outside(
    tmp_path, recipe, symmetry
):
    for seed, value in enumerate((9.0, 10.0, 11.0)):
        returns = np.repeat([-0.12, value], 50)
        write_run(tmp_path / f"runs/{seed}", returns, seed=seed, recipe=recipe, symmetry=symmetry)
    R90 = cell(table(), "R90")
    half = 4.30265 / math.sqrt(3)  # t quantile for 2 degrees of freedom
    assert [R90[k] for k in ("mean", "low", "high")] == pytest.approx([10, 10 - half, 10 + half], abs=1e-4)
    assert (R90["paper"], R90["seeds"], R90["paper_outside"]) == (8.94, 3, 0)
    assert cell(table(), "T50")["paper_outside"] == (recipe == "paper")
    assert cell(table(), "R90", lambda_bc=0.6)["seeds"] == 0


def test_a_single_seed_has_no_interval_in_training_and_one_over_its_trials_in_the_test(tmp_path):
    write_run(tmp_path / "runs/a", success=(1, 0, 1, 0))
    assert math.isnan(cell(table(), "R90")["low"]) and cell(table(), "R90")["interval"] == ""
    rows = table("test")
    P = cell(rows, "P_scs_percent")
    assert (P["mean"], P["interval"]) == (50, "over trials")
    assert (P["low"], P["high"]) == pytest.approx((15.0, 85.0), abs=0.01)  # Wilson
    assert [cell(rows, m)["mean"] for m in ("T_eff", "R_test", "E_95_cm")] == [21, 11, 6]  # over the successful ones


def test_NA_seeds_are_counted_and_not_averaged(tmp_path):
    for seed, returns in enumerate(([0.0] * 50 + [10.0] * 50, [-1.0] * 100)):
        write_run(tmp_path / f"runs/{seed}", returns, seed=seed)
    T50 = cell(table(), "T50")
    assert (T50["mean"], T50["na_seeds"]) == (76, 1)
    write_run(tmp_path / "runs/2", num_demos=80, lambda_bc=1)
    write_run(tmp_path / "runs/3", [-1.0] * 100, num_demos=80, lambda_bc=1, seed=1)
    text = tables.make_table("training", "p2p", tables.find_runs()[0])[0]
    assert "76 [-] (1 N/A)" in text and "<= 50 (1 N/A)" in text


def test_no_demonstrations_with_lambda_1_and_the_baseline_are_different_columns(tmp_path):
    write_run(tmp_path / "runs/a", [2.0] * 60, num_demos=0, lambda_bc=1)
    write_run(tmp_path / "runs/b", [3.0] * 60, num_demos=0, lambda_bc=0)
    assert cell(table(), "R90", "demos", 0, 1)["mean"] == 2 and cell(table(), "R90", "baseline", 0, 0)["mean"] == 3


def test_the_pick_and_place_run_400_15_stands_in_both_sweeps(tmp_path):
    write_run(tmp_path / "runs/a", task="pnp", algo="ppo", num_demos=400, lambda_bc=15)
    assert [cell(table(task="pnp"), "R90", sweep, 400, 15)["mean"] for sweep in ("lambda", "demos")] == [1, 1]


def test_the_lambda_sweep_of_p2po_is_matched_by_sweep_and_value(tmp_path):
    write_run(tmp_path / "runs/a", task="p2po", num_demos=250, lambda_bc=1, success=(1, 1))
    write_run(tmp_path / "runs/b", task="p2po", num_demos=100, lambda_bc=1, success=(0, 0))
    rows = table("test", "p2po")
    sweep, demos = cell(rows, "P_scs_percent", "lambda", 250, 1), cell(rows, "P_scs_percent", "demos", 100, 1)
    assert (sweep["paper"], sweep["mean"], demos["paper"], demos["mean"]) == (96.2, 100, 71.6, 0)


def test_the_main_group_has_its_recipes_own_symmetry_and_length_whatever_else_has_more_runs(tmp_path):
    write_run(tmp_path / "runs/own")
    for seed, name, said in ((0, "short-epochs=1-seed0", {}), (1, "any", {"own_length": False})):
        write_run(tmp_path / f"runs/{name}", epochs=1, steps=2000, seed=seed, **said)
        write_run(tmp_path / f"runs/none{seed}", symmetry="none", seed=seed)
    (run,) = tables.main_group("p2p", tables.find_runs()[0]).curves
    assert run.folder.name == "own"


@pytest.mark.parametrize("config", [{"lambda_bc": 7.5}, {"num_demos": 80}, {"algo": "sac", "recipe": "sb3"}])
def test_a_run_of_no_printed_column_is_listed_as_not_in_the_papers_table(tmp_path, config):
    write_run(tmp_path / "runs/a", **config)
    text, _, rows = tables.make_table("training", "p2p", tables.find_runs()[0])
    assert text.count("not in the paper's table") == 1 and text.count("no runs") == 7
    assert rows[rows.sweep == "other"]["mean"].tolist()[1] == 1 and rows[rows.sweep == "other"].paper.isna().all()


@pytest.mark.parametrize("config", [{"recipe": "paper"}, {"symmetry": "gas"}, {"epochs": 1}, {"variant": "gamma=0.9"}])
def test_runs_that_differ_in_recipe_symmetry_variant_or_length_are_never_averaged_together(tmp_path, config):
    write_run(tmp_path / "runs/a", [1.0] * 60)
    write_run(tmp_path / "runs/b", [3.0] * 60, **config)
    rows = table(named=[tmp_path], variants=True)
    assert sorted(rows[(rows.metric == "R90") & (rows.seeds > 0)]["mean"]) == [1, 3]


def test_runs_of_different_commits_are_one_group_and_its_commits_are_printed(tmp_path):
    write_run(tmp_path / "runs/a")
    write_run(tmp_path / "runs/b", seed=1, versions={"git_commit": "f" * 40})
    text, _, rows = tables.make_table("training", "p2p", tables.find_runs()[0])
    assert "Commits of ddpg robust mirror 4k steps: 0123456, fffffff" in text and rows.seeds.max() == 2


def test_other_studies_and_the_best_evaluation_in_training_are_rows_of_their_own(tmp_path):
    run = write_run(tmp_path / "runs/a", success=(1, 1), validated=0.75, recipe="paper", symmetry="gas")
    (run / "evaluation-start_-0.785_0.52_0.42-horizon_600.csv").write_text(trials((1, 0)))
    rows = table("test")
    assert cell(rows, "P_scs_percent")["mean"] == 100
    other = cell(rows, "P_scs_percent", evaluation="start -0.785 0.52 0.42, horizon 600")
    best = cell(rows, "P_scs_percent", evaluation="best evaluation in training")
    assert (other["mean"], best["mean"]) == (50, 75) and other["paper_outside"] == best["paper_outside"] == 0


def test_the_PID_stands_beside_the_papers_in_the_test_and_not_in_training(tmp_path):
    write_run(tmp_path / "results/pid-p2p-fast", success=(1, 0), **PID)
    row = cell(table("test"), "P_scs_percent", "pid", 0, 0)
    assert (row["recipe"], row["mean"], row["paper"]) == ("fast", 50, 59)
    assert "pid" not in tables.make_table("training", "p2p", tables.find_runs()[0])[0]


def test_pairs_that_the_paper_ranks_are_listed_where_the_difference_may_be_0(tmp_path):
    for lam, *values in ((0.1, 0, 4), (0.6, 1, 5), (1.8, 80, 81)):
        for seed, value in enumerate(values):
            write_run(tmp_path / f"runs/{lam}-{seed}", [value] * 60, lambda_bc=lam, seed=seed)
    write_run(tmp_path / "runs/one", [0.0] * 60, num_demos=0, lambda_bc=0)
    text = tables.make_table("training", "p2p", tables.find_runs()[0])[0]
    (line,) = [line for line in text.splitlines() if ", our difference" in line]
    assert "lambda_BC=0.1 and N_demos=100 lambda_BC=0.6: the paper's 3.72 and 6.83, our difference -1.00 [" in line
    assert "0 we rank the other way, 1 we cannot tell apart, 2 we agree on; 3 of a single seed" in text


def test_pairs_that_our_seeds_rank_the_other_way_are_listed(tmp_path):
    for lam, *values in ((0.1, 8, 9), (0.6, 1, 2)):
        for seed, value in enumerate(values):
            write_run(tmp_path / f"runs/{lam}-{seed}", [value] * 60, lambda_bc=lam, seed=seed)
    text = tables.make_table("training", "p2p", tables.find_runs()[0])[0]
    assert "1 we rank the other way" in text and "the paper's 3.72 and 6.83, our difference 7.00 [" in text


def test_ablations_are_compared_with_the_recipe_alone_and_left_out_of_the_papers_tables(tmp_path):
    for seed in (0, 1):
        write_run(tmp_path / f"runs/a{seed}", seed=seed, success=(1, 1), own=(1, 1))
        write_run(tmp_path / f"runs/b{seed}", seed=seed, success=(1, 0), own=(1, 0), variant="n_step=1")
    write_run(tmp_path / "runs/short", seed=0, success=(0, 0), epochs=1, steps=2000, variant="pi_lr=0.0")
    runs, _ = tables.find_runs()
    lines = tables.compared_lines("ablations", runs)
    same, half = "100.0 [-]", ["50.0 [-]", "-50.0 [-]"]  # seeds that all agree show no spread
    assert [[line[2], *line[5:]] for line in lines[1:]] == [
        ["the recipe's 4k steps", "100.0 100.0", same, "-", "4 [-]", "-", same, "-"],
        ["n_step=1 4k steps", "50.0 50.0", *half, "3 [-]", "-0 [-]", *half],
        ["pi_lr=0.0 2k steps", "0.0", "0.0 [-]", "-100.0 [-]", "-", "-", "0.0 [-]", "-"]]  # fmt: skip
    assert table("test").seeds.max() == 2 and "n_step" not in tables.make_table("test", "p2p", runs)[0]


def test_symmetries_are_compared_with_none_at_as_many_recorded_demonstrations(tmp_path):
    for symmetry, N, success in (
        ("none", 5, (0, 0)),
        ("gas", 20, (1, 0)),
        ("canonical", 5, (1, 1)),
        ("so2", 20, (1, 1)),
    ):
        write_run(tmp_path / f"runs/{symmetry}", symmetry=symmetry, num_demos=N, success=success)
    lines = tables.compared_lines("symmetries", tables.find_runs()[0])[1:]
    assert [[line[2].split()[0], *line[3:5], line[7]] for line in lines] == [
        ["none", "5", "5", "-"], ["canonical", "5", "5", "100.0 [-]"], ["gas", "5", "20", "50.0 [-]"]]  # fmt: skip


def test_partitions_are_compared_with_4_at_as_many_recorded_and_at_as_many_mapped_demonstrations(tmp_path):
    for K, N, success in ((4, 20, (1, 1)), (2, 10, (1, 0)), (2, 20, (0, 0))):
        variant = "" if K == 4 else f"partitions={K}"
        config = {"symmetry": "gas", "partitions": K, "num_demos": N, "variant": variant}
        write_run(tmp_path / f"runs/{K}-{N}", success=success, **config)
    lines = tables.compared_lines("partitions", tables.find_runs()[0])[1:]
    assert [[line[2].split()[0], *line[3:5], line[7]] for line in lines] == [
        ["2", "5", "10", "-50.0 [-]"], ["4", "5", "20", "-"],
        ["2", "10", "20", "-100.0 [-]"], ["4", "5", "20", "-"]]  # fmt: skip


def test_mapped_demonstrations_may_be_a_margin_worse_than_as_many_recorded_ones(tmp_path):
    for seed in (0, 1):
        for symmetry, N, won in (("none", 5, seed), ("none", 20, 199 + seed), ("gas", 20, 199 + seed)):
            folder = tmp_path / f"runs/{symmetry}{N}-{seed}"
            write_run(folder, symmetry=symmetry, num_demos=N, success=of_200(won), seed=seed)
    found = {line[0]: line[3:] for line in publish.findings_lines(tables.find_runs()[0])}
    assert found[publish.CLAIMS["mapping"]] == ["99.8 and 0.2", "99.5 [98.0, 100.0] points", "2 and 2", "*holds*"]
    assert found[publish.CLAIMS["symmetry"]] == ["99.8 and 99.8", "0.0 [-1.5, 1.5] points", "2 and 2", "*holds*"]


@pytest.mark.parametrize("ours, verdict", [
    ((200, 199), "holds"), ((0, 1), "does not hold"), ((200, 0), "cannot be told apart"),
    ((200,), ""), ((200, 200), "")])  # a single seed says nothing, nor do seeds without a spread  # fmt: skip
def test_a_finding_is_what_the_interval_of_the_difference_says(tmp_path, ours, verdict):
    for seed, won in enumerate(ours):
        write_run(tmp_path / f"runs/{seed}", seed=seed, success=of_200(won))
    write_run(tmp_path / "runs/pid", success=of_200(100), **PID)
    found = {line[0]: line[-1] for line in publish.findings_lines(tables.find_runs()[0])}
    assert found["The agent beats its demonstrator"] == (verdict and f"*{verdict}*")
    assert found["The mask matters"] == ""


def test_plain_runs_are_one_algorithm_whatever_their_lambda_and_trials_never_looked_at_have_a_column(tmp_path):
    for seed, (N, lam, won) in enumerate([(100, 1.8, (1, 1))] * 2 + [(0, 0, (0, 0)), (0, 0, (1, 0)), (0, 1, (1, 1))]):
        run = write_run(tmp_path / f"runs/{seed}", seed=seed, num_demos=N, lambda_bc=lam, success=won)
        (run / "evaluation-first_trial_50000.csv").write_text(trials((1, 0)))
    runs, _ = tables.find_runs()
    found = {line[0]: line[3:] for line in publish.findings_lines(runs)}
    assert found[publish.CLAIMS["plain"]][0::2] == ["100.0 and 50.0", "2 and 3"]
    mine, plain = (line for line in publish.results_lines(runs) if line[0] == "P2P" and line[5])
    assert (mine[3:6], plain[3].split()[0], plain[5]) == (["100.0 [-]", "50.0 [-]", "2"], "50.0", "3")


def test_an_agent_is_compared_with_the_pid_that_it_was_shown_of_which_the_success_is_told(tmp_path):
    for gains, won in (("authors", 100), ("fast", 200)):
        write_run(tmp_path / f"runs/pid-{gains}", success=of_200(won), **PID | {"gains": gains})
    for seed in (0, 1):
        for variant, gains, won in (("", "fast", 200), ("gains=authors", "authors", 199 + seed)):
            folder = tmp_path / f"runs/{gains}{seed}"
            write_run(folder, seed=seed, success=of_200(won), variant=variant, gains=gains)
    (tmp_path / "runs/pid-authors/evaluation-horizon_600.csv").write_text(trials((1, 1)))
    lines = publish.findings_lines(tables.find_runs()[0])
    assert [line[2:] for line in lines if line[0] == "The agent beats its demonstrator"] == [
        ["ddpg robust mirror 4k steps, and the PID with fast gains in the same trials", "100.0 and 100.0",
         "0.0 [-] points", "2", "*no room above it*"],
        ["ddpg robust mirror gains=authors 4k steps, and the PID with authors gains in the same trials (at the horizon "
         "600 100.0)", "99.8 and 50.0", "49.8 [46.6, 52.9] points", "2", "*holds*"]]  # fmt: skip


def test_seeds_that_all_lie_on_one_side_are_marked_where_chance_seldom_does_that():
    assert tables.separated([1, 2, 3], [4, 5, 6, 7, 8]) and tables.separated([9, 9, 9, 9], [1, 1, 1, 8])
    assert not tables.separated([1, 2, 3], [4, 5, 6])  # 1 time in 10
    assert not tables.separated([1, 2, 4], [4, 5, 6, 7, 8]) and not tables.separated([1, 2, math.nan], [4] * 5)
    assert tables.difference("P_scs_percent", [0, 90], [100, 100])[1] == -100


def test_what_went_on_inside_is_shown_after_a_tenth_half_and_all_of_a_run(tmp_path):
    run = write_run(tmp_path / "runs/a")
    rows = "".join(f"{i},{200 * i},0,{i},{i},nan\n" for i in range(1, 21))
    (run / "progress.csv").write_text("epoch,env_steps,demo_env_steps,seconds,Q_max,eval_success\n" + rows)
    (line,) = [line for line in publish.watched_lines(tables.find_runs()[0]) if line[0] == "P2P"]
    assert line[1] == "DDPG, robust" and line[6] == "1.5, 9.5, 20"  # means of rows 1 and 2, 9 and 10, 19 and 20


# ---- which runs ------------------------------------------------------------------------------------------------------


def test_runs_are_found_at_any_depth_and_a_folder_named_twice_counts_once(tmp_path):
    write_run(tmp_path / "x/deep/er/a", seed=0)
    write_run(tmp_path / "x/b", seed=1)
    assert len(tables.find_runs([tmp_path / "x", tmp_path / "x/deep/../b"])[0]) == 2


@pytest.mark.parametrize("columns", ["L_C,Q_mean", "V_mean,KL"])
def test_gzipped_tables_and_the_columns_of_either_algorithm_read_alike(tmp_path, columns):
    run = write_run(tmp_path / "runs/a", success=(1, 0), columns=columns)
    plain = table("test").drop(columns="values")
    for path in run.glob("*.csv"):
        path.with_name(f"{path.name}.gz").write_bytes(gzip.compress(path.read_bytes()))
        path.unlink()
    pd.testing.assert_frame_equal(table("test").drop(columns="values"), plain)


def test_an_unfinished_run_is_used_and_flagged_and_one_without_an_episode_left_out(tmp_path):
    write_run(tmp_path / "runs/a", steps=2600)
    write_run(tmp_path / "runs/b", returns=(), seed=1)
    runs, remarks = tables.find_runs()
    assert "1 (1 unfinished)" in tables.make_table("training", "p2p", runs)[0] and len(runs) == 1
    assert "runs/b has no episode yet" in remarks[0] and "runs/a, 2,600 of 4,000" in remarks[1]


def test_a_line_that_is_still_being_written_is_passed_over(tmp_path):
    run = write_run(tmp_path / "runs/a")
    with open(run / "episodes.csv", "a") as file:
        file.write("61,12")
    assert len(tables.find_runs()[0].curves[0].episodes) == 60


def test_of_a_published_run_and_its_own_copy_one_counts_and_nothing_is_said(tmp_path):
    write_run(tmp_path / "runs/a")
    shutil.copytree(tmp_path / "runs/a", tmp_path / "results/a")
    runs, remarks = tables.find_runs()
    assert len(runs) == 1 and remarks == []


@pytest.mark.parametrize("steps, kept", [(4000, "runs"), (2000, "results")])
def test_an_own_run_takes_the_published_ones_place_once_it_is_finished_and_that_is_said(tmp_path, steps, kept):
    write_run(tmp_path / "results/a", versions={"git_commit": "f" * 40})
    write_run(tmp_path / "runs/a", steps=steps)
    runs, remarks = tables.find_runs()
    assert runs.curves[0].folder == tmp_path / kept / "a" and "left out" in remarks[0]


def test_of_runs_of_one_seed_the_most_tested_counts_and_mixed_numbers_of_trials_are_named(tmp_path):
    write_run(tmp_path / "results/a", success=(1, 1, 1))
    write_run(tmp_path / "runs/a", success=(0, 0))
    write_run(tmp_path / "runs/b", success=(1, 1), seed=1)
    text = tables.make_table("test", "p2p", tables.find_runs()[0])[0]
    assert "Seeds of ddpg robust mirror 4k steps were tested in 2 or 3 trials." in text and "100.0 [-]" in text


# ---- figures ---------------------------------------------------------------------------------------------------------


def legend(ax):
    return [text.get_text() for text in ax.get_legend().get_texts()]


def test_the_learning_figure_draws_the_papers_columns_of_one_group_with_the_baseline_and_the_papers_R90(tmp_path):
    for i, (N, lam) in enumerate([(100, 0.1), (80, 1), (0, 0), (300, 7)]):
        write_run(tmp_path / f"runs/{i}", [i + 1.0] * 60, num_demos=N, lambda_bc=lam)
    write_run(tmp_path / "runs/short", epochs=1)
    drawn = figure("learning")
    both = ["DDPG (1 seed)", r"the paper's $\overline{R}_{90}$"]
    first, second = (legend(ax) for ax in drawn.axes)
    assert first == [r"$\lambda_{BC}=0.1$ (1 seed)", *both] and second == [r"$N_{demos}=80$ (1 seed)", *both]
    dotted = [[line.get_ydata() for line in ax.lines if line.get_linestyle() == ":"] for ax in drawn.axes]
    assert [[values[0] for values in lines[:2]] for lines in dotted] == [[3.72, 0.9], [8.58, 0.9]]
    said = drawn.get_supxlabel().replace("\n", " ")
    assert r"No runs yet: $\lambda_{BC}=0.6$" in said and "Not drawn: ddpg robust mirror 2k steps" in said


def test_a_sweep_without_runs_has_no_panel_and_recipe_picks_another_group(tmp_path):
    write_run(tmp_path / "runs/a")
    write_run(tmp_path / "runs/b", num_demos=80, lambda_bc=1, recipe="paper", symmetry="gas")
    assert [ax.get_title() for ax in figure("learning", recipe="robust").axes] == [
        r"effect of $\lambda_{BC}$ at $N_{demos}=100$"]  # fmt: skip
    assert [ax.get_title() for ax in figure("learning", recipe="paper").axes] == [
        r"effect of $N_{demos}$ at $\lambda_{BC}=1$"]  # fmt: skip


def test_a_curve_is_the_mean_over_all_seeds_up_to_the_shortest_with_a_band_then_a_thin_line(tmp_path):
    write_run(tmp_path / "runs/a", [1.0] * 100, seed=0)
    write_run(tmp_path / "runs/b", [3.0] * 150, seed=1)
    (ax,) = figure("learning").axes
    thick, thin = ax.lines[:2]
    assert (thick.get_xdata()[-1], set(thick.get_ydata())) == (100, {2.0})
    assert (thin.get_xdata()[-1], thin.get_ydata()[-1]) == (150, 3.0)
    assert ax.collections[0].get_paths()[0].vertices[:, 0].max() == 100 and ax.get_ylim()[1] < 10


def test_the_success_figure_has_a_line_a_method_with_the_best_column_no_demonstrations_and_other_algorithms(tmp_path):
    plain = {"num_demos": 0, "lambda_bc": 0}
    sac = plain | {"algo": "sac", "recipe": "sb3", "symmetry": "none"}
    given, other = {"variant": "demos=own.npz"}, {"variant": "n_step=1"}
    for i, config in enumerate(({}, {"seed": 1}, plain, sac, {"lambda_bc": 0.6}, {"epochs": 1}, given, other)):
        write_run(tmp_path / f"runs/{i}", **config)
    (ax,) = figure("success").axes
    assert sorted(legend(ax)) == [
        "SAC sb3 none, $N_{demos}=0$ (1 seed)", "robust mirror (2 seeds)", "robust mirror demos=own.npz (1 seed)",
        "robust mirror, $N_{demos}=0$ (1 seed)"]  # fmt: skip
    assert all(line.get_xydata().tolist() == [[2000, 50]] for line in ax.lines)
    write_run(tmp_path / "runs/x", num_demos=80)
    write_run(tmp_path / "runs/y", num_demos=80, lambda_bc=0)
    assert len(legend(figure("success", runs=(tmp_path,)).axes[0])) == 8


def test_a_task_that_the_paper_does_not_have_has_tables_and_figures_too(tmp_path, monkeypatch):
    for names in (tables.TASKS, tables.INDEX):  # as whoever adds one does, by the remark at kinova_env.TASKS
        monkeypatch.setitem(names, "push", names["p2p"])
    monkeypatch.setitem(tables.TITLES, "push", "Push")
    assert not plot_curves.save_figures(tmp_path, tables.find_runs()[0], Flags(), [".png"])[:-2]
    write_run(tmp_path / "runs/a", success=(1, 1), task="push")
    write_run(tmp_path / "runs/b", success=(1, 0), task="push", num_demos=0, lambda_bc=0)
    runs, _ = tables.find_runs()
    assert [cell(table(task="push"), "R90", "other", *of).get("seeds") for of in ((100, 1.8), (0, 0))] == [1, 1]
    assert "50.0" in tables.make_table("test", "push", runs)[0]
    names = plot_curves.save_figures(tmp_path, runs, Flags(), [".png"])
    assert {"fig-learning-push", "fig-success-push", "fig-error-push", "fig-trajectories-push"} <= set(names)


def test_runs_named_with_runs_are_all_drawn_whatever_their_flags(tmp_path):
    for i, variant in enumerate(("", "n_step=1")):
        write_run(tmp_path / f"x/{i}", success=(1, 1), variant=variant)
    runs = tables.find_runs([tmp_path / "x"])[0]
    flags = Flags(runs=(tmp_path / "x",))
    assert len(legend(plot_curves.learning_figure("p2p", runs, flags).axes[0])) == 2
    titles = [ax.get_title() for ax in plot_curves.error_figure("p2p", runs, flags).axes]
    assert len(titles) == 2 and "n_step=1" in "".join(titles)


def test_the_symmetry_figure_counts_real_demonstrations_and_partitions(tmp_path):
    one, all_ = (1, 0, 0, 0), (1, 1, 1, 1)
    for i, (success, config) in enumerate((
        (one, {"num_demos": 5, "symmetry": "none"}), (all_, {"num_demos": 20, "symmetry": "none"}),
        (all_, {"num_demos": 20, "symmetry": "gas"}),  # of 4 partitions: 5 real ones
        (one, {"num_demos": 20, "symmetry": "gas", "seed": 1}),
        (one, {"num_demos": 10, "symmetry": "gas", "partitions": 2, "variant": "partitions=2"}),  # 5 real ones too
        (one, {"num_demos": 20, "symmetry": "gas", "partitions": 2, "variant": "partitions=2"}),
        (all_, {"num_demos": 20, "symmetry": "gas", "variant": "n_step=1"}), (None, {"num_demos": 20}),
        (one, {"num_demos": 0, "symmetry": "none"}), (one, {"num_demos": 9, "lambda_bc": 1}),
    )):  # fmt: skip
        write_run(tmp_path / f"runs/{i}", success=success, **config)
    over_n, over_K = figure("symmetry").axes
    lines = {line.get_label(): line.get_xydata() for ax in (over_n, over_K) for line in ax.lines}
    drawn = {"gas (2 seeds)": [[5, 62.5]], "none (1 seed)": [[5, 25], [20, 100]],
             "5 recorded demonstrations (1 to 2 seeds)": [[2, 25], [4, 62.5]],
             "$N_{demos}=20$ (1 to 2 seeds)": [[2, 25], [4, 62.5]]}  # fmt: skip
    assert set(lines) == set(drawn)
    for label, points in drawn.items():  # lines stand side by side
        np.testing.assert_allclose(lines[label], points, rtol=0.05)
    shutil.rmtree(tmp_path / "runs/1")
    assert figure("symmetry") is None  # one count of demonstrations is no curve


def test_an_error_curve_is_over_the_successful_trials_and_each_counts_alike_at_every_t(tmp_path):
    write_run(tmp_path / "runs/a", success=(1, 0, 1))  # 3 and 5 steps from 50 to 5 cm
    write_run(tmp_path / "runs/b", success=(0, 0, 1), num_demos=7)
    write_run(tmp_path / "runs/c", success=(0, 0, 0), num_demos=80, lambda_bc=1)
    write_run(tmp_path / "runs/d", success=(0, 0, 1, 1), num_demos=0, lambda_bc=0)
    drawn = figure("error")
    ax, plain, own = (ax for ax in drawn.axes if ax.get_visible())
    assert ax.get_xlim()[1] >= 0.12 and ax.get_ylim()[1] >= 50  # all of every panel is seen
    assert plain.get_title().startswith("$N_{demos}=0$, $\\lambda_{BC}=0$")
    assert ax.get_title() == "$N_{demos}=100$, $\\lambda_{BC}=1.8$\n2 of 3 trials, 1 seed" and "=7$" in own.get_title()
    t, mean = ax.lines[0].get_data()
    assert t == pytest.approx([0, 0.02, 0.04, 0.06, 0.08, 0.1])
    assert mean == pytest.approx([50, (35 + 41) / 2, (20 + 32) / 2, (5 + 23) / 2, (5 + 14) / 2, 5])


def test_trajectories_are_the_successful_ones_of_the_best_run(tmp_path):
    write_run(tmp_path / "runs/a", success=(1, 0, 1))
    write_run(tmp_path / "runs/b", success=(0, 0, 1), seed=1)
    drawn = figure("trajectories")
    assert all([line.get_marker() for line in ax.lines].count("*") == 2 for ax in drawn.axes)
    assert "seed 0" in drawn.get_suptitle()


def write_demos(path, task="p2p"):
    P_e = np.arange(15, dtype=np.float32).reshape(5, 3)  # two episodes, of 2 and 1 steps
    s = np.zeros((5, 22), np.float32)
    s[:, 16:19], s[:, 19:22] = 1, 1 - P_e
    np.savez(path, obs=s[[0, 1, 3]], obs2=s[[1, 2, 4]], length=np.array([2, 1]), partition=np.array([3, 0]),
             success=np.array([True, False]), meta=np.array(json.dumps({"task": task})))  # fmt: skip
    return P_e


def test_demonstrations_are_drawn_from_a_recording_and_published_as_TCP_paths(tmp_path):
    P_e = write_demos(tmp_path / "d.npz")
    stars = [line.get_marker() for line in figure("demos", demos=tmp_path / "d.npz").axes[0].lines].count("*")
    publish.publish([tmp_path / "d.npz"])
    _, paths = tables.read_paths(tmp_path / "results/demos-p2p.npz")
    assert [path["tcp"].tolist() for path in paths] == [P_e[:3].tolist(), P_e[3:].tolist()]
    assert [bool(path["success"]) for path in paths] == [True, False] and np.isnan(paths[0]["object"]).all()
    assert stars == [line.get_marker() for line in figure("demos").axes[0].lines].count("*") == 1


def test_a_random_path_has_a_way_point_in_each_sector_and_is_linear_in_cylinder_coordinates():
    x, y = plot_curves.random_paths(np.random.default_rng(0), 1, range(3), 8)[0].T
    theta, rho = np.arctan2(y, x), np.hypot(x, y)
    assert (theta[::50] // (math.pi / 4)).tolist() == [0, 1, 2] and rho.min() >= 0.3 and rho.max() < 0.7
    for values in (theta, rho):
        assert np.diff(values[:51]) == pytest.approx((values[50] - values[0]) / 50)


def test_path_lengths_are_the_same_each_time_and_shrink_with_K():
    demos, regular = plot_curves.path_lengths(1, n=20)
    assert np.array_equal(demos, regular) and np.array_equal(demos, plot_curves.path_lengths(1, n=20)[0])
    means = [[lengths.mean() for lengths in plot_curves.path_lengths(K, n=100)] for K in (2, 4, 12)]
    assert means[0][0] > means[1][0] > means[2][0] and all(demo < path for demo, path in means)


def test_the_workspace_picture_shows_the_arm_and_labels_its_four_active_joints():
    (ax,) = plot_curves.workspace_figure().axes
    assert [text.get_text() for text in ax.texts] == ["#1", "#2", "#3", "#4"]
    assert 0.01 < (ax.images[0].get_array()[..., 3] > 0).mean() < 0.3


@pytest.mark.filterwarnings("error")  # a warning would reach the terminal
def test_a_figure_is_written_as_png_and_pdf_or_to_the_named_file(tmp_path):
    write_run(tmp_path / "runs/a")
    main(["--figure", "learning", "--task", "p2p"])
    main(["--figure", "success", "--task", "p2p", "--out", str(tmp_path / "new/x.pdf")])
    assert sorted(p.name for p in (tmp_path / "figures").iterdir()) == ["fig-learning-p2p.pdf", "fig-learning-p2p.png"]
    assert (tmp_path / "figures/fig-learning-p2p.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "new/x.pdf").read_bytes().startswith(b"%PDF")


def test_all_writes_every_table_and_figure_and_says_how_to_fill_the_gaps(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(plot_curves, "save_figure", lambda name, *rest: name in ("learning", "workspace"))
    write_run(tmp_path / "runs/a", task="pnp", algo="ppo", num_demos=400, lambda_bc=15)
    main(["--all", str(tmp_path / "out")])
    said = capsys.readouterr().out
    names = {f"table-{kind}-{task}.{end}" for kind in (*tables.METRICS, *tables.COMPARED)
             for task in ("p2p", "p2po", "pnp") for end in ("txt", "csv")}  # fmt: skip
    assert {path.name for path in (tmp_path / "out").iterdir()} == names
    missing = "lambda=5 lambda=10 demos=150 demos=250 baseline"  # and no --epochs: a recipe carries its own length
    assert f"sweep.py --task pnp --recipe robust --columns {missing} --seeds 5" in said
    assert "runs/a --trials 500" in said and "evaluate.py --pid --task p2p --gains authors" in said
    assert "--out data/runs/pid-p2p-authors" in said and "pid_demo.py --task p2po --record 40" in said


# ---- publishing ------------------------------------------------------------------------------------------------------


def index(tmp_path):
    return list(csv.DictReader((tmp_path / "results/index.csv").open()))


def publishable(folder, **config):
    return write_run(folder, [1.0] * 200, **({"success": (1, 0)} | config))


def test_a_published_run_is_whole_without_machine_paths_and_the_same_bytes_each_time(tmp_path):
    command = ["/home/me/ddpg_demoease.py", "--demos=/home/me/d.npz"]
    run = publishable(tmp_path / "runs/a", command=command, data_dir="/x")
    (run / "evaluation-horizon_600.csv").write_text(trials((1, 1)))
    contents = []
    for _ in range(2):
        main(["--publish", str(run)])
        contents.append({path.name: path.read_bytes() for path in (tmp_path / "results/a").iterdir()})
    assert contents[0] == contents[1] and sorted(contents[0]) == [
        "config.json", "episodes.csv.gz", "evaluation-horizon_600.csv.gz", "evaluation.csv.gz", "policy.pt",
        "progress.csv.gz", "trajectories.npz"]  # fmt: skip
    config = json.loads(contents[0]["config.json"])
    assert config["command"] == ["ddpg_demoease.py", "--demos=d.npz"] and config["data_dir"] == "x"
    assert gzip.decompress(contents[0]["episodes.csv.gz"]) == (run / "episodes.csv").read_bytes()
    (row,) = index(tmp_path)
    assert [row[k] for k in ("name", "num_demos", "env_steps", "finished", "eval_success", "P_scs_percent")] == [
        "a", "100", "4000", "1", "0.5", "50"]  # fmt: skip
    assert row["git_commit"] == COMMIT


@pytest.mark.parametrize("config", [{"num_demos": 7}, {"variant": "n_step=1"}])
def test_trajectories_are_published_of_what_a_figure_may_show(tmp_path, config):
    main(["--publish", str(publishable(tmp_path / "runs/a", **config))])
    assert (tmp_path / "results/a/evaluation.csv.gz").exists()
    assert not (tmp_path / "results/a/trajectories.npz").exists()


def test_a_run_without_a_successful_trial_is_published_and_drawn(tmp_path):
    publish.publish([publishable(tmp_path / "x/a", success=(0, 0))])
    assert tables.read_errors(tmp_path / "results/a/trajectories.npz") == []
    assert figure("error") is None and figure("trajectories") is None


def test_what_is_published_makes_the_same_tables_and_figures_and_can_be_published_from_another_clone(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(publish, "TRIALS", 3)
    run = publishable(tmp_path / "x/a", success=(1, 0, 1))
    publish.publish([run])
    for kind in tables.METRICS:
        own, published = (table(kind, named=[folder]).drop(columns="values") for folder in (run, tables.RESULTS))
        pd.testing.assert_frame_equal(own, published)
    own, published = (figure("error", named=[folder]).axes[0].lines[0].get_ydata() for folder in (run, tables.RESULTS))
    assert own == pytest.approx(published, abs=0.05)
    assert len(tables.read_paths(tmp_path / "results/a/trajectories.npz")[1]) == 2
    before = {path.name: path.read_bytes() for path in (tmp_path / "results/a").iterdir()}
    publish.publish([shutil.copytree(tmp_path / "results/a", tmp_path / "clone/a")])
    assert {path.name: path.read_bytes() for path in (tmp_path / "results/a").iterdir()} == before


def test_only_the_run_of_a_task_and_recipe_that_is_best_in_validation_keeps_its_weights(tmp_path):
    runs = [publishable(tmp_path / f"runs/{i}", seed=i, success=won, validated=sum(won) ** -0.5)
            for i, won in enumerate([(1, 1), (1, 0)])]  # fmt: skip
    runs.append(publishable(tmp_path / "runs/2", recipe="paper", success=(0, 0), epochs=3))
    runs.append(publishable(tmp_path / "runs/3", success=(1, 1), variant="n_step=1"))
    runs.append(publishable(tmp_path / "runs/4", validated=1, lambda_bc=0.1))
    for run in runs:
        publish.publish([run])
    assert sorted(path.parent.name for path in (tmp_path / "results").rglob("policy.pt")) == ["1", "2"]
    assert [row["finished"] for row in index(tmp_path)] == ["1", "1", "0", "1", "1"]


def test_a_run_takes_the_place_of_an_older_one_of_the_same_name(tmp_path):
    write_run(tmp_path / "results/a", [5.0] * 9)
    (tmp_path / "results/a/agent.gif").write_text("old")
    publish.publish([publishable(tmp_path / "runs/a")])
    assert not (tmp_path / "results/a/agent.gif").exists() and cell(table(), "R90")["mean"] == 1


def respoil(path, **arrays):
    np.savez(path, **(dict(np.load(path)) | arrays))


@pytest.mark.parametrize("spoil, says", [
    (lambda run: (run / "config.json").write_text(json.dumps(CONFIG)), "git commit unknown"),
    (lambda run: (run / "config.json").write_text(json.dumps(CONFIG | {"versions": {"git_commit": COMMIT + "-dirty"}})),
     "-dirty"),
    (lambda run: (run / "episodes.csv").unlink(), "episodes.csv: no such file"),
    (lambda run: (run / "policy.pt").write_bytes(b"PK"), "policy.pt: cut short"),
    (lambda run: (run / "progress.csv").write_text("epoch,env_steps,demo_env_steps,seconds\n1,90000,0,1\n"),
     "do not fit together"),
    (lambda run: (run / "evaluation.csv").write_text(trials((1, 0, 1))), "is not of trials 0 to 1"),
    (lambda run: (run / "trajectories.npz").write_bytes(b"PK"), "trajectories.npz"),
    (lambda run: respoil(run / "trajectories.npz", error=np.zeros(3)), "do not fit together"),
    (lambda run: (run / "evaluation.csv").write_text(trials((1, 1))), "not of evaluation.csv's trials"),
])  # fmt: skip
def test_nothing_is_published_where_a_run_is_not_whole_or_of_no_clean_commit(tmp_path, spoil, says):
    good, run = publishable(tmp_path / "runs/good"), publishable(tmp_path / "runs/a", seed=1)
    spoil(run)
    with pytest.raises(BadInput, match=says) as error:
        publish.publish([good, run])
    assert str(run) in str(error.value) and not (tmp_path / "results").exists()


# ---- pages -----------------------------------------------------------------------------------------------------------


def test_report_rewrites_the_marked_blocks_from_data_results_and_leaves_the_rest(tmp_path, monkeypatch):
    drawn = {"error": "fig-error-p2p", "workspace": "fig-workspace"}
    monkeypatch.setattr(plot_curves, "save_figures", lambda *rest, **look: drawn.values())
    write_run(tmp_path / "results/a", success=(1, 0))
    for name in (*drawn.values(), "fig-success-p2p"):  # the last is of runs that are gone
        (tmp_path / f"results/{name}.png").touch()
    write_run(tmp_path / "runs/b", success=(1, 1), seed=1)  # not published: not on the pages
    page = tmp_path / "README.md"
    page.write_text("before\n<!-- results -->\nold\n<!-- /results -->\nbetween\n<!-- figures-p2p -->\n"
                    "<!-- /figures-p2p -->\nafter <!-- results -->\n")  # fmt: skip
    main(["--report"])
    first = page.read_text()
    assert "| P2P | Demo-EASE DDPG, robust | 99.6 | 50.0 [" in first
    assert "old" not in first and first.startswith("before\n")
    assert "between\n" in first and first.endswith("after <!-- results -->\n")
    assert "-->\n![fig-error-p2p](results/fig-error-p2p.png)\n<!--" in first
    main(["--report"])
    assert page.read_text() == first
    page.write_text("<!-- result -->\n<!-- /result -->\n")
    with pytest.raises(BadInput, match="README.md: <!-- result -->"):
        main(["--report"])


def test_a_mark_without_its_other_mark_is_named(tmp_path, monkeypatch):
    publish.publish([publishable(tmp_path / "x/a")])
    (tmp_path / "README.md").write_text("<!-- results -->\nold\n")
    with pytest.raises(BadInput, match="README.md: <!-- results --> is one mark alone"):
        main(["--report"])


def test_the_pages_hold_what_the_published_files_say(monkeypatch):
    monkeypatch.undo()  # the real folders
    names = [f"{name}-{task}{of}" for name in plot_curves.OF_TASK for task in tables.TITLES for of in ("", "-paper")]
    drawn = [tables.RESULTS / f"fig-{name}.png" for name in [*names, *plot_curves.OF_NO_TASK]]
    for page, text in publish.report([path for path in drawn if path.exists()]).items():
        assert page.read_text() == text, f"{page} is not what python plot_curves.py --report writes"
    assert "<!-- findings -->" in (tables.RESULTS / "README.md").read_text()


# ---- bad input -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("line, names", [
    ("", "--table, --figure"), ("--table training", "--task"), ("--table training --task walk", "walk"),
    ("--table training --task p2p --figure error", "one of them"), ("--figure workspace --task p2p", "--task"),
    ("--publish x --runs x", "--runs"), ("--all x --csv x.csv", "--csv"), ("--report --out x.png", "--out"),
    ("--figure error --task p2p --demos x", "--demos"), ("--figure learning --task p2p --out x.gif", ".png or .pdf"),
    ("--figure learning --task p2p", "nothing to draw"), ("--table test --task p2p --runs /nowhere", "--runs /nowhere"),
])  # fmt: skip
def test_a_bad_flag_is_one_line_that_names_it(line, names):
    with pytest.raises(BadInput, match=names):
        main(line.split())


def test_named_runs_of_another_task_only_are_an_error(tmp_path):
    write_run(tmp_path / "x/a", task="pnp", algo="ppo")
    with pytest.raises(BadInput, match="--runs: no run of task p2p"):
        main(["--table", "training", "--task", "p2p", "--runs", str(tmp_path / "x")])


@pytest.mark.parametrize("file, content, says", [
    ("config.json", "{", "JSON"), ("config.json", "5", "config.json"), ("config.json", '{"algo": "ddpg"}', "'task'"),
    ("episodes.csv", "episode,length\n1,2\n", "return"), ("episodes.csv", "\udcff\udcfe", "episodes.csv"),
    ("episodes.csv", "episode,env_steps,return,length,success\n1,1,oops,1,0\n2,2,1,1,0\n", "no number in line 2"),
    ("config.json", json.dumps(CONFIG | {"variant": None}), "variant"), ("config.json", json.dumps(
        CONFIG | {"symmetry": "gas", "partitions": 0}), "partitions 0"),
    ("episodes.csv", "episode,env_steps,return,length,success\n1,1,,1,0\n2,2,1,1,0\n", "no number in line 2"),
    ("progress.csv", None, "no such file"), ("evaluation.csv", "trial,success\n0,1\n", "length"),
])  # fmt: skip
def test_a_bad_file_is_one_line_that_names_it_and_nothing_is_written(tmp_path, file, content, says):
    run = write_run(tmp_path / "runs/a", success=(1, 1))
    (run / file).unlink()
    if content is not None:
        (run / file).write_bytes(content.encode(errors="surrogateescape"))
    with pytest.raises(BadInput, match=says) as error:
        main(["--table", "test", "--task", "p2p", "--csv", str(tmp_path / "t.csv")])
    assert str(error.value).startswith(f"{run / file}: ") and not (tmp_path / "t.csv").exists()


def test_a_file_that_cannot_be_written_is_one_line(tmp_path):
    (tmp_path / "taken.csv").mkdir()
    with pytest.raises(BadInput, match="taken.csv"):
        main(["--table", "training", "--task", "p2p", "--csv", str(tmp_path / "taken.csv")])
    assert [path.name for path in tmp_path.iterdir()] == ["taken.csv"]


def test_as_a_command_bad_input_is_exit_code_2_and_one_line(tmp_path):
    command = [sys.executable, Path(plot_curves.__file__), "--table", "training", "--task", "p2p", "--runs", tmp_path]
    done = subprocess.run(command, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1) and "--runs" in done.stderr
