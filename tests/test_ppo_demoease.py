"""ppo_demoease.py against the paper (Alg. 2, Eq. 6, 7 and 9, Table 2) and against definitions: its sums, an epoch's
updates, and what opens an epoch. What it shares with ddpg_demoease.py: test_algorithms.py."""

import math
from functools import partial
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
import torch
from torch import nn
from torch.distributions import Normal, kl_divergence

import evaluate
import gas
import logx
import pid_demo
import ppo_demoease as ppo
from scripted import DEMO_ENDS, TINY, demo_arrays, finished_run, rows_of, scripted_run, states

NEVER = 1e9  # a KL limit that is never reached
ENDS = ["true", "timeout", "cut", "true", "true", "timeout", "timeout", "cut"]


@pytest.fixture
def world(tmp_path):
    """world(name, **flags): a finished run in the scripted world."""
    return partial(finished_run, ppo, tmp_path)


def resolve(**changes):
    return ppo.resolve(ppo.Flags(**dict(task="p2p") | changes))


# ---- trajectories, and the paper's sums over them --------------------------------------------------------------------


def trajectories(ends, obs_dim=22, seed=0, own=1):
    """Random trajectories, one an entry of `ends`: "true" (success, collision), "timeout" or "cut"."""
    generator, found = torch.Generator().manual_seed(seed), []
    for how in ends:
        n = int(torch.randint(1, 13, (1,), generator=generator))
        s = 0.7 * torch.randn(n + 1, obs_dim, generator=generator)  # the last is the observation before the reset
        zeta, end = torch.zeros(n), torch.zeros(n)
        zeta[-1], end[-1] = how == "true", 1
        found.append(SimpleNamespace(s=s[:-1], a=2 * torch.rand(n, 4, generator=generator) - 1, s2=s[1:], zeta=zeta,
                                     r=4 * torch.randn(n, generator=generator), end=end, own=torch.full((n,), own),
                                     how=how))  # fmt: skip
    return found


def flat(found, name):
    return torch.cat([getattr(trajectory, name) for trajectory in found])


def buffer_of(found, symmetry="none"):
    B = ppo.TrajectoryBuffer(found[0].s.shape[1], sum(len(x.r) for x in found), symmetry)
    for x in found:
        for row in zip(*(getattr(x, name) for name in ("s", "a", "r", "s2", "zeta", "end", "own")), strict=True):
            s, a, r, s2, *flags = (value.numpy() for value in row)
            B.store(s, a, float(r), s2, *(bool(x) for x in flags))
    return B


def empty_buffer(obs_dim=22):
    return ppo.TrajectoryBuffer(obs_dim, 0, "none")


def sums(trajectory, V, V_last, gamma, lam):
    """(R^_t, A^_t before normalisation) of one trajectory by the sums of Alg. 2, term by term; V_last: what follows
    its last step, 0 after a true end."""
    r, V, T = trajectory.r.tolist(), [*V.tolist(), float(V_last)], len(trajectory.r)
    R = [sum(gamma ** (k - t) * r[k] for k in range(t, T)) + gamma ** (T - t) * V[T] for t in range(T)]
    delta = [r[k] + gamma * V[k + 1] - V[k] for k in range(T)]
    A = [sum((gamma * lam) ** (k - t) * delta[k] for k in range(t, T)) for t in range(T)]
    return R, A


def rewards_to_go(demos, gamma=0.9):
    return torch.tensor([R for x in demos for R in sums(x, torch.zeros(len(x.r)), 0.0, gamma, 1)[0]])


def of_random_values(found, seed=5):
    """(V, last_V) as an epoch makes them of random values."""
    generator = torch.Generator().manual_seed(seed)
    V, last_V = (3 * torch.randn(len(flat(found, "r")), generator=generator) for _ in range(2))
    return V, last_V * flat(found, "end") * (1 - flat(found, "zeta"))


