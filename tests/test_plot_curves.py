"""plot_curves.py: the metrics on curves whose numbers follow by hand, which runs are read, and what bad input says."""
import csv
import gzip
import io
import json
import math
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

import plot_curves
from plot_curves import interval, over_seeds, training_metrics

CONFIG = {"task": "p2p", "algo": "ddpg", "recipe": "robust", "num_demos": 100, "lambda_bc": 1.8, "symmetry": "so2",
          "seed": 0, "epochs": 2, "steps_per_epoch": 2000, "quick": False}


@pytest.fixture(autouse=True)
def folders(tmp_path, monkeypatch):
    """The default folders lie in an empty place, so that no test sees or writes real results."""
    for name in ("RESULTS", "RUNS", "FIGURES"):
        monkeypatch.setattr(plot_curves, name, tmp_path / name.lower())


def write_run(folder, returns=(1.0,) * 60, steps=4000, compress=False, success=None, **config):
    """A run folder like a training script's; `steps`: environment steps after the last epoch in progress.csv;
    success: that of each trial in evaluation.csv and trajectories.npz, if any. Trial i takes 3 + i steps and has the
    return 10 + i; its error falls from 50 cm to 5 cm in equal steps."""
    folder.mkdir(parents=True)
    (folder / "config.json").write_text(json.dumps(CONFIG | config))
    rows = "".join(f"{i},{20 * i},{value},20,0,\n" for i, value in enumerate(returns, start=1))
    tables = {"episodes.csv": "episode,env_steps,return,length,success,collision\n" + rows,
              "progress.csv": f"epoch,env_steps,EpRet,eval_success\n1,{steps // 2},,0.5\n2,{steps},,\n"}
    if success is not None:
        rows = "".join(f"{i},{won},,0,{3 + i},{10 + i},{20 + i},5,6\n" for i, won in enumerate(success))
        tables["evaluation.csv"] = ("trial,success,failure,grasped,length,return,effort_percent,final_error_cm,e95_cm\n"
                                    + rows)
        n = np.arange(len(success)) + 3
        np.savez(folder / "trajectories.npz", length=n, success=np.array(success, bool), goal=np.full((len(n), 3), 0.4),
                 error=np.concatenate([np.linspace(0.5, 0.05, k + 1) for k in n]).astype(np.float32),
                 tcp=np.full((np.sum(n + 1), 3), 0.5, np.float32), object=np.full((len(n), 3), np.nan))
    for name, text in tables.items():
        path = folder / (name + ".gz" * compress)
        path.write_bytes(gzip.compress(text.encode()) if compress else text.encode())
    return folder


def table(capsys, *runs, task="p2p", kind="training"):
    """(text, rows of the CSV) of a table of these run folders; of the default ones if none is named."""
    out = plot_curves.FIGURES.parent / "table.csv"
    named = ["--runs", *map(str, runs)] if runs else []
    plot_curves.main(["--table", kind, "--task", task, "--csv", str(out), *named])
    return capsys.readouterr().out, list(csv.DictReader(io.StringIO(out.read_text())))


def cell(rows, metric, sweep="lambda", num_demos="100", lambda_bc=1.8):
    """The one CSV line of this metric and column."""
    found = [row for row in rows if row["metric"] == metric and row["sweep"] == sweep
             and row["num_demos"] == num_demos and float(row["lambda_bc"]) == lambda_bc]
    assert len(found) == 1
    return found[0]


def error_line(capsys, *argv):
    """What main says on bad input: exit code 2, nothing on standard output, one line on standard error."""
    with pytest.raises(SystemExit) as stopped:
        plot_curves.main(list(map(str, argv)))
    out, err = capsys.readouterr()
    assert stopped.value.code == 2 and out == "" and err.count("\n") == 1
    return err


# ------------------------------------------------------------------------------------------ metrics

def test_R10_and_R90_are_means_over_a_tenth_of_the_episodes_rounded_up():
    metrics = training_metrics(np.arange(11.0))  # a tenth of 11 is 2 episodes: (0 + 1) / 2 and (9 + 10) / 2
    assert (metrics["R10"], metrics["R90"], metrics["I_R"]) == (0.5, 9.5, 9.0)
    metrics = training_metrics(np.arange(10.0))  # a tenth of 10 is 1
    assert (metrics["R10"], metrics["R90"], metrics["I_R"]) == (0.0, 9.0, 9.0)


def test_T50_is_the_first_full_window_above_half_of_R90():
    # R90 = 10; 25 tens among the last 50 (episode 125) make exactly 5, the 26th exceeds it
    assert training_metrics(np.repeat([0.0, 10.0], 100))["T50"] == 126


def test_T50_counts_no_window_of_fewer_than_50_episodes():
    assert training_metrics(np.full(200, 10.0))["T50"] == 50
    assert math.isnan(training_metrics(np.full(49, 10.0))["T50"])


def test_T50_is_not_available_where_R90_is_not_positive_or_never_half_reached():
    assert math.isnan(training_metrics(np.repeat([5.0, -1.0], 100))["T50"])
    assert math.isnan(training_metrics(np.repeat([5.0, 0.0], 100))["T50"])
    assert math.isnan(training_metrics(np.repeat([0.0, 10.0], [90, 10]))["T50"])  # the last window's mean is 2


def test_interval_of_two_seeds_spans_them_and_of_equal_seeds_is_their_value():
    assert interval(np.array([0.0, 1.0])) == (0.0, 1.0, "BCa")  # resampled means: 0, 1/2, 1 with 1/4, 1/2, 1/4
    assert interval(np.array([7.0, 7.0, 7.0])) == (7.0, 7.0, "percentile")


def test_interval_lies_within_the_seeds_around_their_mean_and_is_the_same_each_time():
    values = np.array([1.0, 2.0, 3.0, 4.0, 10.0])
    low, high, method = interval(values)
    assert 1 < low < 3 and 5 < high < 10 and method == "BCa"
    assert interval(values) == (low, high, method)


