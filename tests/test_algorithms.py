"""What holds for both algorithm scripts: runs, resumes, curves, flags and losses. Most runs are in a scripted world,
whose episodes are short and end in every way."""

import json
import math
import signal
import threading
from dataclasses import fields, replace
from functools import partial

import numpy as np
import pytest
import torch

import ddpg_demoease as ddpg
import evaluate
import gas
import logx
import pid_demo
import ppo_demoease as ppo
from kinova_env import OBS_DIM
from scripted import (
    SCRIPTS,
    TINY,
    checkpoint,
    curves,
    demo_arrays,
    demonstrated,
    finished_run,
    interrupt_at,
    rows_of,
    run_flags,
    scripted_run,
)


@pytest.fixture(params=SCRIPTS.values(), ids=SCRIPTS.keys())
def script(request):
    return request.param


@pytest.fixture
def world(script, tmp_path):
    """world(name, **flags): a finished run."""
    return partial(finished_run, script, tmp_path)


# ---- the same run ----------------------------------------------------------------------------------------------------


def test_the_same_seed_gives_the_same_run_and_another_seed_another(script, world):
    one, again, other = world("a"), world("b"), world("c", seed=4)
    assert curves(one.folder) == curves(again.folder)
    assert not np.array_equal(one.steps[0].s, other.steps[0].s)  # the episodes too, not the exploration alone
    assert all(x != y for x, y in zip(curves(one.folder), curves(other.folder), strict=True))


RESUMED = {
    "paper": dict(recipe="paper", num_demos=4, lambda_bc=1.0, recorded=demo_arrays()),
    "robust": dict(recipe="robust", num_demos=4, lambda_bc=1.0, recorded=demo_arrays(), symmetry="so2", clone_iters=2),
}


@pytest.mark.parametrize("recipe", RESUMED)
def test_a_run_that_is_interrupted_and_resumed_equals_one_that_never_stopped(script, recipe, world, tmp_path):
    """At 5 nothing is learned yet, 63 is amid an epoch after an update, at 80 an epoch ends, 119 is the last but one.
    On-policy, demonstrations still open epochs."""
    whole = world("whole", **RESUMED[recipe])
    for number, at in zip((signal.SIGINT, signal.SIGTERM) * 2, (5, 63, 80, 119), strict=True):
        cut = scripted_run(script, tmp_path, f"at {at}", interrupt_at(at, number), **RESUMED[recipe])
        assert isinstance(cut.error, KeyboardInterrupt) and "--resume" in str(cut.error)
        assert len(cut.steps) == at == checkpoint(cut.folder)["t"]
        again = world(f"at {at}", resume=True, **RESUMED[recipe] | dict(recorded=None))  # they are saved
        assert curves(again.folder) == curves(whole.folder)


def test_a_run_that_is_stopped_while_it_clones_ends_at_once_and_a_resume_begins_it_anew(
    script, world, tmp_path, monkeypatch
):
    flags, batches = RESUMED["robust"] | dict(clone_iters=50), []
    whole, loss_BC = world("whole", **flags), script.loss_BC

    def interrupted(*args):
        batches.append(args)
        interrupt_at(3)(len(batches))
        return loss_BC(*args)

    with monkeypatch.context() as patched:
        patched.setattr(script, "loss_BC", interrupted)
        cut = scripted_run(script, tmp_path, "a", **flags)
    assert isinstance(cut.error, KeyboardInterrupt) and "--resume begins it anew" in str(cut.error)
    assert (len(batches), cut.steps) == (3, [])
    assert curves(world("a", resume=True, **flags).folder) == curves(whole.folder)


def test_a_finished_run_goes_on_with_more_epochs_as_if_asked_for_them_at_first(script, world, capsys):
    """--resume FOLDER --epochs N: all other flags are those on record."""
    whole, first = world("whole"), world("a", epochs=2)
    asked = logx.recorded(script.Flags, {"resume": str(first.folder), "epochs": 3, "quiet": True})
    again = run_flags(script, asked)
    assert not again.error and len(again.steps) < 120 and curves(first.folder) == curves(whole.folder)
    finished = run_flags(script, asked)
    assert not finished.error and finished.steps == [] and "finished" in capsys.readouterr().out
    assert curves(first.folder) == curves(whole.folder)


