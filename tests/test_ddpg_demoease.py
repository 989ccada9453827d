"""ddpg_demoease.py against the paper (Alg. 1, Eq. 6 to 8, Table 1) and against definitions: what an update does, what
is stored, and when. What it shares with ppo_demoease.py: test_algorithms.py."""

import math
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch import nn

import ddpg_demoease as ddpg
import evaluate
import gas
import logx
from scripted import TINY, checkpoint, demo_arrays, finished_run, rows_of, scripted_run, states


@pytest.fixture
def world(tmp_path):
    """world(name, **flags): a finished run in the scripted world."""
    return partial(finished_run, ddpg, tmp_path)


def resolve(**changes):
    return ddpg.resolve(ddpg.Flags(**changes))


def stored(run):
    """The rows of B_o at the end of a run."""
    return checkpoint(run.folder)["B_o"]["rows"]


class Fixed:
    """A buffer that always gives this batch."""

    def __init__(self, *batch):
        self.batch = batch

    def sample(self, batch_size, device):
        return self.batch


def random_batch(n, obs_dim=22):
    """(s, a, r, s', discount): a third of them true ends, gamma 0.9."""
    s, s2 = 0.7 * torch.randn(n, obs_dim), 0.7 * torch.randn(n, obs_dim)
    discount = 0.9 * (torch.rand(n) > 1 / 3).float()
    return s, 2 * torch.rand(n, 4) - 1, 4 * torch.randn(n), s2, discount


# ---- the update against the paper ------------------------------------------------------------------------------------


class Paper:
    """Alg. 1 with Eq. 6 to 8 in plain autograd and two torch.optim.Adam. keep_clone: weight of Eq. 7 of states of B_o,
    with the clone's action and M = 1. Shares nothing with the source but the weights it starts from."""

    def __init__(self, learner, omega, lambda_bc, pi_lr, q_lr, masked=True, keep_clone=0.0):
        self.omega, self.lambda_bc, self.masked, self.keep_clone = omega, lambda_bc, masked, keep_clone

        def copy_of(source):
            sizes, layers = [p.shape for p in source.parameters() if p.dim() == 2], []
            for n_out, n_in in sizes:
                layers += [nn.Linear(n_in, n_out), nn.ReLU()]
            net = nn.Sequential(*layers[:-1])
            net.load_state_dict({name: w.clone() for name, w in source.state_dict().items()})  # strict
            return net

        self.u, self.u_target = copy_of(learner.net.mu_net), copy_of(learner.target.mu_net)
        self.q, self.q_target = copy_of(learner.net.q_net), copy_of(learner.target.q_net)
        self.u_clone = copy_of(learner.clone_net)
        self.mu, self.nu = list(self.u.parameters()), list(self.q.parameters())
        self.adam_mu, self.adam_nu = torch.optim.Adam(self.mu, lr=pi_lr), torch.optim.Adam(self.nu, lr=q_lr)
        self.pairs = [(self.u, learner.net.mu_net), (self.u_target, learner.target.mu_net)]
        self.pairs += [(self.q, learner.net.q_net), (self.q_target, learner.target.q_net)]

    def update(self, batch, demo):
        """One step. batch: (s, a, r, s2, discount), demo: (s, a) or None. Returns its figures, floats by name."""
        s, a, r, s2, discount = batch

        def value(q, s, a):
            return q(torch.cat([s, a], -1))[:, 0]

        def cloned(s, a_demo, masked):
            a_hat = torch.tanh(self.u(s))
            M = value(self.q, s, a_hat) < value(self.q, s, a_demo)
            M = M if masked else torch.ones_like(M)
            return torch.sum((a_demo[M] - a_hat[M]) ** 2) / (4 * len(s)), M, a_hat

        with torch.no_grad():
            y = r + discount * value(self.q_target, s2, torch.tanh(self.u_target(s2)))
        Q, u = value(self.q, s, a), self.u(s)
        L_C = torch.sum((y - Q) ** 2) / len(s)
        L_A = L_O = -torch.sum(value(self.q, s, torch.tanh(u))) / len(s)
        figures = {"L_O": L_O, "L_C": L_C, "Q_mean": Q.mean(), "Q_max": Q.max(), "pretanh_own": u.abs().mean()}
        if demo is not None:
            s_d, a_d = demo
            L_BC, M, a_hat = cloned(s_d, a_d, self.masked)
            L_A = self.lambda_bc * L_BC + L_O
            if self.keep_clone:
                figures["L_keep"], *_ = cloned(s, torch.tanh(self.u_clone(s)).detach(), False)
                L_A = L_A + self.keep_clone * figures["L_keep"]
            figures |= {"L_BC": L_BC, "mask_fraction": M.float().mean(), "pretanh_demo": self.u(s_d).abs().mean(),
                        "bc_relative_error": torch.mean((a_d - a_hat) ** 2) / torch.mean(a_d**2)}  # fmt: skip
        for L, parameters in ((L_A, self.mu), (L_C, self.nu)):
            for p, g in zip(parameters, torch.autograd.grad(L, parameters, retain_graph=True), strict=True):
                p.grad = g
        self.adam_mu.step()
        self.adam_nu.step()
        with torch.no_grad():
            for target, now in ((self.u_target, self.u), (self.q_target, self.q)):
                for p2, p in zip(target.parameters(), now.parameters(), strict=True):
                    p2.copy_(self.omega * p2 + (1 - self.omega) * p)
        return {name: value.item() for name, value in (figures | {"L_A": L_A}).items()}

    def assert_same_weights(self):
        for ours, theirs in self.pairs:
            for p, q in zip(ours.parameters(), theirs.parameters(), strict=True):
                torch.testing.assert_close(q.detach(), p.detach(), rtol=0, atol=2e-5)