def test_a_single_seed_has_no_interval_and_no_mark():
    one = over_seeds(np.array([3.0]), paper=100.0, digits=2)
    assert one["mean"] == 3 and one["interval"] == "" and math.isnan(one["low"]) and one["paper_outside"] == 0
    assert plot_curves.cell_text(one, 2) == "  3.00 [-]"


def test_NA_seeds_are_counted_and_not_averaged():
    some = over_seeds(np.array([300.0, math.nan, 500.0]), paper=398, digits=0)
    assert (some["mean"], some["low"], some["high"], some["na_seeds"]) == (400, 300, 500, 1)
    assert plot_curves.cell_text(some, 0) == "   400 [300, 500] (1 N/A)"
    none = over_seeds(np.array([math.nan, math.nan]), paper=398, digits=0)
    assert plot_curves.cell_text(none, 0) == "   N/A [-] (2 N/A)"


@pytest.mark.parametrize("paper, outside", [(0.99, 1), (1.0, 0), (2.0, 0), (3.0, 0), (3.01, 1), (math.nan, 0)])
def test_a_cell_is_marked_where_the_papers_value_lies_outside_the_interval_as_printed(paper, outside):
    marked = over_seeds(np.array([1.004, 2.996]), paper, digits=2)  # printed [1.00, 3.00]
    assert marked["paper_outside"] == outside
    assert plot_curves.cell_text(marked, 2).endswith(" *") == bool(outside)


# ------------------------------------------------------------------------------------------ table

def test_without_runs_the_table_is_the_papers_in_its_order(capsys):
    text, rows = table(capsys)
    lines = [line.split() for line in text.splitlines() if " paper " in line]
    assert lines[0] == ["lambda_BC", "100", "0.1", "paper", "-0.44", "3.72", "4.16", "657"]
    assert lines[6] == ["baseline", "0", "0", "paper", "-0.56", "0.90", "1.49", "486"]  # I_R as printed, not 1.46
    assert len(lines) == text.count("no runs") == 7 and len(rows) == 7 * 4
    assert "as CSV" in text.splitlines()[-1]
    assert "N/A" in [line for line in table(capsys, task="p2po")[0].splitlines() if line.startswith("baseline")][0]


def test_the_table_prints_the_mean_over_seeds_with_interval_beside_the_paper(tmp_path, capsys):
    for seed, value in enumerate((1.0, 3.0)):
        write_run(tmp_path / f"runs/{seed}", np.repeat([-0.12, value], 50), seed=seed)
    text, rows = table(capsys)
    ours = text.splitlines()[text.splitlines().index(next(s for s in text.splitlines() if " 8.94 " in s)) + 1]
    assert ours.split("  ")[-1].strip() == "2" and "ddpg robust so2 4k steps" in ours  # two seeds
    assert "2.00 [1.00, 3.00] *" in ours and "-0.12 [-0.12, -0.12]  " in ours
    R90 = cell(rows, "R90")
    assert [R90[k] for k in ("paper", "mean", "low", "high", "interval", "seeds", "paper_outside")] == [
        "8.94", "2.0", "1.0", "3.0", "BCa", "2", "1"]
    assert [R90[k] for k in ("algo", "recipe", "symmetry", "total_env_steps")] == ["ddpg", "robust", "so2", "4000"]
    assert cell(rows, "R10")["paper_outside"] == "0" and cell(rows, "R90", lambda_bc=0.6)["mean"] == ""


def test_no_demonstrations_with_lambda_1_and_the_baseline_are_different_columns(tmp_path, capsys):
    write_run(tmp_path / "runs/a", [2.0] * 60, num_demos=0, lambda_bc=1)
    write_run(tmp_path / "runs/b", [3.0] * 60, num_demos=0, lambda_bc=0)
    _, rows = table(capsys)
    assert cell(rows, "R90", "demos", "0", 1.0)["mean"] == "2.0"
    assert cell(rows, "R90", "baseline", "0", 0.0)["mean"] == "3.0"


def test_the_pick_and_place_run_400_15_stands_in_both_sweeps(tmp_path, capsys):
    write_run(tmp_path / "runs/a", task="pnp", algo="ppo", num_demos=400, lambda_bc=15)
    _, rows = table(capsys, task="pnp")
    assert [cell(rows, "R90", sweep, "400", 15.0)["mean"] for sweep in ("lambda", "demos")] == ["1.0", "1.0"]


@pytest.mark.parametrize("config", [{"lambda_bc": 7.5}, {"num_demos": 80}, {"algo": "ppo"}])
def test_a_run_of_no_printed_column_is_listed_as_not_in_the_papers_table(tmp_path, capsys, config):
    write_run(tmp_path / "runs/a", **config)
    text, rows = table(capsys)
    assert text.count("not in the paper's table") == 1 and text.count("no runs") == 7
    assert [(row["mean"], row["paper"]) for row in rows if row["sweep"] == "other" and row["metric"] == "R90"] == [
        ("1.0", "")]


@pytest.mark.parametrize("config", [{"recipe": "paper"}, {"symmetry": "gas"}, {"epochs": 1}, {"variant": "gamma=0.9"}])
def test_runs_that_differ_in_recipe_symmetry_variant_or_length_are_never_averaged_together(tmp_path, capsys, config):
    write_run(tmp_path / "runs/a", [1.0] * 60)
    write_run(tmp_path / "runs/b", [3.0] * 60, **config)
    _, rows = table(capsys)
    assert sorted(row["mean"] for row in rows if row["metric"] == "R90" and row["mean"]) == ["1.0", "3.0"]


# ------------------------------------------------------------------------------------------ test table

def test_the_test_table_averages_success_over_trials_and_the_rest_over_the_successful_ones(tmp_path, capsys):
    write_run(tmp_path / "runs/a", success=(1, 0, 1, 0))
    text, rows = table(capsys, kind="test")
    assert [float(cell(rows, metric)["mean"]) for metric in ("P_scs_percent", "T_eff", "R_test", "E_95_cm")] == [
        50, 21, 11, 6]
    one = cell(rows, "P_scs_percent")
    assert [one[k] for k in ("interval", "paper", "seeds", "paper_outside")] == ["Wilson over trials", "99.6", "1", "1"]
    assert "50.0 [15.0, 85.0] *" in text