@pytest.mark.parametrize("gamma, lam", [(0.9, 0.8), (1.0, 1.0), (0.9, 0.0)])
def test_rewards_to_go_and_advantages_are_the_papers_sums(gamma, lam):
    found = trajectories(ENDS)
    r, end, (V, last_V) = flat(found, "r"), flat(found, "end"), of_random_values(found)
    R, A, begin = [], [], 0
    for x in found:
        of_x = slice(begin, begin := begin + len(x.r))
        for column, of_one in zip((R, A), sums(x, V[of_x], last_V[of_x][-1], gamma, lam), strict=True):
            column.extend(of_one)
    torch.testing.assert_close(ppo.discounted_sum(r, end, last_V, gamma), torch.tensor(R), rtol=1e-4, atol=1e-5)
    A = (np.array(A) - np.mean(A)) / np.std(A)
    torch.testing.assert_close(ppo.advantages(r, end, V, last_V, gamma, lam), torch.tensor(A, dtype=torch.float32),
                               rtol=1e-4, atol=1e-5)  # fmt: skip


def test_nothing_leaks_over_a_trajectorys_end():
    found = trajectories(["timeout", "cut", "true", "true"], seed=3)
    n = len(found[0].r)
    assert n > 3
    r, end, (V, last_V) = flat(found, "r"), flat(found, "end"), of_random_values(found)

    def shape(A):  # of the first trajectory, free of the mean and deviation of the batch
        return (A[1:n] - A[0]) / (A[1] - A[0])

    after = torch.arange(len(r)) >= n
    R, A = ppo.discounted_sum(r, end, last_V, 0.9), ppo.advantages(r, end, V, last_V, 0.9, 0.8)
    r2, V2, last_V2 = (torch.where(after, x + torch.randn(len(x)), x) for x in (r, V, last_V))
    R2, A2 = ppo.discounted_sum(r2, end, last_V2, 0.9), ppo.advantages(r2, end, V2, last_V2, 0.9, 0.8)
    assert torch.equal(R[:n], R2[:n]) and not torch.isclose(R[n:], R2[n:]).any()
    torch.testing.assert_close(shape(A), shape(A2), rtol=1e-3, atol=1e-4)


def test_advantages_that_are_all_equal_are_zero():
    zero = torch.zeros(5)
    assert ppo.advantages(zero, torch.ones(5), zero, zero, 0.99, 0.97).tolist() == [0] * 5


# ---- the updates against the paper -----------------------------------------------------------------------------------