def test_without_demonstrations_it_is_the_plain_algorithm_whatever_lambda_is(script, world):
    plain, other = world("a"), world("b", lambda_bc=5.0)
    assert curves(plain.folder) == curves(other.folder)
    row = rows_of(other.folder / "progress.csv")[-1]
    assert row["L_A"] == row["L_O"] != "" and row["demo_env_steps"] == "0"
    assert row["L_BC"] == row["mask_fraction"] == row["bc_relative_error"] == ""


def test_evaluation_is_logged_and_changes_nothing_in_the_run(script, world):
    silent, evaluated = world("a"), world("b", eval_every=2, eval_trials=1)
    rows = rows_of(evaluated.folder / "progress.csv")
    measured = [row["epoch"] for row in rows if row["eval_success"] != "" != row["eval_return"]]
    assert measured == ["2", "3"]  # every second, and the last
    assert curves(silent.folder)[::2] == curves(evaluated.folder)[::2]


# ---- demonstrations --------------------------------------------------------------------------------------------------


def test_gas_maps_a_quarter_of_the_demonstrations_to_all_sectors_and_a_file_of_them_gives_the_same_run(
    script, world, tmp_path, monkeypatch
):
    settings = dict(num_demos=4, lambda_bc=1.8, gains="fast", symmetry="gas", epochs=2)
    recorded = world("recorded", **settings)
    rows = demonstrated(script, recorded.folder)
    steps = int(rows_of(recorded.folder / "progress.csv")[0]["demo_env_steps"])
    assert len(rows) == 4 * steps
    for k in range(4):
        image = rows[k * steps : (k + 1) * steps]
        assert torch.equal(image[:, 22:27], rows[:steps, 22:27])
        torch.testing.assert_close(image[:, :22], gas.phi(rows[:steps, :22], k), rtol=0, atol=1e-5)

    file = tmp_path / "demos.npz"
    argv = "pid_demo.py --task p2p --record 4 --gains fast --symmetry gas --seed 3 --out"
    monkeypatch.setattr("sys.argv", [*argv.split(), str(file)])
    pid_demo.main()
    read = world("read", **settings | dict(demos=str(file), gains=None))
    assert curves(read.folder) == curves(recorded.folder)


def test_canonical_demonstrations_are_stored_in_the_arms_own_frame(script, world):
    stored = {}
    for symmetry in ("none", "canonical"):
        run = world(symmetry, symmetry=symmetry, num_demos=4, lambda_bc=1.0, recorded=demo_arrays(), epochs=1)
        stored[symmetry] = demonstrated(script, run.folder)
    assert torch.equal(stored["canonical"][:, :22], torch.from_numpy(gas.canonical(demo_arrays()["obs"])))
    assert torch.equal(stored["none"][:, :22], torch.from_numpy(demo_arrays()["obs"]))
    assert torch.equal(stored["canonical"][:, 22:27], stored["none"][:, 22:27])


# ---- curves ----------------------------------------------------------------------------------------------------------


def test_epochs_cut_no_episode(script, world):
    run = world("a", steps_per_epoch=10, epochs=12, checkpoint_every=9)
    rows, ends = rows_of(run.folder / "episodes.csv"), [t + 1 for t, x in enumerate(run.steps) if x.end]
    assert [int(row["env_steps"]) for row in rows] == ends and len(ends) >= 7
    assert [int(row["length"]) for row in rows] == np.diff([0, *ends]).tolist()
    assert max(int(row["length"]) for row in rows) > 10
    assert [int(row["episode"]) for row in rows] == list(range(1, len(ends) + 1))
    for row, begin, end in zip(rows, [0, *ends[:-1]], ends, strict=True):
        last = run.steps[end - 1].end
        assert float(row["return"]) == pytest.approx(sum(x.r for x in run.steps[begin:end]), abs=1e-6)
        assert row["success"] == str(int(last == "success")) and row["collision"] == ("self" if last == "self" else "")