def test_without_a_successful_trial_only_the_success_rate_is_known(tmp_path, capsys):
    write_run(tmp_path / "runs/a", success=(0, 0))
    _, rows = table(capsys, kind="test")
    assert (cell(rows, "P_scs_percent")["mean"], cell(rows, "T_eff")["mean"]) == ("0.0", "")


def test_several_seeds_have_a_bootstrap_interval_over_seeds(tmp_path, capsys):
    write_run(tmp_path / "runs/a", success=(1, 1))
    write_run(tmp_path / "runs/b", success=(1, 0), seed=1)
    _, rows = table(capsys, kind="test")
    P = cell(rows, "P_scs_percent")
    assert [P[k] for k in ("mean", "low", "high", "interval", "seeds")] == ["75.0", "50.0", "100.0", "BCa", "2"]


@pytest.mark.parametrize("successes, trials, low, high", [(0, 10, 0, 27.75), (10, 10, 72.25, 100),
                                                          (250, 500, 45.63, 54.37)])
def test_wilsons_interval_is_that_of_the_textbook(successes, trials, low, high):
    outcome = {"success": np.arange(trials) < successes}
    assert plot_curves.over_trials(outcome, "P_scs_percent")[:2] == pytest.approx((low, high), abs=0.01)


def test_the_lambda_sweep_of_p2po_is_matched_by_sweep_and_value(tmp_path, capsys):
    write_run(tmp_path / "runs/a", task="p2po", num_demos=250, lambda_bc=1, success=(1, 1))
    write_run(tmp_path / "runs/b", task="p2po", num_demos=100, lambda_bc=1, success=(0, 0))
    _, rows = table(capsys, task="p2po", kind="test")
    sweep, demos = cell(rows, "P_scs_percent", "lambda", "250", 1), cell(rows, "P_scs_percent", "demos", "100", 1)
    assert (sweep["paper"], sweep["mean"], demos["paper"], demos["mean"]) == ("96.2", "100.0", "71.6", "0.0")


def test_published_evaluations_of_the_PID_stand_beside_the_papers_a_row_each(tmp_path, capsys):
    for gains, won in (("authors", 0), ("fast", 1)):
        write_run(tmp_path / f"results/pid-p2p-{gains}", success=(1, won))
        (tmp_path / f"results/pid-p2p-{gains}/config.json").write_text(
            json.dumps({"task": "p2p", "algo": "pid", "gains": gains}))
    text, rows = table(capsys, kind="test")
    pid = [(row["recipe"], row["mean"], row["paper"]) for row in rows
           if row["sweep"] == "pid" and row["metric"] == "P_scs_percent"]
    assert pid == [("authors", "50.0", "59.0"), ("fast", "100.0", "59.0")]
    assert "pid" not in table(capsys)[0]  # it has no training


def test_latex_has_the_papers_symbols_and_escapes_the_rest(tmp_path):
    write_run(tmp_path / "runs/a", success=(1, 1))
    rows = plot_curves.table_rows("test", "p2p", plot_curves.find_runs("p2p", None)[0])
    latex = plot_curves.table_latex("test", "p2p", rows)
    body = latex[latex.index("\\toprule"):]
    assert r"$P_{\mathrm{scs}}$ (\%)" in body and "lambda_BC" not in body and "so2 4k steps & 100.0 [" in body
    assert r"$^*$" in body and len({line.count("&") for line in body.splitlines() if "&" in line}) == 1


# ------------------------------------------------------------------------------------------ across seeds

def test_pairs_that_the_paper_ranks_are_listed_where_the_difference_may_be_0(tmp_path, capsys):
    for i, (lam, low, high) in enumerate([(0.1, 0, 4), (0.6, 1, 5), (1.8, 8, 9)]):
        write_run(tmp_path / f"runs/{i}-0", [low] * 60, lambda_bc=lam, seed=0)
        write_run(tmp_path / f"runs/{i}-1", [high] * 60, lambda_bc=lam, seed=1)
    write_run(tmp_path / "runs/one", [0.0] * 60, num_demos=0, lambda_bc=0)
    text, _ = table(capsys)
    listed = [line for line in text.splitlines() if "our difference" in line]
    assert len(listed) == 1 and "lambda_BC=0.1 and N_demos=100 lambda_BC=0.6: the paper's 3.72 and 6.83" in listed[0]
    assert "our difference -1.00 [-5.00, 3.00]" in listed[0]
    assert "not compared: 3 pairs with fewer than two seeds" in text


def test_the_interquartile_mean_is_that_of_the_middle_half():
    assert plot_curves.iqm(np.array([-100, 1, 2, 3, 4, 5, 6, 900.0])) == 3.5


def test_the_probability_of_improvement_counts_ties_half_and_averages_over_columns():
    x, y = [np.array([1.0, 2.0]), np.array([5.0])], [np.array([1.0, 0.0]), np.array([9.0, 7.0])]
    assert plot_curves.improvement(x, y) == (3.5 / 4 + 0) / 2


def test_the_stratified_bootstrap_draws_each_columns_seeds_among_themselves():
    strata = [np.array([1.0, 1.0]), np.array([5.0, 5.0])]  # columns differ, seeds do not
    assert plot_curves.stratified(lambda s: np.concatenate(s).mean(), strata) == (3, 3, 3)
    value, low, high = plot_curves.stratified(lambda s: np.concatenate(s).mean(), [np.array([0.0, 1.0])])
    assert (value, low, high) == (0.5, 0, 1)


