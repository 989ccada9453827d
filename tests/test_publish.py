"""publish.py: what is published, and what is written into the pages."""

import csv
import gzip
import json
import shutil

import numpy as np
import pandas as pd
import pytest

import plot_curves
import publish
import tables
from logx import BadInput
from plot_curves import main
from run_folders import COMMIT, CONFIG, PID, cell, figure, of_200, table, trials, write_run

pytestmark = pytest.mark.usefixtures("folders")


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


@pytest.mark.parametrize(
    "config", [{"num_demos": 7}, {"variant": "n_step=1"}, {"symmetry": "so2"}, {"own_length": False}]
)
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
    runs.append(publishable(tmp_path / "runs/5", validated=1, symmetry="canonical"))
    runs.append(publishable(tmp_path / "runs/6", validated=1, own_length=False))
    for run in runs:
        publish.publish([run])
    assert sorted(path.parent.name for path in (tmp_path / "results").rglob("policy.pt")) == ["1", "2"]
    assert [row["finished"] for row in index(tmp_path)] == ["1", "1", "0", "1", "1", "1", "1"]


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


# ---- what the pages say ----------------------------------------------------------------------------------------------


def test_of_a_symmetry_most_demonstrations_are_compared_with_fewest_and_mapped_ones_may_be_a_margin_worse(tmp_path):
    for seed in (0, 1):
        for symmetry, N, won in (("none", 5, seed), ("none", 20, 199 + seed), ("gas", 20, 199 + seed)):
            folder = tmp_path / f"runs/{symmetry}{N}-{seed}"
            write_run(folder, symmetry=symmetry, num_demos=N, success=of_200(won), seed=seed)
    found = {line[0]: line[3:] for line in publish.findings_lines(tables.find_runs()[0])}
    assert found[publish.CLAIMS["mapping"]] == ["99.8 and 0.2", "99.5 [98.0, 100.0]", "2 and 2", "*holds*"]
    assert found[publish.CLAIMS["demos"]] == found[publish.CLAIMS["mapping"]]
    assert found[publish.CLAIMS["symmetry"]] == ["99.8 and 99.8", "0.0 [-1.5, 1.5]", "2 and 2", "*holds*"]


@pytest.mark.parametrize("ours, verdict", [
    ((200, 199), "holds"), ((0, 1), "does not hold"), ((200, 0), "cannot be told apart"),
    ((200,), ""), ((200, 200), "")])  # a single seed says nothing, nor do seeds without a spread  # fmt: skip
def test_a_finding_is_what_the_interval_of_the_difference_says(tmp_path, ours, verdict):
    for seed, won in enumerate(ours):
        write_run(tmp_path / f"runs/{seed}", seed=seed, success=of_200(won))
    write_run(tmp_path / "runs/pid", success=of_200(100), **PID)
    runs, _ = tables.find_runs()
    assert [x["verdict"] for x in publish.findings(runs) if x["claim"] == "P_scs_percent"] == [verdict] * bool(verdict)
    assert {line[0]: line[-1] for line in publish.findings_lines(runs)}[publish.CLAIMS["mask"]] == ""


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
    write_run(tmp_path / "runs/lost", seed=2, success=of_200(2), gains="fast")  # hardly any trial that both succeed in
    (tmp_path / "runs/pid-authors/evaluation-horizon_600.csv").write_text(trials((1, 1)))
    assert [line[1:8] for line in publish.beside_pid_lines(tables.find_runs()[0])[1:]] == [
        ["ddpg robust mirror 4k steps", "3", "fast", "67.0 and 100.0", "-", "200",
         "-33.0 [-100.0, 100.0]: cannot be told apart"],
        ["ddpg robust mirror gains=authors 4k steps", "2", "authors", "99.8 and 50.0", "horizon 600: 100.0", "100",
         "49.8 [46.6, 52.9]: holds"]]  # fmt: skip


def test_at_a_glance_one_comparison_shows_its_number_and_several_are_counted(tmp_path):
    for seed in (0, 1):
        for symmetry, N, won in (("none", 5, seed), ("none", 20, 199 + seed), ("gas", 20, 199 + seed)):
            folder = tmp_path / f"runs/{symmetry}{N}-{seed}"
            write_run(folder, symmetry=symmetry, num_demos=N, success=of_200(won), seed=seed)
        for N, won in ((10, seed), (40, seed)):
            folder = tmp_path / f"runs/so2-{N}-{seed}"
            write_run(folder, symmetry="so2", num_demos=N, success=of_200(won), seed=seed)
    found = {line[0]: line[1:] for line in publish.verdicts_lines(tables.find_runs()[0])}
    assert found["claim"] == ["P2P", "P2P-O", "P&P"]
    assert found[publish.CLAIMS["mapping"]] == ["holds: 99.5 [98.0, 100.0] points, 2 and 2 seeds", "-", "-"]
    assert found[publish.CLAIMS["demos"]] == ["holds in 1 of 2; cannot be told apart in 1 of 2", "-", "-"]


def test_what_went_on_inside_is_shown_after_a_tenth_half_and_all_of_a_run(tmp_path):
    run = write_run(tmp_path / "runs/a")
    rows = "".join(f"{i},{200 * i},0,{i},{i},nan\n" for i in range(1, 21))
    (run / "progress.csv").write_text("epoch,env_steps,demo_env_steps,seconds,Q_max,eval_success\n" + rows)
    line = dict(zip(*publish.watched_lines(tables.find_runs()[0]), strict=True))
    assert line["agent"] == "DDPG, robust" and line["L_O"] == "-"
    assert line["Q_max (PPO: V_max)"] == "1.5, 9.5, 20"  # means of rows 1 and 2, 9 and 10, 19 and 20


def test_what_each_part_is_worth_is_what_the_tables_of_ablations_say(tmp_path):
    for seed in (0, 1):
        write_run(tmp_path / f"runs/a{seed}", seed=seed, success=of_200(199 + seed))
        write_run(tmp_path / f"runs/b{seed}", seed=seed, success=of_200(seed), variant="n_step=1")
    head, line = publish.parts_lines(tables.find_runs()[0])
    assert head == ["instead of the recipe's", "P2P, DDPG"] and line[0] == "n_step=1"
    assert line[1].startswith("-99.5 [-100.0, -98.0]; ")


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
    for mark in ("<!-- results -->", "<!-- /results -->"):
        (tmp_path / "README.md").write_text(f"{mark}\nold\n")
        with pytest.raises(BadInput, match=f"README.md: {mark} is one mark alone"):
            main(["--report"])


def test_the_pages_hold_what_the_published_files_say(monkeypatch):
    monkeypatch.undo()  # the real folders
    names = [f"{name}-{task}{of}" for name in plot_curves.OF_TASK for task in tables.TITLES for of in ("", "-paper")]
    drawn = [tables.RESULTS / f"fig-{name}.png" for name in [*names, *plot_curves.OF_NO_TASK]]
    for page, text in publish.report([path for path in drawn if path.exists()]).items():
        assert page.read_text() == text, f"{page} is not what python plot_curves.py --report writes"
    assert "<!-- findings -->" in (tables.RESULTS / "README.md").read_text()