class Paper:
    """An epoch of Alg. 2 with Eq. 6, 7 and 9 in plain autograd, torch.distributions and two torch.optim.Adam. Shares
    nothing with the source but the weights it starts from.

    mask: whether there is Eq. 9; else M = 1."""

    def __init__(self, learner, mask=True):
        self.f, self.mask = learner.flags, mask

        def copy_of(source):
            layers = []
            for n_out, n_in in [p.shape for p in source.parameters()][::2]:
                layers += [nn.Linear(n_in, n_out), nn.ReLU()]
            net = nn.Sequential(*layers[:-1])
            net.load_state_dict({name: w.clone() for name, w in source.state_dict().items()})  # strict
            return net

        self.mu, self.v = copy_of(learner.net.mu_net), copy_of(learner.net.v_net)
        self.log_std = learner.net.log_std.detach().clone().requires_grad_()
        self.omega, self.nu = [*self.mu.parameters(), self.log_std], list(self.v.parameters())
        self.adam_pi, self.adam_v = (torch.optim.Adam(parameters, lr) for parameters, lr in (
                                     (self.omega, self.f.pi_lr), (self.nu, self.f.vf_lr)))  # fmt: skip

    def inputs(self, s):
        if self.mu[0].in_features < 26:
            return s
        P_e = s[:, 16:19] - s[:, 19:22]  # the 26th says whether the cube is where the TCP is
        held = [[float(torch.dist(a, b) < 1e-3)] for a, b in zip(P_e, s[:, 22:], strict=True)]
        return torch.cat((s, torch.tensor(held)), 1)

    def pi(self, s):
        return Normal(self.mu(self.inputs(s)), torch.exp(self.log_std))

    def V(self, s):
        return self.v(self.inputs(s))[:, 0]

    def epoch(self, found, demos, batches, demo_batches):
        """found, demos: the trajectories of B_o and of B_d (or None). batches, demo_batches: rows of them, for each
        update. Returns (the mean of each figure, updates)."""
        f, s, a, own = self.f, flat(found, "s"), flat(found, "a"), flat(found, "own")
        with torch.no_grad():
            old, R, A = self.pi(s), [], []
            log_prob_old = old.log_prob(a).sum(1)
            for x in found:
                V_last = 0.0 if x.how == "true" else self.V(x.s2[-1:]).item()
                for column, of_one in zip((R, A), sums(x, self.V(x.s), V_last, f.gamma, f.lam), strict=True):
                    column.extend(of_one)
        R, A = torch.tensor(R), torch.tensor((np.array(A) - np.mean(A)) / np.std(A), dtype=torch.float32)
        if demos:
            s_d, a_d, r_d = (flat(demos, name) for name in ("s", "a", "r"))
        updates, figures = 0, {}
        for k in range(f.train_iters):
            i = batches[k]
            now, of_agent = self.pi(s[i]), own[i] == 1
            D_KL = kl_divergence(Normal(old.mean[i], old.stddev[i]), now).sum(1)[of_agent].mean()
            if f.target_kl <= D_KL.item():
                break
            ratio = torch.exp(now.log_prob(a[i]).sum(1) - log_prob_old[i])
            clipped = torch.clip(ratio, 1 - f.clip_ratio, 1 + f.clip_ratio)
            L_O = -torch.sum(torch.minimum(ratio * A[i], clipped * A[i])) / len(i)
            V = self.V(s[i])
            L_C = torch.sum((R[i] - V) ** 2) / len(i)
            figure = {"L_O": L_O, "L_C": L_C, "V_mean": V.mean(), "V_max": V.max(), "KL": D_KL,
                      "mean_action_own": now.mean[of_agent].abs().mean()}  # fmt: skip
            L_A = L_O
            if demos:
                j = demo_batches[k]
                a_hat = self.pi(s_d[j]).mean
                M = (self.V(s_d[j]) < r_d[j]) if self.mask else torch.ones(len(j), dtype=torch.bool)
                L_BC = torch.sum((a_d[j][M] - a_hat[M]) ** 2) / (4 * len(j))
                L_A = f.lambda_bc * L_BC + L_O
                figure |= {"L_BC": L_BC, "mask_fraction": M.float().mean(), "mean_action_demo": a_hat.abs().mean()}
                figure["bc_relative_error"] = torch.mean((a_hat - a_d[j]) ** 2) / torch.mean(a_d[j] ** 2)
            figure["L_A"] = L_A
            for adam, L, parameters in ((self.adam_pi, L_A, self.omega), (self.adam_v, L_C, self.nu)):
                for p, g in zip(parameters, torch.autograd.grad(L, parameters, allow_unused=True), strict=True):
                    p.grad = g
                adam.step()
            figure["sigma"] = torch.exp(self.log_std).mean()
            for name, value in figure.items():
                figures.setdefault(name, []).append(value.item())
            updates += 1
        return {name: np.mean(values) for name, values in figures.items()}, updates


@pytest.fixture
def draws(monkeypatch):
    """Every (high, indices) that torch.randint draws."""
    drawn, randint = [], torch.randint
    monkeypatch.setattr(torch, "randint", lambda *args, **kwargs: drawn.append((args[0], randint(*args, **kwargs)))
                        or drawn[-1][1])  # fmt: skip
    return drawn


SETTINGS = dict(hidden_sizes=(24, 40, 16), gamma=0.9, lam=0.8, clip_ratio=0.1, lambda_bc=1.3, pi_lr=1.5e-2, vf_lr=7e-3,
                train_iters=6, batch_size=40, demo_batch_size=30, log_std=-0.7, symmetry="none")  # fmt: skip