def test_a_row_of_progress_averages_its_own_epoch(script, world, monkeypatch):
    logged, log_updates, log_epoch = [[]], logx.RunFolder.log_updates, logx.RunFolder.log_epoch
    monkeypatch.setattr(logx.RunFolder, "log_updates", lambda self, m, net: logged[-1].append(m)
                        or log_updates(self, m, net))  # fmt: skip
    monkeypatch.setattr(logx.RunFolder, "log_epoch", lambda *args: log_epoch(*args) or logged.append([]))
    run = world("a", steps_per_epoch=20, epochs=6, num_demos=4, lambda_bc=1.0, recorded=demo_arrays())
    episodes, progress = rows_of(run.folder / "episodes.csv"), rows_of(run.folder / "progress.csv")
    assert [(row["epoch"], row["env_steps"]) for row in progress] == [(f"{n}", f"{20 * n}") for n in range(1, 7)]
    for row, measured in zip(progress, logged[:-1], strict=True):
        end = int(row["env_steps"])
        of_epoch = [e for e in episodes if end - 20 < int(e["env_steps"]) <= end]
        for column, name in (("EpRet", "return"), ("EpLen", "length"), ("Success", "success")):
            values = [float(e[name]) for e in of_epoch]
            assert row[column] == "" if not values else float(row[column]) == pytest.approx(np.mean(values), abs=1e-6)
        assert (row["L_C"] == "") == (measured == [])
        for name in script.MEASURED if measured else ():
            mean = np.mean([m[name] for m in measured])
            assert float(row[name] or math.nan) == pytest.approx(mean, rel=1e-5, nan_ok=True), name
    assert progress[-1]["L_C"] != "" and (script is ppo or progress[0]["L_C"] == "")


# ---- how a run ends --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("good", [4, 5, 7])
@pytest.mark.parametrize("loss", ["loss_C", "loss_O"])
def test_nan_ends_a_run_and_the_last_checkpoint_is_kept(script, loss, good, tmp_path, monkeypatch):
    """The first checkpoint is at step 40. After so many good updates it breaks down: on-policy in the first, second
    or last update of the next epoch; off-policy in the block of 8 at step 80, where the last is its end too."""
    real, calls = getattr(script, loss), []

    def breaks_down(*args):
        calls.append(0)
        return real(*args) * (math.nan if len(calls) > good else 1)

    monkeypatch.setattr(script, loss, breaks_down)
    run = scripted_run(script, tmp_path, "a", **{} if script is ppo else dict(update_every=8, update_after=80))
    assert isinstance(run.error, logx.NotFinite)  # exit code 3
    saved = checkpoint(run.folder)
    assert saved["t"] == 40 and all(w.isfinite().all() for w in saved["learner"]["net"].values())


@pytest.mark.parametrize("file", [1, 2, 3, 7], ids=["config", "policy", "checkpoint", "last checkpoint"])
def test_a_run_that_ends_before_a_file_is_in_place_resumes_as_if_it_had_never_stopped(script, file, world, tmp_path):
    whole, written, write = world("whole"), [], logx.atomic_write

    def ends(path, content):
        written.append(path)
        if len(written) == file:
            raise KeyboardInterrupt
        write(path, content)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(logx, "atomic_write", ends)
        assert isinstance(scripted_run(script, tmp_path, "a").error, KeyboardInterrupt)
    assert curves(world("a", resume=True).folder) == curves(whole.folder)


def test_train_works_in_a_thread_and_raises_value_error_on_bad_input(script, world, tmp_path):
    found = []

    def work():
        found.append(scripted_run(script, tmp_path, "thread", epochs=1))
        found.append(scripted_run(script, tmp_path, "bad", epochs=0))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert found[0].error is None and isinstance(found[1].error, ValueError)
    assert curves(found[0].folder) == curves(world("main", epochs=1).folder)