def learner_and_paper(masked=True, keep_clone=0.0, **changes):
    torch.manual_seed(1)
    flags = resolve(hidden_sizes=(24, 40, 16), polyak=0.8, lambda_bc=1.3, pi_lr=2e-3, q_lr=5e-3, symmetry="none",
                    mask="q" if masked else "none", keep_clone=keep_clone, **changes)  # fmt: skip
    learner = ddpg.Learner(flags)
    return learner, Paper(learner, 0.8, 1.3, 2e-3, 5e-3, masked, keep_clone)


@pytest.mark.parametrize("masked, keep_clone, with_demos", [
    (True, 0.0, True), (False, 0.0, True), (True, 3.0, True), (False, 3.0, True), (True, 0.0, False),
], ids=["as published", "no mask", "clone kept", "clone kept, no mask", "no demonstrations"])  # fmt: skip
def test_updates_are_those_of_a_plain_reimplementation_of_the_paper(masked, keep_clone, with_demos):
    learner, paper = learner_and_paper(masked, keep_clone, clone_iters=1)
    fractions = []
    for _ in range(6):
        batch, demo = random_batch(48), random_batch(30)
        expected = paper.update(batch, demo[:2] if with_demos else None)
        measured = learner.updates(Fixed(*batch), Fixed(*demo) if with_demos else None, 1)
        for name, value in expected.items():
            assert measured.pop(name) == pytest.approx(value, rel=1e-4, abs=1e-5), name
        assert all(math.isnan(value) for value in measured.values())  # what needs B_d, without it
        fractions.append(expected.get("mask_fraction", math.nan))
        paper.assert_same_weights()
    if with_demos:
        assert min(fractions) > 0 and max(fractions) < 1 if masked else fractions == [1] * 6


def test_cloning_first_fits_the_actor_alone_without_a_mask_at_a_rate_that_falls_to_0():
    learner, paper = learner_and_paper(clone_iters=5)
    before = [p.clone() for p in learner.net.q_net.parameters()]
    demo = random_batch(30)
    learner.clone(Fixed(*demo))
    adam = torch.optim.Adam(paper.mu, lr=5e-3)
    for n in range(5):
        adam.param_groups[0]["lr"] = 5e-3 * (1 + math.cos(math.pi * n / 5)) / 2
        loss = torch.mean((torch.tanh(paper.u(demo[0])) - demo[1]) ** 2)
        for p, g in zip(paper.mu, torch.autograd.grad(loss, paper.mu), strict=True):
            p.grad = g
        adam.step()
    paper.u_target.load_state_dict(paper.u.state_dict())
    paper.assert_same_weights()
    for p, q in zip(learner.clone_net.parameters(), learner.net.mu_net.parameters(), strict=True):
        assert torch.equal(p, q)
    assert all(map(torch.equal, before, learner.net.q_net.parameters()))