def test_the_comparison_agrees_with_rliables_own_figures():
    """aggregate_iqm, probability_of_improvement and get_interval_estimates (reps=20000) of rliable 1.2.0, which needs
    arch 7.2.0 and with it pandas 2.3.3: too much to install for a test. Bootstraps differ in their random numbers."""
    rng = np.random.default_rng(1)
    x, y = rng.normal(size=(5, 3)), rng.normal(0.3, 1, size=(5, 3))  # (seeds, columns)
    value, low, high = plot_curves.stratified(lambda strata: plot_curves.iqm(np.concatenate(strata)), list(x.T))
    assert value == pytest.approx(0.19013407785655542, rel=1e-12)
    assert (low, high) == pytest.approx((-0.12367689, 0.43313092), abs=0.03)
    value, low, high = plot_curves.stratified(plot_curves.improvement, list(x.T), list(y.T))
    assert value == pytest.approx(0.5066666666666667, rel=1e-12)
    assert (low, high) == pytest.approx((0.28, 0.73333333), abs=0.03)


def test_groups_are_compared_below_the_training_table_where_they_have_two_seeds(tmp_path, capsys):
    for seed in (0, 1):
        write_run(tmp_path / f"runs/a{seed}", [8.0 + seed] * 60, seed=seed, success=(1, 1))
        write_run(tmp_path / f"runs/b{seed}", [2.0 + seed] * 60, seed=seed, recipe="paper", success=(1, 0))
    text, _ = table(capsys)
    assert "ddpg paper so2 4k steps: R90 mean 2.50, IQM 2.50 [2.00, 3.00], 2 runs in 1 column(s)" in text
    assert "P(ddpg paper so2 4k steps > ddpg robust so2 4k steps) in R90: 0.00 [0.00, 0.00]" in text
    assert "ddpg robust so2 4k steps: P_scs_percent mean 100.0" in text


# ------------------------------------------------------------------------------------------ which runs

def test_quick_runs_are_left_out_unless_they_are_named(tmp_path, capsys):
    write_run(tmp_path / "runs/a", quick=True)
    text, rows = table(capsys)
    assert "left out: 1 --quick run" in text and cell(rows, "R90")["seeds"] == "0"
    text, rows = table(capsys, tmp_path / "runs/a")
    assert "left out" not in text and cell(rows, "R90")["seeds"] == "1"


def test_runs_are_found_at_any_depth_and_a_folder_named_twice_counts_once(tmp_path, capsys):
    write_run(tmp_path / "elsewhere/deep/er/a", seed=0)
    write_run(tmp_path / "elsewhere/b", seed=1)
    _, rows = table(capsys, tmp_path / "elsewhere", tmp_path / "elsewhere/deep/../b")
    assert cell(rows, "R90")["seeds"] == "2"


def test_gzipped_tables_read_like_plain_ones(tmp_path, capsys):
    curve = np.sin(np.arange(100.0)) + 2
    plain = table(capsys, write_run(tmp_path / "plain", curve))
    assert table(capsys, write_run(tmp_path / "gzipped", curve, compress=True)) == plain


def test_an_unfinished_run_is_used_and_flagged_with_its_steps(tmp_path, capsys):
    write_run(tmp_path / "runs/a", seed=0)
    write_run(tmp_path / "runs/b", seed=1, steps=2600)
    text, rows = table(capsys)
    assert "2 (1 unfinished)" in text and "runs/b, 2,600 of 4,000 environment steps" in text
    assert "runs/a" not in text and cell(rows, "R90")["unfinished_seeds"] == "1"


def test_a_run_without_an_episode_yet_is_left_out_and_said_so(tmp_path, capsys):
    write_run(tmp_path / "runs/a", returns=(), steps=0)
    text, rows = table(capsys)
    assert "runs/a has no episode yet" in text and cell(rows, "R90")["seeds"] == "0"


def test_a_published_copy_of_a_run_is_no_second_seed(tmp_path, capsys):
    write_run(tmp_path / "runs/a")
    write_run(tmp_path / "results/a", compress=True)
    _, rows = table(capsys)
    assert cell(rows, "R90")["seeds"] == "1"


def test_of_a_run_that_went_on_after_its_beginning_was_published_the_longer_one_counts(tmp_path, capsys):
    write_run(tmp_path / "runs/a", [1.0] * 60)
    write_run(tmp_path / "results/a", [1.0] * 40)
    _, rows = table(capsys)
    assert cell(rows, "R90")["seeds"] == "1"
    (run,), _ = plot_curves.find_runs("p2p", None)
    assert run.returns.size == 60


@pytest.mark.parametrize("one, other, returns", [("runs/a", "runs/b", 1.0), ("results/a", "runs/b", 1.0),
                                                 ("results/a", "runs/a", 2.0), ("x/a", "y/a", 1.0)])
def test_two_runs_of_one_configuration_and_seed_clash(tmp_path, capsys, one, other, returns):
    write_run(tmp_path / one)
    write_run(tmp_path / other, [returns] * 60)
    err = error_line(capsys, "--table", "training", "--task", "p2p", "--runs", tmp_path)
    assert str(tmp_path / one) in err and str(tmp_path / other) in err


def test_a_rerun_of_a_published_run_is_shown_in_its_place_and_that_is_said(tmp_path, capsys):
    write_run(tmp_path / "results/a", [1.0] * 60)
    write_run(tmp_path / "runs/a", [2.0] * 60)
    out, rows = table(capsys)
    assert cell(rows, "R90")["seeds"] == "1" and float(cell(rows, "R90")["mean"]) == 2
    assert f"left out: {tmp_path / 'results/a'}; {tmp_path / 'runs/a'} is of the same" in out
    finished = (tmp_path / "runs/a/progress.csv").read_text()
    (tmp_path / "runs/a/progress.csv").write_text("epoch,env_steps,EpRet,eval_success\n1,2000,,0.5\n")
    out, rows = table(capsys)
    assert cell(rows, "R90")["seeds"] == "1" and float(cell(rows, "R90")["mean"]) == 1
    assert f"left out: {tmp_path / 'runs/a'}; {tmp_path / 'results/a'} is of the same" in out
    (tmp_path / "runs/a/progress.csv").write_text(finished)
    write_run(tmp_path / "runs/b", [3.0] * 60)  # which of the two is a guess
    assert "one only is allowed" in error_line(capsys, "--table", "training", "--task", "p2p")