def test_train_leaves_the_signal_handlers_as_they_were(script, world, tmp_path):
    before = [signal.getsignal(number) for number in logx.STOP_SIGNALS]
    world("a", epochs=1)
    scripted_run(script, tmp_path, "b", interrupt_at(5))
    assert [signal.getsignal(number) for number in logx.STOP_SIGNALS] == before


def test_quick_is_the_robust_recipe_and_ends_with_test_trials(script, tmp_path, monkeypatch):
    ended = []
    monkeypatch.setattr(script, "train", lambda flags: tmp_path / flags.recipe)
    monkeypatch.setattr(evaluate, "after_training", lambda *args: ended.append(args))
    monkeypatch.setattr("sys.argv", "script.py --task p2p --quick --quiet".split())
    script.main()
    assert ended == [(tmp_path / "robust", "p2p", "fast", True)]


# ---- the policy ------------------------------------------------------------------------------------------------------

WITHOUT_NOISE = {ddpg: dict(act_noise=0.0, update_every=40), ppo: dict(log_std=-20.0)}


@pytest.mark.parametrize("recipe, symmetry", [("paper", "none"), ("robust", "canonical")])
def test_policy_pt_is_the_policy_that_acts(script, recipe, symmetry, tmp_path):
    """What was learned at step 80 acts until the run is interrupted, and is saved."""
    flags = WITHOUT_NOISE[script] | RESUMED[recipe] | dict(symmetry=symmetry)
    run = scripted_run(script, tmp_path, "a", interrupt_at(119), **flags)
    act, policy = evaluate.load_policy(run.folder), torch.load(run.folder / "policy.pt", weights_only=True)
    for x in run.steps[80:]:
        assert np.abs(act(x.s) - np.clip(x.a, -1, 1)).max() < 1e-5
    assert set(policy) - {"grasp_input"} == {"task", "symmetry", "sizes", "output", "weights"}
    if symmetry == "canonical":
        assert np.abs(act(run.steps[80].s) - act(gas.rotate(run.steps[80].s, 1.0))).max() < 1e-5


# ---- losses ----------------------------------------------------------------------------------------------------------


def learner_and_buffers(script, **changes):
    """A Learner with small networks, and arguments of its updates: random transitions, a fifth of them ends."""
    flags = script.resolve(script.Flags(**TINY[script] | dict(lambda_bc=1.0, symmetry="none") | changes))
    torch.manual_seed(0)
    learner, rng, buffers = script.Learner(flags), np.random.default_rng(0), []
    for n in (60, 40):
        buffer = script.ReplayBuffer(22, n, "none") if script is ddpg else script.TrajectoryBuffer(22, n, "none")
        for i in range(n):
            s, a, s2 = (rng.normal(size=k).astype(np.float32) for k in (22, 4, 22))
            end = i % 5 == 4
            buffer.store(s, a, rng.normal(), s2, *((0.9 * (not end),) if script is ddpg else (end, end, True)))
        buffers.append(buffer)
    return learner, (*buffers, 3) if script is ddpg else buffers


def weights(learner):
    """(actor, critic): all weights of each."""
    actor = learner.mu if hasattr(learner, "mu") else learner.omega
    return [torch.cat([p.detach().flatten() for p in parameters]) for parameters in (actor, learner.nu)]


def updated(script):
    """(actor, critic) after three updates."""
    learner, arguments = learner_and_buffers(script, **{} if script is ddpg else dict(train_iters=3))
    learner.updates(*arguments)
    return weights(learner)