@pytest.mark.parametrize("task, mask, target_kl, with_demos", [
    ("p2p", "reward", NEVER, True), ("p2p", "reward", 0.025, False), ("p2p", "reward", 0.025, True),
    ("pnp", "none", NEVER, True),
], ids=["as published", "no demonstrations, a KL limit", "a KL limit", "the cube's input, no mask"])  # fmt: skip
def test_an_epoch_is_that_of_a_plain_reimplementation_of_the_paper(task, mask, target_kl, with_demos, draws):
    torch.manual_seed(1)
    obs_dim = {"p2p": 22, "pnp": 25}[task]
    learner = ppo.Learner(resolve(task=task, mask=mask, target_kl=target_kl, grasp_input=task == "pnp", **SETTINGS))
    with torch.no_grad():
        learner.net.v_net[-1].weight.mul_(60)  # values on both sides of the rewards
    paper = Paper(learner, mask == "reward")
    found = [*trajectories(["true", "timeout"], obs_dim, 3, own=0), *trajectories(ENDS, obs_dim, 4)]
    demos = trajectories(["true", "true", "timeout", "true", "timeout", "true"], obs_dim, 7, own=0)
    for x in found + demos if task == "pnp" else ():  # in half of the states the cube is grasped
        for s in (x.s, x.s2):
            s[::2, 22:] = s[::2, 16:19] - s[::2, 19:22]
    B_o, B_d = buffer_of(found), buffer_of(demos) if with_demos else empty_buffer()
    counts = []
    for _ in range(2):  # the second goes on with the optimisers of the first
        draws.clear()
        measured = learner.updates(B_o, B_d)
        batches, demo_batches = ([i for high, i in draws if high == B.filled] for B in (B_o, B_d))
        assert {len(i) for i in batches} == {40} and {len(i) for i in demo_batches} == ({30} if with_demos else set())
        expected, updates = paper.epoch(found, demos if with_demos else None, batches, demo_batches)
        counts.append(updates)
        for name, value in expected.items():
            assert measured.pop(name) == pytest.approx(value, rel=1e-4, abs=1e-5), name
        assert all(math.isnan(value) for value in measured.values())  # what needs B_d, without it
        if with_demos:
            M = expected["mask_fraction"]
            assert M == 1 if mask == "none" else 0.05 < M < 0.95
        for net, copy in ((learner.net.mu_net, paper.mu), (learner.net.v_net, paper.v)):
            for p, q in zip(net.parameters(), copy.parameters(), strict=True):
                torch.testing.assert_close(p.detach(), q.detach(), rtol=0, atol=1e-4)
        torch.testing.assert_close(learner.net.log_std.detach(), paper.log_std.detach(), rtol=0, atol=1e-4)
    assert counts == [6, 6] if target_kl == NEVER else 0 < min(counts) < 6


def a_learner(found=None, **changes):
    """(Learner, B_o of the trajectories) with small networks."""
    found = trajectories(ENDS) if found is None else found
    torch.manual_seed(0)
    settings = dict(hidden_sizes=(16, 16), batch_size=30, demo_batch_size=20, lambda_bc=1.0, symmetry="none")
    flags = resolve(**settings | changes)
    return ppo.Learner(flags), buffer_of(found, flags.symmetry)


@pytest.mark.parametrize("how", ["true", "timeout", "cut"])
def test_only_a_true_end_stops_bootstrapping(how):
    x = trajectories([how])[0]
    for name in ("s", "a", "r", "s2", "zeta", "end", "own"):
        setattr(x, name, getattr(x, name)[-1:])
    learner, B_o = a_learner([x], gamma=0.5, train_iters=1)
    with torch.no_grad():
        V, V2 = learner.net.V(x.s).item(), learner.net.V(x.s2).item()
    measured, y = learner.updates(B_o, empty_buffer()), x.r.item() + (how != "true") * 0.5 * V2
    assert abs(V2) > 1e-2 and measured["L_C"] == pytest.approx((y - V) ** 2, rel=1e-4)


# ---- the KL limit ----------------------------------------------------------------------------------------------------


def weights_of(learner):
    return {name: w.clone() for name, w in learner.net.state_dict().items()}


def moved(learner, before):
    """The parts of the networks that moved."""
    return {name.split(".")[0] for name, w in weights_of(learner).items() if not torch.equal(w, before[name])}


@pytest.mark.parametrize("with_demos", [True, False])
def test_past_the_kl_limit_everything_rests(with_demos):
    B_d = buffer_of(trajectories(ENDS, seed=8, own=0)) if with_demos else empty_buffer()
    learner, B_o = a_learner(mask="none", target_kl=0.0, train_iters=5)  # met before the first
    before = weights_of(learner)
    assert learner.updates(B_o, B_d) is None and not moved(learner, before)
    learner, B_o = a_learner(target_kl=NEVER, train_iters=5)
    learner.updates(B_o, B_d)
    assert moved(learner, before) == {"mu_net", "log_std", "v_net"}