# ------------------------------------------------------------------------------------------ figures

def test_the_figure_draws_each_sweep_with_the_baseline_and_the_papers_R90(tmp_path):
    for i, (N, lam) in enumerate([(100, 0.1), (80, 1), (0, 0), (300, 7)]):
        write_run(tmp_path / f"runs/{i}", [i + 1.0] * 60, num_demos=N, lambda_bc=lam)
    runs, _ = plot_curves.find_runs("p2p", None)
    axes = plot_curves.learning_figure("p2p", runs).axes
    panels = [{line.get_label(): line.get_ydata()[-1] for line in ax.lines if "seed" in line.get_label()}
              for ax in axes]
    both = {"DDPG (1 seed)": 3, r"$N_{demos}=300$, $\lambda_{BC}=7$ (1 seed)": 4}
    assert panels == [{r"$\lambda_{BC}=0.1$ (1 seed)": 1} | both, {r"$N_{demos}=80$ (1 seed)": 2} | both]
    dotted = [[line.get_ydata()[0] for line in ax.lines if line.get_linestyle() == ":"] for ax in axes]
    assert dotted == [[3.72, 0.9], [8.58, 0.9]]


def test_a_column_of_two_groups_is_named_once_with_the_seeds_of_each_in_the_order_of_their_lines(tmp_path):
    for i, symmetry in enumerate(("gas", "so2", "so2")):
        write_run(tmp_path / f"runs/{i}", seed=i, symmetry=symmetry)
    runs, _ = plot_curves.find_runs("p2p", None)
    figure = plot_curves.learning_figure("p2p", runs)
    assert [line.get_label() for line in figure.axes[0].lines if "seed" in line.get_label()] == [
        r"$\lambda_{BC}=1.8$ (2 + 1 seeds)"]
    first, second, _ = (text.get_text() for text in figure.legends[0].get_texts())
    assert "so2" in first and "gas" in second


def test_a_curve_is_the_mean_over_all_seeds_up_to_the_shortest_with_a_band(tmp_path):
    write_run(tmp_path / "runs/a", [1.0] * 100, seed=0)
    write_run(tmp_path / "runs/b", [3.0] * 150, seed=1)
    runs, _ = plot_curves.find_runs("p2p", None)
    ax, empty = plot_curves.learning_figure("p2p", runs).axes
    assert [text.get_text() for text in (*ax.texts, *empty.texts)] == ["", "no runs"]
    thick, thin = ax.lines[:2]
    assert thick.get_label() == r"$\lambda_{BC}=1.8$ (2 seeds)"
    assert (thick.get_xdata()[-1], set(thick.get_ydata())) == (100, {2.0})
    assert (thin.get_xdata()[-1], thin.get_ydata()[-1]) == (150, 3.0)
    band = ax.collections[0].get_paths()[0].vertices
    assert band[:, 0].max() == 100 and (band[:, 1].min(), band[:, 1].max()) == (1.0, 3.0)


def test_both_panels_reach_to_the_longest_curve_of_either(tmp_path):
    write_run(tmp_path / "runs/a", [1.0] * 60)
    write_run(tmp_path / "runs/b", [9.0] * 300, num_demos=80, lambda_bc=1)
    for ax in plot_curves.learning_figure("p2p", plot_curves.find_runs("p2p", None)[0]).axes:
        assert ax.get_xlim()[0] == 0 and ax.get_xlim()[1] >= 300 and ax.get_ylim()[0] <= 1 and ax.get_ylim()[1] >= 9


def test_the_running_mean_is_over_the_last_50_returns():
    smooth = plot_curves.running_mean(np.repeat([0.0, 10.0], 50))
    assert len(smooth) == 100 and (smooth[49], smooth[50], smooth[74], smooth[99]) == (0, 0.2, 5, 10)
    assert plot_curves.running_mean(np.array([1.0, 3.0])).tolist() == [1, 2]


@pytest.mark.filterwarnings("error")  # a warning would reach the terminal
def test_the_figure_is_written_as_png_and_pdf_or_to_the_named_file(tmp_path, capsys):
    write_run(tmp_path / "runs/a")
    plot_curves.main(["--figure", "learning", "--task", "p2p"])
    plot_curves.main(["--figure", "learning", "--task", "p2p", "--out", str(tmp_path / "new/x.pdf")])
    assert sorted(p.name for p in (tmp_path / "figures").iterdir()) == ["fig-learning-p2p.pdf", "fig-learning-p2p.png"]
    assert (tmp_path / "figures/fig-learning-p2p.png").read_bytes().startswith(b"\x89PNG")
    assert [p.name for p in (tmp_path / "new").iterdir()] == ["x.pdf"]
    assert (tmp_path / "new/x.pdf").read_bytes().startswith(b"%PDF")


def test_an_error_curve_is_over_the_successful_trials_and_each_counts_alike_at_every_t(tmp_path):
    write_run(tmp_path / "runs/a", success=(1, 0, 1))  # 3 and 5 steps from 50 to 5 cm
    axes = plot_curves.error_figure("p2p", plot_curves.find_runs("p2p", None)[0]).axes
    assert len(axes) == 6 and [text.get_text() for ax in axes for text in ax.texts].count("no runs") == 5
    t, mean = axes[4].lines[0].get_data()
    assert axes[4].get_title() == r"$\lambda_{BC}=1.8$ ($N_{demos}=100$)"
    assert t == pytest.approx([0, 0.02, 0.04, 0.06, 0.08, 0.1])
    assert mean == pytest.approx([50, (35 + 41) / 2, (20 + 32) / 2, (5 + 23) / 2, (5 + 14) / 2, 5])
    assert [ax.lines[-1].get_ydata()[0] for ax in axes] == [5] * 6  # epsilon


