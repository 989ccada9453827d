"""tables.py: metrics on curves whose numbers follow by hand, and which runs are read and averaged."""

import gzip
import math
import shutil

import numpy as np
import pandas as pd
import pytest

import tables
from run_folders import PID, cell, table, trials, write_run

pytestmark = pytest.mark.usefixtures("folders")


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
    write_run(tmp_path / "runs/b", seed=1, versions={"git_commit": "f" * 40 + "-dirty"})
    text, _, rows = tables.make_table("training", "p2p", tables.find_runs()[0])
    assert "Commits of ddpg robust mirror 4k steps: 0123456, fffffff-dirty" in text and rows.seeds.max() == 2


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


def test_pairs_that_the_paper_ranks_are_counted_by_what_our_seeds_say_of_them(tmp_path):
    for lam, *values in ((0.1, 0, 4), (0.6, 1, 5), (1.8, 80, 81)):
        for seed, value in enumerate(values):
            write_run(tmp_path / f"runs/{lam}-{seed}", [value] * 60, lambda_bc=lam, seed=seed)
    write_run(tmp_path / "runs/one", [0.0] * 60, num_demos=0, lambda_bc=0)
    text = tables.make_table("training", "p2p", tables.find_runs()[0])[0]
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


def test_seeds_that_all_lie_on_one_side_are_marked_where_chance_seldom_does_that():
    assert tables.separated([1, 2, 3], [4, 5, 6, 7, 8]) and tables.separated([9, 9, 9, 9], [1, 1, 1, 8])
    assert not tables.separated([1, 2, 3], [4, 5, 6])  # 1 time in 10
    assert not tables.separated([1, 2, 4], [4, 5, 6, 7, 8]) and not tables.separated([1, 2, math.nan], [4] * 5)
    assert tables.difference("P_scs_percent", [0, 90], [100, 100])[1] == -100


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
def test_an_own_run_takes_the_published_ones_place_once_it_is_finished_and_that_is_said(
    tmp_path, monkeypatch, steps, kept
):
    write_run(tmp_path / "results/a", versions={"git_commit": "f" * 40})
    write_run(tmp_path / "runs/a", steps=steps)
    monkeypatch.setattr(tables, "RUNS", tables.RUNS * 2)  # as in the repository's own folder
    runs, remarks = tables.find_runs()
    assert runs.curves[0].folder == tmp_path / kept / "a"
    assert len([remark for remark in remarks if "left out" in remark]) == 1


def test_of_runs_of_one_seed_the_most_tested_counts_and_mixed_numbers_of_trials_are_named(tmp_path):
    write_run(tmp_path / "results/a", success=(1, 1, 1))
    write_run(tmp_path / "runs/a", success=(0, 0))
    write_run(tmp_path / "runs/b", success=(1, 1), seed=1)
    text = tables.make_table("test", "p2p", tables.find_runs()[0])[0]
    assert "Seeds of ddpg robust mirror 4k steps were tested in 2 or 3 trials." in text and "100.0 [-]" in text