def test_the_demonstrators_samples_alone_never_stop_an_epoch(draws):
    learner, B_o = a_learner(trajectories(ENDS, own=0), target_kl=1e-9, train_iters=5)
    draws.clear()
    measured = learner.updates(B_o, empty_buffer())
    assert len(draws) == 5 and math.isnan(measured["KL"])


# ---- losses ----------------------------------------------------------------------------------------------------------


def test_the_policy_loss_clips_only_what_would_move_the_ratio_further():
    ratio = torch.tensor([1.5, 0.5, 1.5, 0.5, 1.1, 0.9], requires_grad=True)
    A = torch.tensor([1.0, 1.0, -1.0, -1.0, 2.0, -2.0])
    L = ppo.loss_O(ratio, A, 0.2)
    assert L.item() == pytest.approx(-(1.2 + 0.5 - 1.5 - 0.8 + 2.2 - 1.8) / 6)
    assert torch.autograd.grad(L, ratio)[0].tolist() == pytest.approx([x / -6 for x in (0, 1, -1, 0, 2, -2)])


def test_the_mask_picks_the_rows_whose_state_is_worth_less_than_the_threshold():
    V, threshold = torch.tensor([0.5, 2.0, -2.0, -2.0, 1e-6]), torch.tensor([1.0, 2.0, -1.0, -3.0, 0.0])
    assert ppo.mask(V, threshold).tolist() == [1, 0, 1, 0, 0]  # Eq. 9: <, so not where they are equal


# ---- before the first step -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("task, grasp_input", [("p2p", False), ("pnp", True)])
def test_the_saved_policy_is_the_mean_action_clipped(task, grasp_input):
    torch.manual_seed(0)
    s = torch.from_numpy(states(200, ppo.OBS_DIM[task]))
    if grasp_input:  # in half of the states the cube is grasped
        s[::2, 22:] = s[::2, 16:19] - s[::2, 19:22]
    learner = ppo.Learner(resolve(task=task, grasp_input=grasp_input, hidden_sizes=(16, 16)))
    policy = evaluate.Policy(learner.policy())
    with torch.no_grad():
        acting = learner.net.mu(s).clamp(-1, 1)
    torch.testing.assert_close(torch.from_numpy(policy(s.numpy())), acting, rtol=0, atol=1e-5)


def test_cloning_first_fits_the_actor_and_the_critic_to_the_demonstrations(draws):
    """As a plain reimplementation does: Adam at vf_lr for both, falling by a cosine to 0, no mask."""
    demos = trajectories(ENDS, seed=8, own=0)
    s, a, R = flat(demos, "s"), flat(demos, "a"), rewards_to_go(demos)
    learner, _ = a_learner(pi_lr=0.0, vf_lr=5e-3, clone_iters=7, mask="reward", lambda_bc=9.0, gamma=0.9)
    paper, before = Paper(learner), weights_of(learner)
    draws.clear()
    learner.clone(buffer_of(demos))
    assert [(high, len(i)) for high, i in draws] == [(len(s), 20)] * 7
    adam = torch.optim.Adam([*paper.mu.parameters(), *paper.nu])
    for k, (_, i) in enumerate(draws):
        adam.param_groups[0]["lr"] = 5e-3 * (1 + math.cos(math.pi * k / 7)) / 2
        loss = torch.mean((paper.mu(s[i]) - a[i]) ** 2) + torch.mean((paper.v(s[i])[:, 0] - R[i]) ** 2)
        adam.zero_grad()
        loss.backward()
        adam.step()
    assert moved(learner, before) == {"mu_net", "v_net"}
    for net, copy in ((learner.net.mu_net, paper.mu), (learner.net.v_net, paper.v)):
        for p, q in zip(net.parameters(), copy.parameters(), strict=True):
            torch.testing.assert_close(p.detach(), q.detach(), rtol=0, atol=2e-5)
    assert not learner.optimizer.state  # the epochs start with fresh moments