@pytest.mark.parametrize("loss", ["loss_C", "loss_O", "loss_BC", "loss_A", "mask"])
def test_what_is_printed_is_what_trains(script, loss, monkeypatch):
    """A loss replaced by zero gives other weights; without L_A the actor stays as it was, without L_C the critic."""
    actor, critic = updated(script)
    real = getattr(script, loss)
    monkeypatch.setattr(script, loss, lambda *args: 0 * real(*args))
    other_actor, other_critic = updated(script)
    first_actor, first_critic = weights(learner_and_buffers(script)[0])
    assert torch.equal(other_actor, first_actor) == (loss == "loss_A")
    assert torch.equal(other_critic, first_critic) == (loss == "loss_C")
    assert not torch.equal(other_critic, critic) if loss == "loss_C" else not torch.equal(other_actor, actor)


def test_the_cloning_loss_averages_over_the_batch_and_the_four_actions(script):
    """Eq. 7. Rows: 2, 0.25 and, masked out, 4; over 3 rows of 4 actions."""
    a_demo = torch.tensor([[1.0, 0, 0, 0], [0, 0.5, 0, 0], [1, 1, 1, 1]])
    a_hat = torch.tensor([[0.0, 0, 0, 1], [0, 0, 0, 0], [0, 0, 0, 0]])
    assert script.loss_BC(a_demo, a_hat, torch.tensor([1.0, 1, 0])).item() == pytest.approx(2.25 / 12)
    assert script.loss_BC(a_demo, a_hat, torch.zeros(3)).item() == 0


def test_the_actor_loss_adds_lambda_times_the_cloning_loss(script):
    assert script.loss_A(torch.tensor(2.0), torch.tensor(3.0), 1.5).item() == 6.5  # Eq. 6


# ---- flags -----------------------------------------------------------------------------------------------------------


def test_explicit_flags_win_over_the_recipe_and_the_recipe_over_nothing(script):
    assert script.resolve(script.Flags()) == script.resolve(script.Flags(recipe="paper"))
    assert script.resolve(script.Flags(quick=True)).recipe == "robust"
    robust = vars(script.resolve(script.Flags(recipe="robust")))
    task = robust["task"]
    assert all(robust[name] == value for name, value in script.recipe_defaults(task, "robust").items())
    given = script.recipe_defaults(task, "paper")
    explicit = vars(script.resolve(script.Flags(recipe="robust", **given)))
    assert {name: explicit[name] for name in given} == given != {name: robust[name] for name in given}


@pytest.mark.parametrize("given, name", [
    (dict(task="p2p"), "p2p-{}-paper-N100-lambda1.8-gas-seed0"),
    (dict(task="p2po", recipe="robust", symmetry="so2", seed=7), "p2po-{}-robust-N250-lambda2-so2-seed7"),
    (dict(task="pnp", num_demos=15, lambda_bc=0.5), "pnp-{}-paper-N15-lambda0.5-gas-seed0"),
    (dict(task="p2p", gamma=0.9), "p2p-{}-paper-N100-lambda1.8-gas-gamma=0.9-seed0"),
    (dict(task="p2p", epochs=7), "p2p-{}-paper-N100-lambda1.8-gas-epochs=7-seed0"),
    (dict(task="p2p", data_dir="x", quiet=True, eval_every=0, resume=True), "p2p-{}-paper-N100-lambda1.8-gas-seed0"),
    (dict(name="own", seed=7), "own"),
])  # fmt: skip
def test_the_default_name_says_task_algorithm_recipe_demonstrations_lambda_symmetry_and_seed(script, given, name):
    algo = "ddpg" if script is ddpg else "ppo"
    assert script.resolve(script.Flags(**given)).name == name.format(algo)


def another(field, value):
    """Another value of a flag."""
    if field.metadata["choices"]:
        return next(choice for choice in field.metadata["choices"] if choice != value)
    if isinstance(value, bool):
        return not value
    if isinstance(value, tuple):
        return (8, 8)
    return "some/where/demos.npz" if value is None else value + 1 if isinstance(value, int) else 0.9 * value + 0.005