def test_trajectories_are_the_successful_ones_of_the_best_run_with_start_and_goal(tmp_path):
    write_run(tmp_path / "runs/a", success=(1, 0, 1))
    write_run(tmp_path / "runs/b", success=(0, 0, 1), seed=1)
    runs = plot_curves.find_runs("p2p", None)[0]
    figure = plot_curves.trajectories_figure("p2p", runs)
    for ax in figure.axes:
        assert [line.get_marker() for line in ax.lines].count("*") == 2
    assert "seed 0" in figure.get_suptitle()
    figure = plot_curves.trajectories_figure("p2p", [])
    assert [ax.texts[-1].get_text() for ax in figure.axes] == ["no runs", "no runs"]


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
    ax, = plot_curves.workspace_figure().axes
    assert [text.get_text() for text in ax.texts] == ["#1", "#2", "#3", "#4"]
    arm = ax.images[0].get_array()[..., 3] > 0
    assert 0.01 < arm.mean() < 0.3


def test_all_writes_every_table_and_figure_and_says_how_to_fill_the_gaps(tmp_path, monkeypatch, capsys):
    empty = dict.fromkeys(plot_curves.DRAW, lambda task, runs: plot_curves.Figure((1, 1)))
    monkeypatch.setattr(plot_curves, "DRAW", empty)
    write_run(tmp_path / "runs/a", task="pnp", algo="ppo", num_demos=400, lambda_bc=15)
    plot_curves.main(["--all", str(tmp_path / "out")])
    tasks = ("p2p", "p2po", "pnp")
    names = {f"table-{kind}-{task}.{end}" for kind in ("training", "test") for task in tasks
             for end in ("txt", "csv", "tex")}
    figures = [f"{name}-{task}" for name in ("learning", "error", "demos", "trajectories") for task in tasks]
    names |= {f"fig-{name}.{end}" for name in (*figures, "partitions", "workspace") for end in ("pdf", "png")}
    assert {path.name for path in (tmp_path / "out").iterdir()} == names
    said = capsys.readouterr().out
    assert "--task pnp --recipe robust --columns lambda=5 lambda=10 demos=150 demos=250 baseline --seeds 5" in said
    assert "evaluate.py data/runs/a --trials 500" in said and "evaluate.py --pid --task p2p --gains authors" in said
    assert "--out data/runs/pid-p2p-authors" in said  # without it the trials are only printed
    assert "pid_demo.py --task p2po --record 40" in said
    plot_curves.main(["--all", str(tmp_path / "out"), "--runs", str(tmp_path / "runs/a")])  # of one task: no error


# ------------------------------------------------------------------------------------------ publishing

COMMIT = {"versions": {"git_commit": "0123456789" * 4}, "max_ep_len": 400, "data_dir": "/home/me/runs"}


def write_publishable(folder, **config):
    run = write_run(folder, [1.0] * 200, **(COMMIT | {"success": (1, 0)} | config))
    torch.save({"weights": {"0.weight": torch.zeros(2)}}, run / "policy.pt")
    return run


def test_a_published_run_is_whole_without_machine_paths_and_the_same_bytes_each_time(tmp_path, capsys):
    run = write_publishable(tmp_path / "runs/a", command=["/home/me/ddpg_demoease.py", "--demos=/home/me/d.npz"])
    contents = []
    for _ in range(2):
        plot_curves.main(["--publish", str(run)])
        contents.append({path.name: path.read_bytes() for path in (tmp_path / "results/a").iterdir()})
    assert contents[0] == contents[1] and sorted(contents[0]) == [
        "config.json", "episodes.csv.gz", "evaluation.csv.gz", "policy.pt", "progress.csv.gz", "trajectories.npz"]
    config = json.loads(contents[0]["config.json"])
    assert "/home" not in str(config) and config["data_dir"] == "data/runs"
    assert config["command"] == ["ddpg_demoease.py", "--demos=d.npz"]
    assert gzip.decompress(contents[0]["episodes.csv.gz"]) == (run / "episodes.csv").read_bytes()
    row, = csv.DictReader((tmp_path / "results/index.csv").open())
    assert [row[k] for k in ("name", "num_demos", "env_steps", "finished", "eval_success", "P_scs_percent")] == [
        "a", "100", "4000", "1", "0.5", "50"]
    assert row["git_commit"] == COMMIT["versions"]["git_commit"]


def test_only_the_best_run_keeps_its_policy_no_quick_one_and_an_unfinished_one_is_said_so(tmp_path, capsys):
    runs = [write_publishable(tmp_path / f"runs/{i}", seed=i, success=won) for i, won in enumerate([(1, 0), (1, 1)])]
    runs.append(write_publishable(tmp_path / "runs/2", recipe="paper", success=(0, 0), epochs=3))
    runs.append(write_publishable(tmp_path / "runs/0-quick", success=(1, 1), seed=3, quick=True))
    for run in runs:
        plot_curves.main(["--publish", str(run)])
    assert sorted(path.parent.name for path in (tmp_path / "results").rglob("policy.pt")) == ["1", "2"]
    assert [row["finished"] for row in csv.DictReader((tmp_path / "results/index.csv").open())] == ["1", "1", "1", "0"]


def test_a_better_run_that_was_published_without_weights_leaves_them_to_the_next(tmp_path, capsys):
    write_run(tmp_path / "results/old", success=(1, 1), seed=1)
    run = write_publishable(tmp_path / "runs/a", success=(1, 0))
    plot_curves.main(["--publish", str(run)])
    assert (tmp_path / "results/a/policy.pt").exists()


def test_a_run_takes_the_place_of_an_older_one_of_the_same_name(tmp_path, capsys):
    old = write_run(tmp_path / "results/a", [5.0] * 9, compress=True)
    (old / "agent.gif").write_text("old")
    plot_curves.main(["--publish", str(write_publishable(tmp_path / "runs/a"))])
    assert not (old / "agent.gif").exists() and cell(table(capsys, old)[1], "R90")["mean"] == "1.0"