def test_the_input_for_the_cube_is_one_exactly_while_the_environment_says_that_it_is_grasped():
    env = gymnasium.make("KinovaPnP-v0", stage="demo", disable_env_checker=True)
    pid, seen, net = pid_demo.PID(env, "fast"), set(), ppo.ActorCritic(25, (8,), -0.5, True)
    (s, info), ended = env.reset(seed=0), False
    while not ended:
        for view in (s, gas.canonical(s), gas.rotate(s, 1.234)):
            x = net.inputs(torch.from_numpy(view))
            assert x.shape == (26,) and x[-1] == info["grasped"]
        seen.add(info["grasped"])
        s, _, terminated, truncated, info = env.step(pid.act())
        ended = terminated or truncated
    assert seen == {True, False}
    env.close()


# ---- symmetry --------------------------------------------------------------------------------------------------------


def test_mirror_reflects_every_other_demonstrated_step_of_a_batch():
    learner, _ = a_learner(symmetry="mirror")
    B_d = buffer_of(trajectories(ENDS, seed=8, own=0), "mirror")
    i, s, a, r = learner.demo_batch(B_d)
    stored_s, stored_a, stored_r, *_ = B_d.columns(i)
    other_s, other_a = gas.mirror(stored_s, stored_a)
    for found, stored, other in ((s, stored_s, other_s), (a, stored_a, other_a)):
        assert torch.equal(found[::2], other[::2]) and torch.equal(found[1::2], stored[1::2])
        assert not torch.equal(stored, other)
    assert torch.equal(r, stored_r)


def test_so2_turns_each_trajectory_by_one_angle_and_each_demonstrated_step_by_its_own(monkeypatch):
    seen, columns = [], ppo.TrajectoryBuffer.columns
    monkeypatch.setattr(ppo.TrajectoryBuffer, "columns", lambda self, i=None, angle=None: seen.append(
                        (i, angle)) or columns(self, i, angle))  # fmt: skip
    found, demos = trajectories(ENDS), trajectories(ENDS, seed=8, own=0)
    lengths = torch.tensor([len(x.r) for x in found])
    learner, B_o = a_learner(found, symmetry="so2", train_iters=1)
    learner.updates(B_o, buffer_of(demos))
    (_, angle), (i, of_demo) = [(i, angle) for i, angle in seen if angle is not None]
    first = torch.cumsum(lengths, 0) - lengths
    assert torch.equal(angle, torch.repeat_interleave(angle[first], lengths)) and len(angle.unique()) == len(ENDS)
    assert len(of_demo.unique()) == len(i) == 20
    for angles in (angle, of_demo):
        assert angles.min() >= 0 and 3 < angles.max() < 2 * math.pi  # all round
    s, a, r, s2, *_ = columns(B_o, None, angle)
    assert torch.equal(s, gas.rotate(flat(found, "s"), angle)) and torch.equal(s2, gas.rotate(flat(found, "s2"), angle))
    assert torch.equal(a, flat(found, "a")) and torch.equal(r, flat(found, "r"))
    for symmetry in ("none", "gas", "canonical"):
        seen.clear()
        learner, B_o = a_learner(found, symmetry=symmetry, train_iters=1)
        learner.updates(B_o, buffer_of(demos))
        assert all(angle is None for _, angle in seen)


# ---- what an epoch learns from ---------------------------------------------------------------------------------------


@pytest.fixture
def epochs(monkeypatch):
    """The rows of B_o and B_d and the weights that each epoch's updates begin with."""
    found, updates = [], ppo.Learner.updates
    monkeypatch.setattr(ppo.Learner, "updates", lambda self, B_o, B_d: found.append(SimpleNamespace(
                        B_o=B_o.rows[: B_o.filled].clone(), B_d=B_d.rows[: B_d.filled].clone(),
                        weights=weights_of(self))) or updates(self, B_o, B_d))  # fmt: skip
    return found


def transitions(steps, view=lambda s: s):
    """The rows that B_o holds of an epoch of these steps."""
    rows = [np.concatenate([view(x.s), x.a, [x.r], view(x.s2), [x.terminated, bool(x.end), 1]]) for x in steps]
    rows[-1][-2] = 1  # the cut
    return torch.from_numpy(np.stack(rows).astype(np.float32))


def demo_rows():
    """The rows of B_d."""
    demos, end = demo_arrays(), np.append(np.diff(demo_arrays()["episode"]), 1)
    columns = (demos[name] for name in ("obs", "act", "rew", "obs2", "terminated"))
    rows = [[*s, *a, r, *s2, zeta, last, 0] for s, a, r, s2, zeta, last in zip(*columns, end, strict=True)]
    return torch.from_numpy(np.array(rows).astype(np.float32))