def test_normalisation_is_by_mean_and_deviation_of_the_demonstrated_states_or_a_fifth():
    torch.manual_seed(0)
    learner = ddpg.Learner(resolve(normalize_obs=True, clone_iters=1, num_demos=4))
    B_d = ddpg.ReplayBuffer(22, 500, "none")
    B_d.load({"rows": torch.linspace(-3, 3, 50) + torch.logspace(-2, 4, 50) * torch.randn(500, 50), "next": 0})
    learner.clone(B_d)
    seen, std = learner.net.inputs(B_d.rows[:, :22]), B_d.rows[:, :22].std(0)
    assert 3 < (std > 0.2).sum() < 22  # both cases
    torch.testing.assert_close(seen.mean(0), torch.zeros(22), rtol=0, atol=1e-4)
    torch.testing.assert_close(seen.std(0), torch.where(std > 0.2, 1.0, std / 0.2), rtol=1e-4, atol=1e-6)
    assert torch.equal(learner.target.s_mean, learner.net.s_mean)


def test_the_saved_policy_is_the_one_that_acts_normalised_and_told_of_the_grasp():
    torch.manual_seed(0)
    s = states(200, 25)
    s[::2, 22:] = s[::2, 16:19] - s[::2, 19:22]  # in half of the states the cube is grasped
    learner = ddpg.Learner(resolve(task="pnp", grasp_input=True, hidden_sizes=(16, 16)))
    learner.net.s_mean.uniform_(-2, 2)
    learner.net.s_std.uniform_(0.2, 3)
    policy = evaluate.Policy(learner.policy())
    x = torch.from_numpy(s)
    np.testing.assert_allclose(policy(s), learner.net.pi(x).detach(), rtol=0, atol=1e-5)
    assert learner.net.inputs(x)[:, -1].tolist() == [1, 0] * 100


def test_the_mask_picks_the_rows_where_the_demonstrated_action_is_worth_more():
    Q_demo, Q_own = torch.tensor([1.0, 2.0, -1.0, -3.0, 0.0]), torch.tensor([0.5, 2.0, -2.0, -2.0, 1e-6])
    assert ddpg.mask(Q_demo, Q_own).tolist() == [1, 0, 1, 0, 0]  # Eq. 8: <, so not where they are equal


# ---- replay buffers --------------------------------------------------------------------------------------------------


def test_the_ring_overwrites_the_oldest_and_a_sample_draws_all_others_alike():
    torch.manual_seed(0)
    B = ddpg.ReplayBuffer(22, 7, "none")
    for i in range(17):
        B.store(np.full(22, i, np.float32), np.zeros(4, np.float32), i, np.full(22, -i), 0.9)
    r = torch.cat([B.sample(100, "cpu")[2] for _ in range(2000)])
    assert len(r) == 7 * 2000  # a batch larger than what is stored: as many as are stored
    counts = torch.bincount(r.long(), minlength=17)
    assert counts[:10].sum() == 0 and (counts[10:] - 2000).abs().max() < 200  # 4.8 standard deviations
    s, a, r, s2, discount = B.sample(4, "cpu")
    assert s.shape == s2.shape == (4, 22) and a.shape == (4, 4) and r.shape == discount.shape == (4,)
    assert torch.equal(s[:, 3], r) and torch.equal(s2[:, 3], -r)


def test_a_checkpoint_holds_the_filled_rows_alone(world):
    run = world("a", replay_size=1_000_000, epochs=1)
    assert (run.folder / "checkpoint.pt").stat().st_size < 200_000  # 40 rows of 50 numbers, and small networks


def test_so2_turns_every_sampled_transition_by_an_angle_of_its_own():
    torch.manual_seed(0)
    B = ddpg.ReplayBuffer(22, 400, "so2")
    s, s2 = states(400), states(400, seed=1)
    for i in range(400):
        B.store(s[i], np.full(4, i, np.float32), i, s2[i], 0.9)
    t, a, r, t2, _ = B.sample(400, "cpu")
    i, angle = r.long(), torch.from_numpy(s[:, 0])[r.long()] - t[:, 0]  # q_1 goes down where the world turns up
    for before, after in ((s, t), (s2, t2)):
        turned = gas.rotate(torch.from_numpy(before)[i], angle)
        torch.testing.assert_close(turned[:, 1:], after[:, 1:], rtol=0, atol=1e-5)
    assert torch.equal(a, r[:, None].expand(-1, 4))  # psi is the identity
    assert (torch.histc(torch.remainder(angle, 2 * math.pi), 8, 0, 2 * math.pi) - 50).abs().max() < 32  # all round