def test_what_is_published_reads_like_the_run_it_came_from(tmp_path, capsys):
    run = write_publishable(tmp_path / "x/a")
    plot_curves.main(["--publish", str(run)])
    capsys.readouterr()
    for kind in ("training", "test"):
        assert table(capsys, run, kind=kind) == table(capsys, tmp_path / "results/a", kind=kind)


def test_a_published_PID_evaluation_needs_no_commit(tmp_path, capsys):
    run = write_run(tmp_path / "results/pid-p2p-fast", success=(1, 1))
    (run / "config.json").write_text(json.dumps({"task": "p2p", "algo": "pid", "gains": "fast"}))
    plot_curves.main(["--publish", str(run)])
    assert not (run / "evaluation.csv").exists() and (run / "evaluation.csv.gz").exists()
    assert json.loads((run / "config.json").read_text()) == {"task": "p2p", "algo": "pid", "gains": "fast"}


def test_a_demonstration_file_is_published_as_TCP_paths(tmp_path, capsys):
    P_e = np.arange(15, dtype=np.float32).reshape(5, 3)  # two episodes, of 2 and 1 steps
    s = np.zeros((5, 22), np.float32)
    s[:, 16:19], s[:, 19:22] = 1, 1 - P_e
    np.savez(tmp_path / "d.npz", obs=s[[0, 1, 3]], obs2=s[[1, 2, 4]], length=np.array([2, 1]),
             partition=np.array([3, 0]), success=np.array([True, False]), meta=np.array(json.dumps({"task": "p2p"})))
    plot_curves.main(["--publish", str(tmp_path / "d.npz")])
    paths = plot_curves.read_paths(tmp_path / "results/demos-p2p.npz")
    assert [path["tcp"].tolist() for path in paths] == [P_e[:3].tolist(), P_e[3:].tolist()]
    assert [path["success"] for path in paths] == [True, False] and np.isnan(paths[0]["object"]).all()
    assert [line.get_marker() for line in plot_curves.demos_figure("p2p", []).axes[0].lines].count("*") == 1


def pickled(path):
    np.savez(path, length=np.array([{}], dtype=object), success=np.array([True]), error=np.zeros(1))


def respoil(path, **arrays):
    np.savez(path, **(dict(np.load(path)) | arrays))


@pytest.mark.parametrize("spoil, says", [
    (lambda run: (run / "config.json").write_text(json.dumps(CONFIG)), "git commit 'None'"),
    (lambda run: (run / "config.json").write_text(json.dumps(
        CONFIG | {"versions": {"git_commit": COMMIT["versions"]["git_commit"] + "-dirty"}})), "-dirty'"),
    (lambda run: (run / "episodes.csv").unlink(), "episodes.csv"),
    (lambda run: (run / "policy.pt").unlink(), "no policy.pt"),
    (lambda run: (run / "policy.pt").write_bytes(pickle.dumps(Path)), "policy.pt"),
    (lambda run: (run / "policy.pt").write_bytes((run / "policy.pt").read_bytes()[:500]), "policy.pt"),
    (lambda run: (run / "progress.csv").write_text("epoch,env_steps,eval_success\n1,90000,\n"), "do not fit together"),
    (lambda run: (run / "progress.csv").write_text("epoch,env_steps,eval_success\n2,4000,\n"), "do not fit together"),
    (lambda run: (run / "trajectories.npz").write_bytes((run / "trajectories.npz").read_bytes()[:300]), "trajectories"),
    (lambda run: pickled(run / "trajectories.npz"), "allow_pickle=False"),
    (lambda run: respoil(run / "trajectories.npz", error=np.zeros(3)), "do not fit together"),
    (lambda run: respoil(run / "trajectories.npz", goal=np.zeros(2)), "(n, 3) is expected"),
    (lambda run: respoil(run / "trajectories.npz", success=np.array(True)), "not (n,)"),
    (lambda run: respoil(run / "trajectories.npz", success=np.array(["yes", "no"])), "holds no numbers"),
    (lambda run: (run / "evaluation.csv").write_text("trial,success\n0,1\n"), "no column length"),
    (lambda run: (run / "evaluation.csv").unlink(), "trajectories.npz is not of"),
])
def test_a_run_that_is_not_whole_or_of_no_clean_commit_is_not_published(tmp_path, capsys, spoil, says):
    run = write_publishable(tmp_path / "runs/a")
    spoil(run)
    err = error_line(capsys, "--publish", run)
    assert str(run) in err and says in err and not (tmp_path / "results/a").exists()


def test_nothing_is_published_where_one_of_several_is_not_whole(tmp_path, capsys):
    good = write_publishable(tmp_path / "runs/a")
    assert "nowhere" in error_line(capsys, "--publish", good, tmp_path / "nowhere")
    assert not (tmp_path / "results").exists()


# ------------------------------------------------------------------------------------------ bad input

TABLE = ("--table", "training", "--task", "p2p")


@pytest.mark.parametrize("argv, names", [
    ((), "--table --figure"), (("--task", "p2p"), "--table --figure"), (("--table", "training"), "--task"),
    (("--table", "training", "--task", "walk"), "'p2p', 'p2po', 'pnp'"),
    (("--table", "tests", "--task", "p2p"), "--table"), (("--figure", "error"), "--task"),
    (("--all", "x", "--task", "p2p"), "--task"), (("--figure", "workspace", "--task", "p2p"), "--task"),
    (("--publish", "x", "--runs", "x"), "--runs"), (("--figure", "partitions", "--runs", "x"), "--runs"),
    ((*TABLE, "--runs", ""), "--runs"), (("--all", ""), "--all"), (("--all", "x", "--csv", "x.csv"), "--csv"),
    ((*TABLE, "--figure", "learning"), "--figure"), ((*TABLE, "--out", "x.png"), "--out"),
    ((*TABLE, "--sed", "1"), "--sed"), (("--tab", "training", "--task", "p2p"), "--table"),
    (("--figure", "learning", "--task", "p2p", "--csv", "x.csv"), "--csv"),
    (("--figure", "learning", "--task", "p2p", "--out", "x.gif"), ".png or .pdf"),
    (("--figure", "learning", "--task", "p2p"), "no run of task p2p"),
    ((*TABLE, "--runs", "/nowhere"), "--runs /nowhere: no run there"), ((*TABLE, "--runs"), "--runs"),
])
def test_a_bad_flag_is_one_line_that_names_it(capsys, argv, names):
    assert names in error_line(capsys, *argv)


