"""plot_curves.py: what is drawn, and what bad input says."""

import json
import math
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import plot_curves
import publish
import tables
from logx import BadInput
from plot_curves import Flags, main
from run_folders import CONFIG, cell, figure, table, write_run

pytestmark = pytest.mark.usefixtures("folders")


# ---- figures ---------------------------------------------------------------------------------------------------------


def legend(ax):
    return [text.get_text() for text in ax.get_legend().get_texts()]


def test_the_learning_figure_draws_the_papers_columns_of_one_group_with_the_baseline_and_the_papers_R90(tmp_path):
    for i, (N, lam) in enumerate([(100, 0.1), (80, 1), (0, 0), (300, 7)]):
        write_run(tmp_path / f"runs/{i}", [i + 1.0] * 60, num_demos=N, lambda_bc=lam)
    write_run(tmp_path / "runs/short", epochs=1)
    drawn = figure("learning")
    both = ["DDPG (1 seed)", r"the paper's $\overline{R}_{90}$, in its line's colour"]
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


def test_a_curve_is_the_mean_over_all_seeds_up_to_the_shortest_with_a_band(tmp_path):
    write_run(tmp_path / "runs/a", [1.0] * 100, seed=0)
    write_run(tmp_path / "runs/b", [3.0] * 150, seed=1)
    (ax,) = figure("learning").axes
    assert (ax.lines[0].get_xdata()[-1], set(ax.lines[0].get_ydata())) == (100, {2.0})
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
        *((one, {"num_demos": n, "epochs": 9}) for n in range(1, 9)),  # of one symmetry alone
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