@pytest.mark.parametrize("symmetry", ["none", "so2", "canonical", "mirror"])
def test_an_epoch_learns_from_its_own_steps_in_order_and_a_timeout_or_a_cut_is_no_true_end(symmetry, world, epochs):
    run, view = world("a", symmetry=symmetry), lambda s: gas.seen(s, symmetry)
    assert len(run.steps) == 120 and len(epochs) == 3
    for n, epoch in enumerate(epochs):
        assert torch.equal(epoch.B_o, transitions(run.steps[40 * n : 40 * (n + 1)], view)) and len(epoch.B_d) == 0
    rows = torch.cat([epoch.B_o for epoch in epochs])
    of_end = {end: {tuple(rows[t, -3:-1].tolist()) for t, x in enumerate(run.steps) if x.end == end and t % 40 != 39}
              for end in ("", "timeout", "success", "self")}  # fmt: skip
    assert of_end == {"": {(0, 0)}, "timeout": {(0, 1)}, "success": {(1, 1)}, "self": {(1, 1)}}
    assert [0, 1] in rows[39::40, -3:-1].tolist()  # an epoch that ends amid an episode


def test_the_real_environments_timeouts_end_a_trajectory_and_bootstrap(tmp_path, epochs):
    flags = TINY[ppo] | dict(max_ep_len=15, epochs=1, steps_per_epoch=70, data_dir=str(tmp_path))
    rows = rows_of(ppo.train(ppo.Flags(**flags)) / "episodes.csv")
    true_ends = [int(row["env_steps"]) for row in rows if row["success"] == "1" or row["collision"]]
    assert len(true_ends) < len(rows) >= 4  # most of them time out
    assert (1 + epochs[0].B_o[:, -3].nonzero().flatten()).tolist() == true_ends
    assert (1 + epochs[0].B_o[:, -2].nonzero().flatten()).tolist() == [*(int(row["env_steps"]) for row in rows), 70]


def test_actions_are_drawn_from_the_policy_and_neither_clipped_nor_squashed(world):
    run = world("a", pi_lr=0.0, log_std=0.3, epochs=12)  # never updated: the one that acted
    net = evaluate.load_policy(run.folder).net
    with torch.no_grad():
        mu = net(torch.from_numpy(np.stack([x.s for x in run.steps]))).numpy()
    a = np.stack([x.a for x in run.steps])
    z = (a - mu) / math.exp(0.3)
    assert abs(z.mean()) < 0.1 and 0.93 < z.std() < 1.07 and 0.63 < np.mean(np.abs(z) < 1) < 0.74  # normal: 0.68
    assert np.mean(np.abs(a) > 1) > 0.2 and np.abs(np.corrcoef(z.T) - np.eye(4)).max() < 0.2


LENGTHS = np.cumsum([length for _, length in DEMO_ENDS]).tolist()  # rows of the first 1, 2, 3, 4 demonstrations
DEMONSTRATED = dict(num_demos=4, symmetry="none", recorded=demo_arrays())


@pytest.mark.parametrize("flags, filled", [
    (dict(recipe="paper"), LENGTHS + LENGTHS[-1:]),
    (dict(recipe="paper", demos_in_B_o=False), LENGTHS + LENGTHS[-1:]),
    (dict(recipe="paper", demos_per_epoch=3), LENGTHS[2:] + 3 * LENGTHS[-1:]),
    (dict(recipe="robust", clone_iters=2, demo_noise=0.0, demos_in_B_o=True), 5 * LENGTHS[-1:]),
], ids=["a fifth of them, at least one", "not into B_o", "three", "all at once"])  # fmt: skip
def test_demonstrations_open_the_early_epochs_until_B_d_is_full(flags, filled, world, epochs):
    run, rows = world("a", epochs=5, **DEMONSTRATED | flags), demo_rows()
    for n, (epoch, now) in enumerate(zip(epochs, filled, strict=True)):
        opened = rows[[0, *filled][n] : now] if flags.get("demos_in_B_o", True) else rows[:0]
        assert torch.equal(epoch.B_d, rows[:now])
        assert torch.equal(epoch.B_o, torch.cat((opened, transitions(run.steps[40 * n : 40 * (n + 1)]))))