def test_a_run_of_another_task_that_is_itself_named_is_an_error(tmp_path, capsys):
    runs = write_run(tmp_path / "a"), write_run(tmp_path / "b", task="pnp")
    assert f"--runs {runs[1]}: a run of task pnp" in error_line(capsys, *TABLE, "--runs", *runs)


@pytest.mark.parametrize("text, says", [("trial,success\n0,1\n", "no column length"),
                                        (None, "success 0 or 1"), ("", "no column trial")])
def test_a_garbled_evaluation_is_one_line(tmp_path, capsys, text, says):
    run = write_run(tmp_path / "runs/a", success=(1, 1))
    path = run / "evaluation.csv"
    path.write_text(path.read_text().replace("1,1,,", "1,2,,") if text is None else text)
    err = error_line(capsys, "--table", "test", "--task", "p2p")
    assert f"{path}: " in err and says in err


def test_runs_named_of_another_task_only_are_an_error_but_among_others_are_passed_over(tmp_path, capsys):
    write_run(tmp_path / "x/a", task="pnp")
    assert "--runs: no run of task p2p" in error_line(capsys, *TABLE, "--runs", tmp_path / "x")
    write_run(tmp_path / "x/b")
    assert cell(table(capsys, tmp_path / "x")[1], "R90")["seeds"] == "1"


@pytest.mark.parametrize("file, content, says", [
    ("config.json", "{", "JSON"), ("config.json", "5", "no key 'task'"), ("config.json", "\udcff", "config.json"),
    ("config.json", json.dumps({k: v for k, v in CONFIG.items() if k != "recipe"}), "no key 'recipe'"),
    ("config.json", json.dumps(CONFIG | {"lambda_bc": "a lot"}), "'lambda_bc' is 'a lot'"),
    ("config.json", json.dumps(CONFIG | {"lambda_bc": math.nan}), "'lambda_bc' is nan"),
    ("config.json", json.dumps(CONFIG | {"seed": 1.5}), "an integer"),
    ("config.json", json.dumps(CONFIG | {"epochs": True}), "an integer"),
    ("config.json", json.dumps(CONFIG | {"quick": 0}), "true or false"),
    ("episodes.csv", None, "no such file"), ("episodes.csv", "", "no column episode, return"),
    ("episodes.csv", "episode,length\n1,2\n", "no column return"), ("episodes.csv", "\udcff\udcfe", "episodes.csv"),
    ("episodes.csv", "episode,return\n1,0.5\n2", "line 3 is cut short"),
    ("episodes.csv", "episode,return\n1,0.5\n2,oops\n", "'oops'"),
    ("episodes.csv", "episode,return\n1,0.5\n2,nan\n", "nan or inf in column return"),
    ("episodes.csv", "episode,return\n1,0.5\n3,0.5\n", "column episode is garbled"),
    ("episodes.csv.gz", "not gzip", "episodes.csv.gz"), ("episodes.csv.gz", gzip.compress(b"1,2\n" * 99)[:20], "ended"),
    ("progress.csv", None, "no such file"), ("progress.csv", "epoch\n1\n", "no column env_steps"),
])
def test_a_bad_file_is_one_line_that_names_it(tmp_path, capsys, file, content, says):
    run = write_run(tmp_path / "runs/a")
    (run / file.removesuffix(".gz")).unlink()
    if content is not None:
        (run / file).write_bytes(content if isinstance(content, bytes) else content.encode(errors="surrogateescape"))
    err = error_line(capsys, *TABLE, "--csv", tmp_path / "t.csv")
    assert f"{run / file}: " in err and says in err and not (tmp_path / "t.csv").exists()


@pytest.mark.parametrize("what, flag, file", [
    ("--table=training", "--csv", "taken.csv"), ("--table=training", "--csv", "."),
    ("--figure=learning", "--out", "taken.png")])
def test_a_file_that_cannot_be_written_is_one_line_and_leaves_nothing(tmp_path, capsys, what, flag, file):
    write_run(tmp_path / "runs/a")
    (tmp_path / "x" / file).mkdir(parents=True)
    assert f"{flag} {tmp_path / 'x' / file}: " in error_line(capsys, what, "--task", "p2p", flag, tmp_path / "x" / file)
    assert [p for p in tmp_path.rglob("*") if p.is_file() and "runs" not in p.parts] == []


def test_a_write_that_breaks_off_leaves_the_old_file_whole(tmp_path, capsys):
    def break_off(path):
        path.write_text("half")
        raise OSError(28, "No space left on device")

    (tmp_path / "t.csv").write_text("old")
    with pytest.raises(SystemExit):
        plot_curves.write("--csv", tmp_path / "t.csv", break_off)
    assert "No space left" in capsys.readouterr().err
    assert [(p.name, p.read_text()) for p in tmp_path.iterdir()] == [("t.csv", "old")]
    paths = []
    plot_curves.write("--csv", tmp_path / "t.csv", lambda path: (paths.append(path), path.write_text("new")))
    assert [(p.name, p.read_text()) for p in tmp_path.iterdir()] == [("t.csv", "new")]
    assert tmp_path / "t.csv" not in paths  # it comes into being whole, by a rename


def test_as_a_command_bad_input_is_exit_code_2_one_line_and_no_traceback(tmp_path):
    write_run(tmp_path / "a")
    (tmp_path / "a/episodes.csv").write_bytes(b"\x00\xff")
    script = Path(plot_curves.__file__)
    done = subprocess.run([sys.executable, script, *TABLE, "--runs", tmp_path], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert "Traceback" not in done.stderr and "a/episodes.csv" in done.stderr