def test_runs_that_differ_in_any_setting_differ_in_their_variant_and_name(script, tmp_path):
    # on-policy noise does not go with demos_in_B_o; keep_clone needs a clone
    base = dict(task="pnp", demos_in_B_o=script is ddpg, clone_iters=1, num_demos=4)
    plain = script.resolve(script.Flags(**base))
    changed = {field.name: another(field, getattr(plain, field.name)) for field in fields(script.Flags)
               if field.name not in logx.NOT_A_VARIANT | {"demos_in_B_o"}}  # fmt: skip
    found = [script.resolve(script.Flags(**base | {name: value})) for name, value in changed.items()]
    changed |= {"gains": None, "demo_noise": None}  # which do not go with demos
    found.append(script.resolve(script.Flags(**base | changed)))  # every other flag at once
    for what in ("variant", "name"):
        assert len({getattr(flags, what) for flags in (plain, *found)}) == len(found) + 1
    for flags in found:
        (tmp_path / flags.name).mkdir()  # no longer than a folder's name may be


def test_what_a_tables_column_and_a_seed_say_makes_no_variant(script):
    for given in (dict(), dict(seed=5, num_demos=7, lambda_bc=9.0, symmetry="so2"), dict(recipe="robust", epochs=3),
                  dict(quick=True, eval_every=1, data_dir="x", name="y"), dict(gamma=0.99)):  # fmt: skip
        assert script.resolve(script.Flags(**given)).variant == ""


# ---- bad input -------------------------------------------------------------------------------------------------------

BAD = {  # one a rule; what the message must name
    "out of range": (dict(epochs=0), "--epochs 0: must be at least 1"),
    "not finite": (dict(gamma=math.nan), "--gamma nan"),
    "not a choice": (dict(task="p3p"), "--task p3p: must be one of p2p, p2po, pnp"),
    "no folder's name": (dict(name="a/b"), "--name 'a/b'"),
    "fewer demonstrations in the file": (dict(num_demos=9, demos="{file}", symmetry="none"), "--num_demos 9"),
    "a file of another task": (dict(num_demos=1, demos="{file}", task="p2po"), "task p2p"),
    "other sectors": (dict(num_demos=1, demos="{file}", symmetry="gas", partitions=8), "--partitions 8"),
    "no such file": (dict(num_demos=1, demos="nowhere.npz"), "nowhere.npz"),
}


@pytest.fixture(scope="session")
def demo_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("demos") / "demos.npz"
    meta = dict(task="p2p", stage="demo", env_steps=18, gains="fast", seed=3, partitions=4, symmetry="none")
    np.savez_compressed(path, **demo_arrays(), meta=np.array(json.dumps(meta)))
    return str(path)


def test_all_demonstrations_of_a_file_are_taken_unless_fewer_are_asked_for(script, demo_file):
    found = len(demo_arrays()["length"])
    flags = script.resolve(script.Flags(task="p2p", demos=demo_file, symmetry="none"))
    assert flags.num_demos == found and f"-N{found}-" in flags.name
    assert script.resolve(replace(flags, num_demos=2, name=None)).num_demos == 2
    in_first = int((demo_arrays()["partition"] == 0).sum())
    assert script.resolve(script.Flags(task="p2p", demos=demo_file, symmetry="gas")).num_demos == 4 * in_first


def test_a_file_without_an_episode_of_partition_0_has_nothing_to_map(script, demo_file, tmp_path):
    with np.load(demo_file) as file:
        arrays = dict(file)
    np.savez(tmp_path / "d.npz", **arrays | {"partition": arrays["partition"] | 1})
    elsewhere = script.Flags(task="p2p", demos=str(tmp_path / "d.npz"))
    assert script.resolve(replace(elsewhere, symmetry="none")).num_demos == len(arrays["length"])
    for N in (None, 2):
        with pytest.raises(logx.BadInput, match="--demos .*no episode of partition 0.*--symmetry none"):
            script.train(replace(elsewhere, symmetry="gas", num_demos=N, data_dir=tmp_path))
    assert not list(tmp_path.glob("*/"))