def test_cloning_comes_before_the_first_step_from_the_first_B_d(world, epochs, monkeypatch):
    seen, clone = [], ppo.Learner.clone
    monkeypatch.setattr(ppo.Learner, "clone", lambda self, B_d, *rest: seen.append(B_d.filled) or clone(self, B_d))
    plain = world("plain", epochs=1, demos_per_epoch=2, **DEMONSTRATED)
    run = world("a", epochs=1, demos_per_epoch=2, clone_iters=3, **DEMONSTRATED)
    assert seen == [LENGTHS[1]] and not np.array_equal(run.steps[0].a, plain.steps[0].a)


# ---- defaults --------------------------------------------------------------------------------------------------------

DEFAULTS = {  # Table 2 (pnp), Table 1 (the others), Sec. 4.2; N and lambda are the largest of Tables 3, 4 and 5
    "p2p": dict(max_ep_len=400, num_demos=100, lambda_bc=1.8, hidden_sizes=(128, 512, 128), demos_per_epoch=20),
    "p2po": dict(max_ep_len=500, num_demos=250, lambda_bc=2, hidden_sizes=(256, 1024, 256), demos_per_epoch=50),
    "pnp": dict(max_ep_len=800, num_demos=400, lambda_bc=15, hidden_sizes=(512, 512, 256), demos_per_epoch=80),
}
AS_PUBLISHED = dict(
    recipe="paper",
    epochs=50,
    steps_per_epoch=4000,
    train_iters=20,
    batch_size=800,
    gamma=0.99,
    demo_batch_size=100,
    lam=0.97,
    clip_ratio=0.2,
    target_kl=0.02,
    symmetry="gas",
    partitions=4,
    mask="reward",
    demos_in_B_o=True,
    clone_iters=0,
    pi_lr=3e-4,
    vf_lr=1e-3,
    log_std=-0.5,
)  # fmt: skip - the last three: spinningup


ROBUST = dict(symmetry="mirror", gains="fast", demo_noise=0.2, clone_iters=10_000, demos_in_B_o=False, log_std=-2,
              pi_lr=3e-6, vf_lr=1e-3, epochs=50, steps_per_epoch=4000, train_iters=20, mask="reward")  # fmt: skip


@pytest.mark.parametrize("task", DEFAULTS)
def test_the_recipe_robust_is_that_of_the_readme(task):
    flags = vars(resolve(task=task, recipe="robust"))
    expected = ROBUST | dict(demos_per_epoch=DEFAULTS[task]["num_demos"], grasp_input=task == "pnp")
    assert {name: flags[name] for name in expected} == expected


@pytest.mark.parametrize("task", DEFAULTS)
def test_the_defaults_are_those_of_table_2(task):
    flags = vars(resolve(task=task))
    expected = DEFAULTS[task] | AS_PUBLISHED
    assert {name: flags[name] for name in expected} == expected and ppo.Flags().task == "pnp"


def test_demonstrations_an_epoch_are_a_fifth_of_those_asked_for_rounded_up_and_at_least_one():
    for num_demos, per_epoch in ((7, 2), (5, 1), (1, 1), (0, 1)):
        assert resolve(num_demos=num_demos).demos_per_epoch == per_epoch
    assert resolve(num_demos=7, recipe="robust").demos_per_epoch == 7


# ---- bad input -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("flags, says", [
    (dict(grasp_input=True), "--grasp_input: --task p2p has nothing to grasp; allowed on --task pnp"),
    (dict(demo_noise=0.1, demos_in_B_o=True, num_demos=4), "--demos_in_B_o"),
    (dict(clone_iters=5), "--clone_iters: is of demonstrations, and --num_demos 0 has none"),
    (dict(num_demos=4, recorded=demo_arrays() | dict(executed=None)), "--no-demos_in_B_o"),
], ids=["no cube", "noisy demonstrations in B_o", "none to clone", "a file of them in B_o"])  # fmt: skip
def test_flags_that_do_not_go_together_are_bad_input(flags, says, tmp_path):
    run = scripted_run(ppo, tmp_path, "a", **flags)
    assert isinstance(run.error, logx.BadInput) and says in str(run.error) and not run.folder.exists()