def test_mirror_exchanges_left_and_right_in_half_of_the_sampled_transitions():
    B, s, s2 = ddpg.ReplayBuffer(25, 400, "mirror"), states(400, 25), states(400, 25, seed=1)
    a = np.random.default_rng(2).uniform(-1, 1, (400, 4)).astype(np.float32)
    for i in range(400):
        B.store(s[i], a[i], i, s2[i], 0.9)
    t, b, r, t2, _ = (x.numpy() for x in B.sample(100, "cpu"))
    for row in range(100):
        i = int(r[row])
        before, after = (gas.cylinder(s[i]), a[i]), gas.cylinder(s2[i])
        if row % 2 == 0:
            before, after = gas.mirror(*before), gas.mirror(after, a[i])[0]
        for found, expected in ((t[row], before[0]), (b[row], before[1]), (t2[row], after)):
            assert np.array_equal(found, expected)


def test_the_symmetry_meets_the_data_as_it_is_stored(world):
    for symmetry in gas.SYMMETRIES:
        run = world(symmetry, symmetry=symmetry, epochs=1)
        assert torch.equal(stored(run), transitions(run.steps, view=lambda s: gas.seen(s, symmetry)))  # noqa: B023


# ---- what is stored --------------------------------------------------------------------------------------------------


def transitions(steps, n=1, gamma=0.99, timeout_ends=False, view=lambda s: s):
    """Rows of B_o by definition: of each step, the rewards of n steps (less at an episode's end) and the state then."""
    rows, episode = [], []
    for x in steps:
        episode.append(x)
        ended = x.terminated or x.truncated
        for first in range(max(0, len(episode) - n), len(episode) if ended else max(0, len(episode) - n + 1)):
            m = len(episode) - first
            if m < n and not ended:
                continue
            r = sum(gamma**i * y.r for i, y in enumerate(episode[first:]))
            zeta = x.terminated or (timeout_ends and x.truncated)
            rows.append([*view(episode[first].s), *episode[first].a, r, *view(x.s2), 0 if zeta else gamma**m])
        episode = [] if ended else episode
    return torch.from_numpy(np.array(rows).astype(np.float32))


def as_steps(episode):
    return [SimpleNamespace(**dict(zip(("s", "a", "r", "s2", "terminated", "truncated"), step, strict=True)))
            for step in episode]  # fmt: skip