@pytest.mark.parametrize("rule", BAD)
def test_bad_input_is_a_value_error_that_names_the_flag_and_leaves_no_folder(script, rule, tmp_path, demo_file):
    flags, says = BAD[rule]
    flags = {name: value.format(file=demo_file) if name == "demos" else value for name, value in flags.items()}
    run = scripted_run(script, tmp_path / "runs", flags.pop("name", "a"), **flags)
    assert isinstance(run.error, ValueError) and says in str(run.error)
    assert not (tmp_path / "runs").exists() or not list((tmp_path / "runs").iterdir())


def test_what_learns_stays_on_the_device_asked(script, monkeypatch):
    """Without a GPU: on torch's "meta" device, where an operation of two devices is an error. It has no values, so that
    PPO's update, which stops by them, is not run there."""
    adam = torch.optim.Adam
    monkeypatch.setattr(
        torch.optim, "Adam", lambda *args, fused, **more: adam(*args, **more)
    )  # "meta" has no fused one
    flags = script.resolve(script.Flags(task="pnp", recipe="robust", hidden_sizes=(8, 8), clone_iters=2, quiet=True))
    learner = script.Learner(replace(flags, device="meta"))
    B = (ddpg.ReplayBuffer if script is ddpg else ppo.TrajectoryBuffer)(25, 20, "mirror")
    B.filled = 20
    if script is ddpg:
        assert {x.device.type for x in learner.update(B, B)} == {"meta"}
    learner.clone(B)
    assert {w.device.type for w in learner.net.parameters()} == {"meta"}


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU here")
def test_cuda_without_a_gpu_is_bad_input(script, tmp_path):
    run = scripted_run(script, tmp_path, "a", device="cuda")
    assert isinstance(run.error, logx.BadInput) and "--device cuda" in str(run.error)


@pytest.mark.parametrize("changes, says", [
    (dict(resume=False), "go on with --resume, or choose another --name"),
    (dict(gamma=0.5), "made with --gamma 0.99, not 0.5"),
], ids=["not without --resume", "not with other flags"])  # fmt: skip
def test_a_folder_of_a_run_is_gone_on_with_only_as_that_run(script, changes, says, world, tmp_path):
    folder = world("a", epochs=1).folder
    before = {path: path.read_bytes() for path in folder.iterdir()}
    run = scripted_run(script, tmp_path, "a", **dict(resume=True) | changes)
    assert isinstance(run.error, logx.BadInput) and says in str(run.error)
    assert {path: path.read_bytes() for path in folder.iterdir()} == before


def test_a_run_of_the_other_algorithm_is_not_gone_on_with(tmp_path):
    finished_run(ddpg, tmp_path, "a", epochs=1)
    run = scripted_run(ppo, tmp_path, "a", resume=True)
    assert isinstance(run.error, logx.BadInput) and "a run of ddpg, not of ppo" in str(run.error)


# ---- the real world --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("recipe", ["paper", "robust"])
@pytest.mark.parametrize("task", OBS_DIM)
def test_every_task_trains_with_every_recipe_and_its_agent_can_be_tested(script, task, recipe, tmp_path):
    flags = TINY[script] | dict(task=task, recipe=recipe, num_demos=1, lambda_bc=None, epochs=1, eval_every=1,
                                eval_trials=1, data_dir=str(tmp_path), max_ep_len=15, gains="fast")  # fmt: skip
    flags |= dict(clone_iters=2) if recipe == "robust" else {}
    flags |= dict(update_after=20) if script is ddpg else {}
    folder = script.train(script.Flags(**flags))
    (row,) = rows_of(folder / "progress.csv")
    assert all(row[name] != "" for name in ("L_O", "L_BC", "L_C", "L_A", "mask_fraction", "EpRet", "eval_return"))
    policy = torch.load(folder / "policy.pt", weights_only=True)
    assert policy["task"] == task and policy["sizes"][0] == OBS_DIM[task] + bool(policy.get("grasp_input"))
    rows, _ = evaluate.run_trials(task, folder, trials=1, horizon=5, quiet=True)
    assert rows[0]["length"] <= 5