@pytest.mark.parametrize("timeout_ends", [False, True])
@pytest.mark.parametrize("n", [1, 3, 9])
def test_n_steps_are_the_discounted_rewards_and_what_the_value_then_counts_for(n, timeout_ends):
    """By n_step_sum and store_last_step, of episodes that end truly, by a timeout, and not yet."""
    rng, B, expected = np.random.default_rng(0), ddpg.ReplayBuffer(22, 50, "none"), []
    for length, terminated, truncated in ((5, True, False), (4, False, True), (12, False, False)):
        episode = []
        for t in range(length):
            s, a, s2 = (rng.normal(size=k).astype(np.float32) for k in (22, 4, 22))
            last = t == length - 1
            episode.append((s, a, rng.normal(), s2, terminated and last, truncated and last))
            ddpg.store_last_step(B, episode, n, 0.9, timeout_ends)
        expected.append(transitions(as_steps(episode), n, 0.9, timeout_ends))
    expected = torch.cat(expected)
    assert B.filled == len(expected) == 9 + 12 - n + 1
    torch.testing.assert_close(B.rows[: B.filled], expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("timeout_ends", [False, True])
def test_only_a_true_end_stops_bootstrapping_and_with_timeout_ends_a_timeout_too(timeout_ends, world):
    """Also of the demonstrations, where leaving the sector is no true end."""
    flags = dict(num_demos=4, symmetry="none", recorded=demo_arrays(), timeout_ends=timeout_ends)
    run = world("a", **flags)
    of_end = {}
    for x, row in zip(run.steps, stored(run)[18:], strict=True):
        of_end.setdefault(x.end, set()).add(round(row[-1].item(), 6))
    assert of_end == {"": {0.99}, "success": {0}, "self": {0}, "timeout": {0 if timeout_ends else 0.99}}
    for rows in (stored(run)[:18], checkpoint(run.folder)["B_d"]["rows"]):
        assert (rows[:, -1] == 0).nonzero().flatten().tolist() == ([5, 9, 14, 17] if timeout_ends else [5, 9])


def test_a_timeout_of_the_real_environment_does_not_stop_bootstrapping(tmp_path):
    flags = TINY[ddpg] | dict(max_ep_len=15, update_after=999, start_steps=999, data_dir=str(tmp_path))
    folder = ddpg.train(ddpg.Flags(**flags))
    rows = rows_of(folder / "episodes.csv")
    ends = [int(row["env_steps"]) for row in rows if row["success"] == "1" or row["collision"]]
    assert len(ends) < len(rows) >= 8  # most of them time out
    assert (1 + (checkpoint(folder)["B_o"]["rows"][:, -1] == 0).nonzero().flatten()).tolist() == ends


@pytest.mark.parametrize("demos_in_B_o", [True, False])
def test_demonstrations_go_into_both_buffers_unless_asked_not_to(demos_in_B_o, world):
    run = world("a", num_demos=4, symmetry="none", recorded=demo_arrays(), demos_in_B_o=demos_in_B_o, n_step=3)
    columns = (demo_arrays()[name] for name in ("obs", "act", "rew", "obs2", "terminated", "truncated"))
    steps = as_steps(zip(*columns, strict=True))
    assert torch.equal(checkpoint(run.folder)["B_d"]["rows"], transitions(steps))  # failed ones too, always one step
    torch.testing.assert_close(stored(run), transitions((steps if demos_in_B_o else []) + run.steps, 3))


def test_with_noise_B_o_holds_what_was_done_and_B_d_what_the_demonstrator_asked_for(world):
    demos = demo_arrays()
    demos["executed"] = demos["act"] + 0.1
    run = world("a", num_demos=4, symmetry="none", recorded=demos)
    assert torch.equal(checkpoint(run.folder)["B_d"]["rows"][:, 22:26], torch.from_numpy(demos["act"]))
    assert torch.equal(stored(run)[:18, 22:26], torch.from_numpy(demos["executed"]))


def test_the_ring_of_a_run_keeps_the_newest_steps(world):
    run = world("a", replay_size=50)
    assert sorted(stored(run).tolist()) == sorted(transitions(run.steps[-50:]).tolist())


# ---- when ------------------------------------------------------------------------------------------------------------


@pytest.fixture
def blocks(monkeypatch):
    """(rows in B_o, gradient steps) of each block of updates."""
    made, updates = [], ddpg.Learner.updates
    monkeypatch.setattr(ddpg.Learner, "updates", lambda self, B_o, B_d, n: made.append((B_o.filled, n))
                        or updates(self, B_o, B_d, n))  # fmt: skip
    return made


def test_updates_begin_at_update_after_and_come_in_blocks_of_as_many_as_there_were_steps(world, blocks):
    world("a", update_after=60, update_every=7)
    assert blocks == [(t, 7) for t in range(63, 121, 7)]
    blocks.clear()
    world("b", update_after=28, update_every=7, epochs=1)
    assert blocks == [(28, 7), (35, 7)]
    blocks.clear()
    world("c", update_after=0, update_every=1, n_step=30, epochs=1)
    assert min(rows for rows, _ in blocks) > 0  # not before the first row of n steps


def test_the_first_actions_are_uniform_and_the_policys_with_noise_of_sigma_come_after(world):
    run = world("a", start_steps=90, update_after=9999, epochs=20)
    act = evaluate.load_policy(run.folder)  # never updated: the one that acted
    a = np.stack([x.a for x in run.steps[:90]])
    assert a.min() < -0.95 and a.max() > 0.95 and np.abs(a).max() <= 1
    for joint in a.T:  # uniform: quarters of [-1, 1] alike
        assert np.histogram(joint, 4, (-1, 1))[0].min() >= 11
    noise = np.stack([x.a - act(x.s) for x in run.steps[90:] if np.abs(act(x.s)).max() < 0.6])
    assert noise.size > 800 and abs(noise.mean()) < 0.02 and 0.09 < noise.std() < 0.11
    assert 0.6 < np.mean(np.abs(noise) < 0.1) < 0.76  # normal: 0.68
    run = world("b", start_steps=0, update_after=9999, act_noise=3.0, epochs=1)
    assert np.abs([x.a for x in run.steps]).max() == 1  # clipped


# ---- parts of the robust recipe, each on its own ---------------------------------------------------------------------


def test_of_the_exploration_noise_noise_kept_is_in_the_next_steps_and_its_deviation_is_still_sigma(world):
    run = world("a", start_steps=0, update_after=9999, epochs=60, noise_kept=0.9, act_noise=0.2)
    act = evaluate.load_policy(run.folder)
    steps = [(x.a - act(x.s), np.abs(act(x.s)).max() < 0.3) for x in run.steps]
    noise, free = np.stack([n for n, _ in steps]), np.array([f for _, f in steps])
    assert free.sum() > 500 and 0.17 < noise[free].std() < 0.23
    together = free[1:] & free[:-1]
    before, after = noise[:-1][together], noise[1:][together]
    assert 0.85 < (before * after).mean() / (before**2).mean() < 0.95
    assert abs(np.std(after - 0.9 * before) / (0.2 * (1 - 0.81) ** 0.5) - 1) < 0.05


def test_updates_per_step_is_kept_up_with(world, blocks):
    """Blocks at 63, 70, ..., 119: floor(0.25 * 119) - floor(0.25 * 56) = 15."""
    world("a", updates_per_step=0.25)
    assert sum(n for _, n in blocks) == 15


# ---- defaults --------------------------------------------------------------------------------------------------------

DEFAULTS = {  # Table 1, Sec. 4.2; N and lambda are the largest of Tables 4 and 5; 5 T, 2 T and T are the release's
    "p2p": dict(max_ep_len=400, epochs=250, update_every=20, num_demos=100, lambda_bc=1.8, hidden_sizes=(128, 512, 128),
                steps_per_epoch=2000, start_steps=800, update_after=400),
    "p2po": dict(max_ep_len=500, epochs=500, update_every=25, num_demos=250, lambda_bc=2,
                 hidden_sizes=(256, 1024, 256), steps_per_epoch=2500, start_steps=1000, update_after=500),
    "pnp": dict(max_ep_len=800, num_demos=400, lambda_bc=15, hidden_sizes=(512, 512, 256)),
}  # fmt: skip
AS_PUBLISHED = dict(recipe="paper", replay_size=10**6, batch_size=100, demo_batch_size=100, gamma=0.99, act_noise=0.1,
                    polyak=0.995, pi_lr=1e-3, q_lr=1e-3, symmetry="gas", partitions=4, mask="q", n_step=1,
                    clone_iters=0, keep_clone=0.0,
                    noise_kept=0, updates_per_step=1, normalize_obs=False, grasp_input=False)  # fmt: skip
ROBUST = dict(symmetry="mirror", gains="fast", demo_noise=0.2, noise_kept=0.9, n_step=10, clone_iters=10_000,
              keep_clone=10, updates_per_step=0.25, pi_lr=3e-4, q_lr=1e-3, start_steps=0, mask="q")  # fmt: skip
ROBUST_TASK = {
    "p2p": dict(epochs=25, steps_per_epoch=1000, act_noise=0.2, normalize_obs=False, grasp_input=False),
    "p2po": dict(epochs=40, steps_per_epoch=2500, act_noise=0.1, normalize_obs=False, grasp_input=False),
    "pnp": dict(epochs=25, steps_per_epoch=4000, act_noise=0.2, normalize_obs=True, grasp_input=True),
}


@pytest.mark.parametrize("task", DEFAULTS)
def test_the_defaults_are_those_of_table_1(task):
    flags = vars(resolve(task=task))
    expected = DEFAULTS[task] | AS_PUBLISHED
    assert {name: flags[name] for name in expected} == expected


@pytest.mark.parametrize("task", ROBUST_TASK)
def test_the_recipe_robust_is_that_of_the_readme(task):
    flags = vars(resolve(task=task, recipe="robust"))
    expected = ROBUST | ROBUST_TASK[task]
    assert {name: flags[name] for name in expected} == expected


def test_a_very_short_episode_still_updates():
    assert resolve(max_ep_len=5).update_every == 1


# ---- bad input -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("flags, says", [
    (dict(keep_clone=1.0, num_demos=4), "--keep_clone 1: there is no clone at --clone_iters 0"),
    (dict(normalize_obs=True), "--normalize_obs: is of demonstrations, and --num_demos 0 has none"),
    (dict(noise_kept=1.0), "--noise_kept 1: leaves no new noise"),
    (dict(grasp_input=True), "--grasp_input: --task p2p has nothing to grasp; allowed on --task pnp"),
    (dict(num_demos=4, replay_size=10), "--replay_size 10: must hold the 18 demonstrated steps"),
], ids=["no clone", "no demonstrations", "no noise", "nothing to grasp", "B_o too small"])  # fmt: skip
def test_flags_that_do_not_go_together_are_bad_input(flags, says, tmp_path):
    run = scripted_run(ddpg, tmp_path, "a", recorded=demo_arrays(), **flags)
    assert isinstance(run.error, logx.BadInput) and says in str(run.error) and not run.folder.exists()
