"""ppo_demoease.py against the paper: its sums and updates against plain reimplementations, and what the loop does."""

import io
import json
import math
import signal
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
import torch
from test_ddpg_demoease import (  # the scripted world of the sibling
    DEMO_ENDS,
    Scripted,
    as_main_does,  # noqa: F401 - a fixture of every test
    curves,
    demo_arrays,
    demo_file,
    rows_of,
    states,
)
from torch import nn
from torch.distributions import Normal, kl_divergence

import evaluate
import gas
import logx
import pid_demo
import ppo_demoease as ppo

TINY = dict(task="p2p", hidden_sizes=(16, 16), epochs=3, steps_per_epoch=40, max_ep_len=40, num_demos=0, lambda_bc=0.0,
            seed=3, train_iters=4, batch_size=16, demo_batch_size=8, eval_every=0, checkpoint_every=1,
            quiet=True)  # fmt: skip
NEVER = 1e9  # a KL limit that is never reached


def complete(**changes):
    return ppo.complete(ppo.Flags(**changes))[0]


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


ENDS = ["true", "timeout", "cut", "true", "true", "timeout", "timeout", "cut"]


def flat(found, name):
    return torch.cat([getattr(trajectory, name) for trajectory in found])


def buffer_of(found):
    buffer = ppo.TrajectoryBuffer(found[0].s.shape[1], sum(len(trajectory.r) for trajectory in found))
    for x in found:
        for row in zip(*(getattr(x, name) for name in ("s", "a", "r", "s2", "zeta", "end", "own")), strict=True):
            s, a, r, s2, *flags = (value.numpy() for value in row)
            buffer.store(s, a, float(r), s2, *(int(x) for x in flags))
    return buffer


def sums(trajectory, V, V_last, gamma, lam):
    """(R^_t, A^_t before normalisation) of one trajectory by the sums of ag:d-ease-on, term by term; V_last: what
    follows its last step, 0 after a true end."""
    r, V, T = trajectory.r.tolist(), [*V.tolist(), float(V_last)], len(trajectory.r)
    R = [sum(gamma ** (k - t) * r[k] for k in range(t, T)) + gamma ** (T - t) * V[T] for t in range(T)]
    delta = [r[k] + gamma * V[k + 1] - V[k] for k in range(T)]
    A = [sum((gamma * lam) ** (k - t) * delta[k] for k in range(t, T)) for t in range(T)]
    return R, A


def of_random_values(found, seed=5):
    """(V, last_V) as epoch() makes them of random values."""
    generator = torch.Generator().manual_seed(seed)
    V, last_V = (3 * torch.randn(len(flat(found, "r")), generator=generator) for _ in range(2))
    return V, last_V * flat(found, "end") * (1 - flat(found, "zeta"))


@pytest.mark.parametrize("gamma, lam", [(0.9, 0.8), (0.99, 0.97), (1.0, 1.0), (0.9, 0.0), (0.0, 0.9)])
def test_rewards_to_go_and_advantages_are_the_papers_sums(gamma, lam):
    found = trajectories(ENDS)
    r, end, (V, last_V) = flat(found, "r"), flat(found, "end"), of_random_values(found)
    R, A, begin = [], [], 0
    for x in found:
        mine = slice(begin, begin := begin + len(x.r))
        for all_of_them, one in zip((R, A), sums(x, V[mine], last_V[mine][-1], gamma, lam), strict=True):
            all_of_them.extend(one)
    torch.testing.assert_close(ppo.rewards_to_go(r, end, last_V, gamma), torch.tensor(R), rtol=1e-4, atol=1e-5)
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
    R, A = ppo.rewards_to_go(r, end, last_V, 0.9), ppo.advantages(r, end, V, last_V, 0.9, 0.8)
    r2, V2, last_V2 = (torch.where(after, x + torch.randn(len(x)), x) for x in (r, V, last_V))
    R2, A2 = ppo.rewards_to_go(r2, end, last_V2, 0.9), ppo.advantages(r2, end, V2, last_V2, 0.9, 0.8)
    assert torch.equal(R[:n], R2[:n]) and not torch.isclose(R[n:], R2[n:]).any()
    torch.testing.assert_close(shape(A), shape(A2), rtol=1e-3, atol=1e-4)
    assert not torch.isclose(A[n:], A2[n:]).any()


def test_advantages_have_mean_zero_and_deviation_one_and_equal_ones_are_zero():
    found = trajectories(ENDS)
    A = ppo.advantages(flat(found, "r"), flat(found, "end"), *of_random_values(found), 0.99, 0.97)
    assert abs(A.mean()) < 1e-6 and A.std(correction=0).item() == pytest.approx(1, rel=1e-5)
    zero = torch.zeros(5)
    assert ppo.advantages(zero, torch.ones(5), zero, zero, 0.99, 0.97).tolist() == [0] * 5


# ---- the input of the networks ---------------------------------------------------------------------------------------


def test_grasp_input_is_one_exactly_while_the_environment_says_that_the_cube_is_grasped():
    env = gymnasium.make("KinovaPnP-v0", stage="demo", disable_env_checker=True)
    pid, seen = pid_demo.PID(env, "fast"), set()
    net = ppo.ActorCritic(25, (8,), -0.5, True, "cpu")
    for seed in range(3):
        s, info = env.reset(seed=seed)
        done = False
        while not done:
            for view in (s, gas.canonical(s), gas.rotate(s, 1.234)):
                x = net.inputs(torch.from_numpy(view))
                assert x.shape == (26,) and x[-1] == info["grasped"]
            seen.add(info["grasped"])
            s, _, terminated, truncated, info = env.step(pid.act())
            done = terminated or truncated
    assert seen == {True, False}
    env.close()


# ---- the update against the paper ------------------------------------------------------------------------------------


class Paper:
    """An epoch of ag:d-ease-on with eq:loss_actor, eq:bc_gain and eq:mask_v, in plain autograd, torch.distributions and
    two torch.optim.Adam. Shares nothing with the source but the weights it starts from.

    compare: what eq:mask_v compares V(s) with ("reward", "return"; None: M = 1). go_on: what does beyond the KL limit
    (nothing, "critic", "all": cloning too). clip: the range of values.
    """

    def __init__(self, learner, compare="reward", go_on="", clip=None, *, gamma, lam, clip_ratio, target_kl,
                 lambda_bc, pi_lr, vf_lr, train_iters, **sizes):  # fmt: skip
        self.compare, self.go_on, self.clip, self.gamma, self.lam = compare, go_on, clip, gamma, lam
        self.epsilon, self.target_kl, self.lambda_bc, self.train_iters = clip_ratio, target_kl, lambda_bc, train_iters
        self.mean, self.std = learner.net.s_mean.clone(), learner.net.s_std.clone()

        def copy_of(source):
            n, layers = [p.shape for p in source.parameters()][::2], []
            for n_out, n_in in n:
                layers += [nn.Linear(n_in, n_out), nn.ReLU()]
            net = nn.Sequential(*layers[:-1])
            net.load_state_dict({name: w.clone() for name, w in source.state_dict().items()})  # strict
            return net

        self.mu, self.v = copy_of(learner.net.mu_net), copy_of(learner.net.v_net)
        self.log_std = learner.net.log_std.detach().clone().requires_grad_()
        self.omega, self.nu = [*self.mu.parameters(), self.log_std], list(self.v.parameters())
        self.adam_pi, self.adam_v = torch.optim.Adam(self.omega, lr=pi_lr), torch.optim.Adam(self.nu, lr=vf_lr)

    def inputs(self, s):
        x = [(s - self.mean) / self.std]
        if self.mu[0].in_features == 26:  # the 26th says whether the cube is where the TCP is
            P_e = s[:, 16:19] - s[:, 19:22]
            x.append(torch.tensor([[float(torch.dist(a, b) < 1e-3)] for a, b in zip(P_e, s[:, 22:], strict=True)]))
        return torch.cat(x, 1)

    def pi(self, s):
        return Normal(self.mu(self.inputs(s)), torch.exp(self.log_std))

    def V(self, s, clip=True):
        V = self.v(self.inputs(s))[:, 0]
        return torch.clip(V, *self.clip) if clip and self.clip else V

    def epoch(self, found, demos, batches, demo_batches):
        """found, demos: the trajectories of B_o and of B_d (or None). batches, demo_batches: rows of them, for each
        update. Returns (the mean of each figure, updates, updates with L_O)."""
        s, a, own = flat(found, "s"), flat(found, "a"), flat(found, "own")
        with torch.no_grad():
            old = self.pi(s)
            log_prob_old = old.log_prob(a).sum(1)
            R, A = [], []
            for x in found:
                V_last = 0.0 if x.how == "true" else self.V(x.s2[-1:]).item()
                for all_of_them, one in zip((R, A), sums(x, self.V(x.s), V_last, self.gamma, self.lam), strict=True):
                    all_of_them.extend(one)
        R, A = torch.tensor(R), torch.tensor((np.array(A) - np.mean(A)) / np.std(A), dtype=torch.float32)
        if demos:
            s_d, a_d, r_d = (flat(demos, name) for name in ("s", "a", "r"))
            R_d = torch.tensor([R for x in demos for R in sums(x, torch.zeros(len(x.r)), 0.0, self.gamma, 1)[0]])
        learn_O, updates, with_L_O, figures = True, 0, 0, {}
        for k in range(self.train_iters):
            i = batches[k]
            now, mine = self.pi(s[i]), own[i] == 1
            D_KL = kl_divergence(Normal(old.mean[i], old.stddev[i]), now).sum(1)[mine].mean().item()
            if self.target_kl <= D_KL:
                learn_O = False
            if not learn_O and not self.go_on:
                break
            L_A, figure = 0.0, {}
            if learn_O:
                ratio, with_L_O = torch.exp(now.log_prob(a[i]).sum(1) - log_prob_old[i]), with_L_O + 1
                clipped = torch.clip(ratio, 1 - self.epsilon, 1 + self.epsilon)
                L_A = figure["L_O"] = -torch.sum(torch.minimum(ratio * A[i], clipped * A[i])) / len(i)
            L_C = torch.sum((R[i] - self.V(s[i], clip=False)) ** 2) / len(i)
            if demos:
                j = demo_batches[k]
                a_hat = self.pi(s_d[j]).mean
                threshold = {"reward": r_d[j], "return": R_d[j], None: torch.full((len(j),), math.inf)}[self.compare]
                M = self.V(s_d[j]) < threshold
                L_BC = torch.sum((a_d[j][M] - a_hat[M]) ** 2) / (4 * len(j))
                L_A = self.lambda_bc * L_BC + L_A
                figure |= {"L_BC": L_BC, "mask_fraction": M.float().mean(), "pretanh_demo": a_hat.abs().mean()}
                figure["bc_relative_error"] = torch.mean((a_hat - a_d[j]) ** 2) / torch.mean(a_d[j] ** 2)
            V = self.V(s[i], clip=False)
            figure |= {"L_C": L_C, "Q_mean": V.mean(), "Q_max": V.max()}
            if torch.is_tensor(L_A) and (learn_O or self.go_on == "all"):
                figure["L_A"] = L_A
            if mine.any():
                figure["pretanh_own"] = now.mean[mine].abs().mean()
            for name, value in figure.items():
                figures.setdefault(name, []).append(float(torch.as_tensor(value).detach()))
            for adam, L, parameters in ((self.adam_pi, L_A, self.omega), (self.adam_v, L_C, self.nu)):
                learns = torch.is_tensor(L) and (learn_O or adam is self.adam_v or self.go_on == "all")
                gradients = torch.autograd.grad(L, parameters, allow_unused=True) if learns else None
                for p, g in zip(parameters, gradients or [None] * len(parameters), strict=True):
                    p.grad = g
                adam.step()
            updates += 1
        return {name: np.mean(values) for name, values in figures.items()}, updates, with_L_O


@pytest.fixture
def draws(monkeypatch):
    """Every (high, indices) that torch.randint draws."""
    drawn, randint = [], torch.randint

    def recorded(*args, **kwargs):
        drawn.append((args[0], randint(*args, **kwargs)))
        return drawn[-1][1]

    monkeypatch.setattr(torch, "randint", recorded)
    return drawn


SETTINGS = dict(hidden_sizes=(24, 40, 16), gamma=0.9, lam=0.8, clip_ratio=0.1, lambda_bc=1.3, pi_lr=1.5e-2, vf_lr=7e-3,
                target_kl=NEVER, train_iters=6, batch_size=40, demo_batch_size=30)  # fmt: skip
CLIP = {"p2p": (-4, 10), "pnp": (-4, 12)}
PARTS = {  # flags of the source, and the same in the reimplementation
    "paper": (dict(recipe="paper"), dict()),
    "return mask": (dict(mask="return"), dict(compare="return")),
    "no mask": (dict(mask="none"), dict(compare=None)),
    "clip": (dict(clip_value=True), dict(clip=True)),
    "critic goes on": (dict(after_kl="critic"), dict(go_on="critic")),
    "all goes on": (dict(after_kl="all"), dict(go_on="all")),
    "robust": (dict(recipe="robust"), dict(compare=None, go_on="critic", clip=True)),
}


@pytest.mark.parametrize("task, part, target_kl, with_demos", [
    *(("p2p", part, NEVER, True) for part in PARTS), ("p2p", "paper", NEVER, False), ("p2p", "robust", NEVER, False),
    *(("p2p", part, 0.025, with_demos) for part in ("paper", "critic goes on", "all goes on")
      for with_demos in (True, False)),
    ("pnp", "paper", NEVER, True), ("pnp", "robust", 0.025, True),
], ids=lambda x: ("with B_d" if x else "without B_d") if isinstance(x, bool) else x)  # fmt: skip
def test_an_epoch_is_that_of_a_plain_reimplementation_of_the_paper(task, part, target_kl, with_demos, draws):
    torch.manual_seed(1)
    theirs, mine = PARTS[part]
    if "clip" in mine:
        mine = mine | dict(clip=CLIP[task])
    settings, obs_dim = SETTINGS | dict(target_kl=target_kl), {"p2p": 22, "pnp": 25}[task]
    learner = ppo.Learner(complete(task=task, log_std=-0.7, **settings, **theirs), obs_dim)
    with torch.no_grad():
        learner.net.v_net[-1].weight.mul_(60)  # values on both sides of the rewards, and beyond the clip
        learner.net.s_mean.uniform_(-0.3, 0.3)
        learner.net.s_std.uniform_(0.6, 1.5)
    paper = Paper(learner, **mine, **settings)
    found = [*trajectories(["true", "timeout"], obs_dim, 3, own=0), *trajectories(ENDS, obs_dim, 4)]
    demos = trajectories(["true", "true", "timeout", "true", "timeout", "true"], obs_dim, 7, own=0)
    for x in found + demos:
        if task == "pnp":  # in half of the states the cube is grasped
            for s in (x.s, x.s2):
                s[::2, 22:] = s[::2, 16:19] - s[::2, 19:22]
    R_demo = [R for x in demos for R in sums(x, torch.zeros(len(x.r)), 0.0, 0.9, 1)[0]]
    B_o, B_d = buffer_of(found), buffer_of(demos)
    counts = []
    assert B_o.filled > 40 and B_d.filled > 30 and B_o.filled != B_d.filled
    for _ in range(2):  # the second goes on with the optimisers of the first
        draws.clear()
        measured = learner.epoch(B_o, B_d if with_demos else None, torch.tensor(R_demo))
        batches, demo_batches = ([i for high, i in draws if high == B.filled] for B in (B_o, B_d))
        assert {len(i) for i in batches} == {40} and {len(i) for i in demo_batches} == ({30} if with_demos else set())
        expected, updates, with_L_O = paper.epoch(found, demos if with_demos else None, batches, demo_batches)
        assert measured.pop("updates") == updates == (6 if mine.get("go_on") else with_L_O)
        counts.append(with_L_O)
        for name in ("KL", "sigma", "learn_O"):
            measured.pop(name)
        for name, value in expected.items():
            assert measured.pop(name) == pytest.approx(value, rel=1e-4, abs=1e-5), name
        assert all(math.isnan(value) for value in measured.values())  # what needs B_d, without it
        if with_demos:
            assert expected["mask_fraction"] == 1 if mine.get("compare", 0) is None else measured_mask(expected) > 0.05
        for net, copy in ((learner.net.mu_net, paper.mu), (learner.net.v_net, paper.v)):
            for p, q in zip(net.parameters(), copy.parameters(), strict=True):
                torch.testing.assert_close(p.detach(), q.detach(), rtol=0, atol=1e-4)
        torch.testing.assert_close(learner.net.log_std.detach(), paper.log_std.detach(), rtol=0, atol=1e-4)
    assert counts == [6, 6] if target_kl == NEVER else 0 < min(counts) < 6


def measured_mask(figures):
    return min(figures["mask_fraction"], 1 - figures["mask_fraction"])


def a_learner(found=None, **changes):
    """(Learner, B_o of the trajectories) with small networks."""
    found = trajectories(ENDS) if found is None else found
    torch.manual_seed(0)
    settings = dict(task="p2p", hidden_sizes=(16, 16), batch_size=30, demo_batch_size=20, lambda_bc=1.0, quiet=True)
    obs_dim = found[0].s.shape[1]
    return ppo.Learner(complete(**settings | changes), obs_dim), buffer_of(found)


@pytest.mark.parametrize("how", ["true", "timeout", "cut"])
def test_only_a_true_end_stops_bootstrapping(how):
    x = trajectories([how])[0]
    for name in ("s", "a", "r", "s2", "zeta", "end", "own"):
        setattr(x, name, getattr(x, name)[-1:])
    learner, B_o = a_learner([x], gamma=0.5, train_iters=1)
    with torch.no_grad():
        V, V2 = learner.net.V(x.s).item(), learner.net.V(x.s2).item()
    loss = learner.epoch(B_o, None, torch.zeros(0))["L_C"]
    assert abs(V2) > 1e-2 and loss == pytest.approx((x.r.item() + (how != "true") * 0.5 * V2 - V) ** 2, rel=1e-4)


# ---- the KL limit ----------------------------------------------------------------------------------------------------


def weights_of(learner):
    return {name: w.clone() for name, w in learner.net.state_dict().items()}


def moved(learner, before):
    """The parts of the networks that moved."""
    now = learner.net.state_dict()
    return {name.split(".")[0] for name, w in now.items() if not torch.equal(w, before[name])}


def test_at_the_kl_limit_the_paper_stops_all_and_the_robust_recipe_the_actor_alone():
    assert [complete(recipe=recipe).after_kl for recipe in ("paper", "robust")] == ["none", "critic"]


@pytest.mark.parametrize("with_demos", [True, False])
@pytest.mark.parametrize("after_kl", ["none", "critic", "all"])
def test_after_the_kl_limit_goes_on_what_the_flag_says(after_kl, with_demos):
    demos = buffer_of(trajectories(ENDS, seed=8, own=0)) if with_demos else None
    R = torch.zeros(demos.filled if demos else 0)
    learner, B_o = a_learner(after_kl=after_kl, mask="none", target_kl=0.0, train_iters=5)  # met before the first
    before = weights_of(learner)
    measured = learner.epoch(B_o, demos, R)
    goes_on = {"none": set(), "critic": {"v_net"}, "all": {"v_net", "mu_net"} if with_demos else {"v_net"}}
    assert moved(learner, before) == goes_on[after_kl]  # sigma is L_O's alone
    if after_kl == "none":
        assert measured == {}
    else:
        assert measured["updates"] == 5 and measured["learn_O"] == 0 and math.isnan(measured["L_O"])
    learner, B_o = a_learner(after_kl=after_kl, target_kl=NEVER, train_iters=5)
    learner.epoch(B_o, demos, R)
    assert moved(learner, before) == {"mu_net", "log_std", "v_net"}


def test_the_kl_limit_holds_from_where_it_is_first_reached():
    for after_kl, updates in (("none", 1), ("critic", 5)):
        learner, B_o = a_learner(after_kl=after_kl, target_kl=1e-9, train_iters=5)
        measured = learner.epoch(B_o, None, torch.zeros(0))
        assert measured["learn_O"] == pytest.approx(1 / updates) and measured["updates"] == updates


def test_kl_is_measured_on_own_samples_only(monkeypatch):
    updates = {}
    for own in (0, 1):
        learner, B_o = a_learner(trajectories(ENDS, own=own), target_kl=1e-9, train_iters=5)
        updates[own] = learner.epoch(B_o, None, torch.zeros(0))["updates"]
    assert updates == {0: 5, 1: 1}  # the demonstrator's alone never stop an epoch
    seen, kl = [], ppo.ActorCritic.kl
    monkeypatch.setattr(ppo.ActorCritic, "kl", lambda net, *args: seen.append(args[0]) or kl(net, *args))
    found = [*trajectories(ENDS, seed=1, own=0), *trajectories(ENDS, seed=2)]
    learner, B_o = a_learner(found, target_kl=NEVER, train_iters=3, pi_lr=0.0)
    learner.epoch(B_o, None, torch.zeros(0))
    own, others = (learner.net.mu(flat(part, "s")) for part in (found[len(ENDS) :], found[: len(ENDS)]))
    for mu in seen:
        off = (mu[:, None] - torch.cat((own, others))[None]).abs().amax(dim=2)
        assert off[:, : len(own)].amin(dim=1).max() < 1e-5 < off[:, len(own) :].min()
    assert min(len(mu) for mu in seen) > 0 and max(len(mu) for mu in seen) < 30  # of each batch, some


# ---- losses ----------------------------------------------------------------------------------------------------------


def test_the_policy_loss_clips_only_what_would_move_the_ratio_further():
    ratio = torch.tensor([1.5, 0.5, 1.5, 0.5, 1.1, 0.9], requires_grad=True)
    A = torch.tensor([1.0, 1.0, -1.0, -1.0, 2.0, -2.0])
    L = ppo.loss_O(ratio, A, 0.2)
    assert L.item() == pytest.approx(-(1.2 + 0.5 - 1.5 - 0.8 + 2.2 - 1.8) / 6)
    assert torch.autograd.grad(L, ratio)[0].tolist() == pytest.approx([x / -6 for x in (0, 1, -1, 0, 2, -2)])


def test_mask_picks_exactly_the_rows_whose_state_is_worth_less_than_the_threshold():
    V, threshold = torch.tensor([0.5, 2.0, -2.0, -2.0, 1e-6]), torch.tensor([1.0, 2.0, -1.0, -3.0, 0.0])
    assert ppo.mask(V, threshold).tolist() == [1, 0, 1, 0, 0]  # eq:mask_v: <, so not where they are equal


@pytest.mark.parametrize("mask", ["reward", "return", "none"])
def test_the_mask_compares_the_value_with_the_reward_the_return_or_nothing(mask, draws):
    demos = trajectories(ENDS, seed=8, own=0)
    r, B_d = flat(demos, "r"), buffer_of(demos)
    learner, B_o = a_learner(mask=mask, train_iters=5, demo_batch_size=50, vf_lr=0.0, target_kl=NEVER)
    with torch.no_grad():
        learner.net.v_net[-1].weight.zero_()
        learner.net.v_net[-1].bias.fill_(0.3)
    draws.clear()
    measured = learner.epoch(B_o, B_d, -r)  # a reward-to-go that never agrees with the reward
    M = {"reward": r > 0.3, "return": -r > 0.3, "none": r == r}[mask].float()
    expected = np.mean([M[i].mean().item() for high, i in draws if high == len(r)])
    assert measured["mask_fraction"] == pytest.approx(expected, rel=1e-5)


def test_bc_loss_averages_over_the_batch_and_the_four_actions():
    a_demo = torch.tensor([[1.0, 0, 0, 0], [0, 0.5, 0, 0], [1, 1, 1, 1]])
    a_hat = torch.tensor([[0.0, 0, 0, 1], [0, 0, 0, 0], [0, 0, 0, 0]])
    # rows: 2, 0.25 and (masked out) 4; over 3 rows of 4 actions
    assert ppo.loss_BC(a_demo, a_hat, torch.tensor([1.0, 1, 0])).item() == pytest.approx(2.25 / 12)
    assert ppo.loss_BC(a_demo, a_hat, torch.zeros(3)).item() == 0


def test_actor_loss_adds_lambda_times_the_cloning_loss_and_critic_loss_is_the_mean_square():
    assert ppo.loss_A(torch.tensor(2.0), torch.tensor(3.0), 1.5).item() == 6.5
    assert ppo.loss_C(torch.tensor([1.0, 2.0]), torch.tensor([3.0, 1.0])).item() == 2.5


@pytest.mark.parametrize("task, highest", [("p2p", 10.0), ("p2po", 10.0), ("pnp", 12.0)])
def test_clip_value_holds_values_between_minus_four_and_the_largest_return(task, highest):
    obs_dim = 22 if task == "p2p" else 25
    for clip in (True, False):
        learner = ppo.Learner(complete(task=task, hidden_sizes=(8,), clip_value=clip), obs_dim)
        for value, clipped in ((100.0, highest), (11.0, min(11.0, highest)), (-100.0, -4.0), (-3.0, -3.0), (9.0, 9.0)):
            with torch.no_grad():
                learner.net.v_net[-1].weight.zero_()
                learner.net.v_net[-1].bias.fill_(value)
                assert learner.V(torch.zeros(1, obs_dim)).item() == (clipped if clip else value)


# ---- networks --------------------------------------------------------------------------------------------------------


def two_policies():
    """(ActorCritic with unlike sigmas, the means and log sigma of an older policy)."""
    torch.manual_seed(0)
    net = ppo.ActorCritic(22, (8,), -0.5, False, "cpu")
    with torch.no_grad():
        net.log_std.copy_(torch.tensor([-2.0, -0.5, 0.3, 0.0]))
    return net, torch.randn(7, 4), torch.tensor([-1.5, -0.7, 0.3, 0.4])


def test_log_prob_is_that_of_torch_distributions():
    net, mu, _ = two_policies()
    a = torch.randn(7, 4)
    expected = Normal(mu, net.log_std.exp()).log_prob(a).sum(1)
    torch.testing.assert_close(net.log_prob(mu, a), expected, rtol=1e-5, atol=1e-5)


def test_kl_is_from_the_policy_that_acted_to_the_present_one():
    net, mu_old, log_std_old = two_policies()
    mu = mu_old + 0.3 * torch.randn(7, 4)
    old, now = Normal(mu_old, log_std_old.exp()), Normal(mu, net.log_std.exp())
    expected = kl_divergence(old, now).sum(1).mean().item()
    assert net.kl(mu, mu_old, log_std_old).item() == pytest.approx(expected, rel=1e-5)
    assert abs(expected - kl_divergence(now, old).sum(1).mean().item()) > 0.1
    assert net.kl(mu, mu, net.log_std).item() == 0


def test_networks_are_two_relu_stacks_with_a_sigma_that_no_state_changes():
    net = ppo.ActorCritic(22, (8, 12), -0.5, False, "cpu")
    for part, n_out in ((net.mu_net, 4), (net.v_net, 1)):
        assert [type(layer).__name__ for layer in part] == 2 * ["Linear", "ReLU"] + ["Linear"]
        assert [p.shape[0] for p in part.parameters()] == [8, 8, 12, 12, n_out, n_out]
    assert net.log_std.tolist() == [-0.5] * 4
    s = torch.randn(5, 22)
    assert torch.equal(net.mu(s), net.mu_net(s)) and torch.equal(net.V(s), net.v_net(s)[:, 0])  # not yet normalised


def wide_demos():
    """Demonstrations of states with unlike means and deviations, one of which never changes."""
    demos = trajectories(ENDS, seed=8, own=0)
    scale, shift = torch.logspace(-1, 1, 22), torch.linspace(-3, 3, 22)
    scale[5] = 0
    for x in demos:
        x.s = shift + scale * x.s
    return demos


def test_normalisation_is_by_mean_and_deviation_of_the_demonstrated_states_or_a_fifth():
    demos = wide_demos()
    s, B_d = flat(demos, "s"), buffer_of(demos)
    learner, _ = a_learner()
    learner.normalize(B_d)
    seen = (s - learner.net.s_mean) / learner.net.s_std
    std = s.std(0)
    assert 3 < (std > 0.2).sum() < 22  # both cases
    torch.testing.assert_close(seen.mean(0), torch.zeros(22), rtol=0, atol=1e-4)
    torch.testing.assert_close(seen.std(0), torch.where(std > 0.2, 1.0, std / 0.2), rtol=1e-4, atol=1e-6)
    with torch.no_grad():
        assert torch.equal(learner.net.mu(s), learner.net.mu_net(seen))
        assert torch.equal(learner.net.V(s), learner.net.v_net(seen)[:, 0])


@pytest.mark.parametrize("task, symmetry", [("p2p", "none"), ("p2p", "canonical"), ("pnp", "canonical")])
def test_the_saved_policy_is_the_one_that_acts_with_its_normalisation_folded_in(task, symmetry):
    obs_dim = {"p2p": 22, "pnp": 25}[task]
    torch.manual_seed(0)
    s = states(200, obs_dim)
    if task == "pnp":  # in half of the states the cube is grasped
        s[::2, 22:] = s[::2, 16:19] - s[::2, 19:22]
    view = gas.canonical(s) if symmetry == "canonical" else s
    learner = ppo.Learner(complete(task=task, recipe="robust", symmetry=symmetry, **SETTINGS), obs_dim)
    assert learner.net.grasp_input == (task == "pnp")
    B_o, B_d = buffer_of(trajectories(ENDS, obs_dim, 4)), ppo.TrajectoryBuffer(obs_dim, 200)
    B_d.store_rows(torch.cat((view, torch.zeros(200, obs_dim + 8)), 1))
    learner.normalize(B_d)
    learner.epoch(B_o, None, torch.zeros(0))
    file = io.BytesIO()
    torch.save(learner.policy(), file)
    policy = evaluate.Policy(torch.load(io.BytesIO(file.getvalue()), weights_only=True))
    with torch.no_grad():
        acting = learner.actor.mu(view).clamp(-1, 1)
    torch.testing.assert_close(torch.from_numpy(policy(s.numpy())), acting, rtol=0, atol=1e-5)
    assert acting.std(0).min() > 0.003 and acting.abs().max() < 1


def test_a_saved_learner_goes_on_bit_for_bit():
    demos = wide_demos()
    B_d, R = buffer_of(demos), flat(demos, "r")
    learner, B_o = a_learner(recipe="robust", train_iters=4)
    learner.normalize(B_d)
    learner.epoch(B_o, B_d, R)
    file = io.BytesIO()
    torch.save(learner.state(), file)
    torch.manual_seed(99)
    other = ppo.Learner(learner.flags, 22)
    other.load(torch.load(io.BytesIO(file.getvalue()), weights_only=True))
    for one in (learner, other):
        torch.manual_seed(5)
        one.epoch(B_o, B_d, R)
    weights = weights_of(learner)
    assert all(torch.equal(w, weights[name]) for name, w in other.net.state_dict().items())
    assert moved(learner, torch.load(io.BytesIO(file.getvalue()), weights_only=True)["net"]) >= {"mu_net", "v_net"}


def test_cloning_first_fits_the_actor_and_the_critic_to_the_demonstrations(draws):
    """As a plain reimplementation does: Adam at vf_lr for both, falling by a cosine to 0, no mask."""
    demos = trajectories(ENDS, seed=8, own=0)
    s, a, R = flat(demos, "s"), flat(demos, "a"), flat(demos, "r") - 9
    settings = dict(pi_lr=0.0, vf_lr=5e-3, clone_iters=7, mask="reward", lambda_bc=9.0)
    learner, _ = a_learner(**settings)
    paper = Paper(learner, **SETTINGS)
    before = weights_of(learner)
    draws.clear()
    learner.clone(buffer_of(demos), R)
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


# ---- replay buffers --------------------------------------------------------------------------------------------------


def test_a_row_is_s_a_r_s2_zeta_end_own():
    buffer = ppo.TrajectoryBuffer(22, 3)
    s, a, s2 = (np.random.default_rng(0).normal(size=n).astype(np.float32) for n in (22, 4, 22))
    buffer.store(s, a, -0.25, s2, False, np.True_, own=1)
    assert buffer.state().tolist() == [[*s.tolist(), *a.tolist(), -0.25, *s2.tolist(), 0.0, 1.0, 1.0]]


def test_a_saved_buffer_goes_on_where_it_was():
    one = buffer_of(trajectories(["true", "cut"]))
    other = ppo.TrajectoryBuffer(22, one.filled + 2)
    other.store(np.zeros(22), np.zeros(4), 1, np.zeros(22), 0, 0, 0)
    other.load(one.state())
    assert torch.equal(other.state(), one.rows) and other.filled == one.filled
    assert one.state().untyped_storage().nbytes() == one.rows.nbytes


@pytest.mark.parametrize("obs_dim", [22, 25])
def test_turn_turns_s_and_s2_of_a_row_by_its_angle_and_nothing_else(obs_dim):
    torch.manual_seed(0)
    s, s2, angle = states(40, obs_dim), states(40, obs_dim, seed=1), 2 * math.pi * torch.rand(40)
    kept = torch.rand(40, 4), torch.randn(40, 1), (torch.rand(40, 3) < 0.5).float()
    rows = torch.cat((s, kept[0], kept[1], s2, kept[2]), dim=1)
    turned = ppo.turn(rows, (obs_dim, 4, 1, obs_dim, 1, 1, 1), angle)
    expected = torch.cat((gas.rotate(s, angle), kept[0], kept[1], gas.rotate(s2, angle), kept[2]), dim=1)
    assert torch.equal(turned, expected) and not torch.isclose(turned[:, 0], s[:, 0]).any()


@pytest.mark.parametrize("symmetry", ["so2", "none", "gas", "canonical"])
def test_so2_turns_each_trajectory_by_one_angle_and_nothing_else_turns_it(symmetry, monkeypatch):
    turned, turn = [], ppo.turn
    monkeypatch.setattr(ppo, "turn", lambda rows, widths, angle: turned.append((rows, turn(rows, widths, angle), angle))
                        or turned[-1][1])  # fmt: skip
    seen, mu = [], ppo.ActorCritic.mu
    monkeypatch.setattr(ppo.ActorCritic, "mu", lambda net, s: seen.append(s) or mu(net, s))
    found = trajectories([*ENDS, "cut", "true"])  # also where the last trajectory ends the buffer
    learner, B_o = a_learner(found, symmetry=symmetry, train_iters=2, target_kl=NEVER)
    learner.epoch(B_o, None, torch.zeros(0))
    learner.epoch(B_o, None, torch.zeros(0))
    if symmetry != "so2":
        assert turned == [] and torch.equal(seen[0], flat(found, "s"))
        return
    (rows, after, angle), (_, _, again) = turned
    assert torch.equal(rows, B_o.rows) and torch.equal(seen[0], after[:, :22])  # what the networks see
    first = torch.cat((torch.zeros(1), torch.cumsum(torch.tensor([len(x.r) for x in found]), 0)))[:-1].long()
    assert torch.equal(angle, torch.repeat_interleave(angle[first], torch.tensor([len(x.r) for x in found])))
    assert len(angle.unique()) == len(found) and angle.min() >= 0 and 3 < angle.max() < 2 * math.pi
    assert not torch.isclose(angle, again).any()  # drawn anew each epoch


def test_so2_turns_each_demonstrated_step_by_an_angle_of_its_own(monkeypatch):
    angles, turn = [], ppo.turn
    monkeypatch.setattr(ppo, "turn", lambda rows, widths, angle: angles.append(angle) or turn(rows, widths, angle))
    demos = trajectories(ENDS, seed=8, own=0)
    s, a, r, R = flat(demos, "s"), flat(demos, "a"), flat(demos, "r"), torch.arange(len(flat(demos, "r"))).float()
    for mask, threshold in (("reward", r), ("return", R)):
        learner, _ = a_learner(symmetry="so2", mask=mask)
        s_demo, a_demo, compared, to_go = learner.demo_batch(buffer_of(demos), R)
        i = to_go.long()
        assert torch.equal(a_demo, a[i]) and torch.equal(compared, threshold[i])
        assert torch.equal(s_demo, gas.rotate(s[i], angles[-1])) and len(angles[-1].unique()) == 20


# ---- defaults --------------------------------------------------------------------------------------------------------

DEFAULTS = {  # by hand from tab:reward2 (pnp), tab:reward (the others) and the text above; N, lambda from DESIGN
    "p2p": dict(max_ep_len=400, num_demos=100, lambda_bc=1.8, hidden_sizes=(128, 512, 128)),
    "p2po": dict(max_ep_len=500, num_demos=250, lambda_bc=2, hidden_sizes=(256, 1024, 256)),
    "pnp": dict(max_ep_len=800, num_demos=400, lambda_bc=15, hidden_sizes=(512, 512, 256)),
}
ALL_TASKS = dict(epochs=50, steps_per_epoch=4000, batch_size=800, gamma=0.99, lam=0.97, clip_ratio=0.2, target_kl=0.02,
                 vf_lr=1e-3, partitions=4, seed=0, device="cpu", data_dir="data/runs")  # fmt: skip
RECIPES = {
    "paper": dict(symmetry="gas", gains="authors", train_iters=20, demo_batch_size=100, log_std=-0.5, demo_noise=0,
                  pi_lr=3e-4, demos_in_B_o=True, clone_iters=0, mask="reward", after_kl="none", normalize_obs=False,
                  grasp_input=False, clip_value=False),
    "robust": dict(symmetry="canonical", gains="fast", train_iters=80, demo_batch_size=256, log_std=-2, demo_noise=0.2,
                   demos_in_B_o=False, clone_iters=4000, mask="none", after_kl="critic", normalize_obs=True,
                   clip_value=True, pi_lr=3e-6),
}  # fmt: skip
NO_DEFAULT = {"demos"}


@pytest.mark.parametrize("recipe", [None, "paper", "robust"])
@pytest.mark.parametrize("task", DEFAULTS)
def test_defaults_are_those_of_the_papers_table_and_the_recipe(task, recipe):
    flags = vars(complete(task=task, recipe=recipe))
    expected = DEFAULTS[task] | ALL_TASKS | RECIPES[recipe or "paper"] | {"recipe": recipe or "paper"}
    per_epoch = {"p2p": 20, "p2po": 50, "pnp": 80} if recipe != "robust" else {"p2p": 100, "p2po": 250, "pnp": 400}
    expected |= {"demos_per_epoch": per_epoch[task], "grasp_input": recipe == "robust" and task == "pnp"}
    assert {name: flags[name] for name in expected} == expected
    assert {name for name, value in flags.items() if value is None} == NO_DEFAULT


def test_the_task_is_pick_and_place_where_none_is_named():
    assert complete().task == "pnp"


def test_demonstrations_an_epoch_are_a_fifth_of_those_asked_for_rounded_up_and_at_least_one():
    for num_demos, per_epoch in ((7, 2), (5, 1), (1, 1), (0, 1), (400, 80)):
        assert complete(num_demos=num_demos).demos_per_epoch == per_epoch
    assert complete(num_demos=7, recipe="robust").demos_per_epoch == 7


def test_quick_is_a_short_run_of_the_robust_recipe():
    flags = vars(complete(quick=True))
    expected = DEFAULTS["pnp"] | RECIPES["robust"] | dict(recipe="robust", epochs=ppo.QUICK["epochs"])
    assert {name: flags[name] for name in expected} == expected and flags["epochs"] <= 10


def test_explicit_flags_win_over_quick_the_recipe_and_the_task():
    given = dict(epochs=3, recipe="paper", lambda_bc=0.0, num_demos=0, hidden_sizes=(8, 8), max_ep_len=50, gains="fast")
    flags = vars(complete(quick=True, **given))
    assert {name: flags[name] for name in given} == given and flags["symmetry"] == "gas"
    given = dict(recipe="robust", symmetry="none", train_iters=3, demo_batch_size=9, log_std=-1.0, demo_noise=0.0,
                 demos_in_B_o=True, clone_iters=0, mask="reward", after_kl="none", normalize_obs=False,
                 clip_value=False, demos_per_epoch=3)  # fmt: skip
    flags = vars(complete(**given))
    assert {name: flags[name] for name in given} == given and flags["gains"] == "fast"


@pytest.mark.parametrize("given, name", [
    (dict(), "pnp-ppo-paper-N400-lambda15-gas-seed0"),
    (dict(recipe="robust", seed=7), "pnp-ppo-robust-N400-lambda15-canonical-seed7"),
    (dict(task="p2po", symmetry="so2", recipe="robust"), "p2po-ppo-robust-N250-lambda2-so2-seed0"),
    (dict(task="p2p", num_demos=15, lambda_bc=0.5), "p2p-ppo-paper-N15-lambda0.5-gas-seed0"),
    (dict(num_demos=0, lambda_bc=0.0), "pnp-ppo-paper-N0-lambda0-gas-seed0"),
    (dict(quick=True), "pnp-ppo-robust-N400-lambda15-canonical-seed0-quick"),
    (dict(name="mine", seed=7), "mine"),
    (dict(epochs=9, data_dir="x", quiet=True, eval_every=0, resume=True), "pnp-ppo-paper-N400-lambda15-gas-seed0"),
])  # fmt: skip
def test_the_default_name_says_task_algorithm_recipe_demonstrations_lambda_symmetry_and_seed(given, name):
    assert complete(**given).name == name


CHANGES = dict(gamma=0.9, gains="fast", hidden_sizes=(8, 8), demos="some/where/demos.npz", partitions=8, max_ep_len=100,
               steps_per_epoch=300, batch_size=10, demo_batch_size=10, lam=0.5, clip_ratio=0.1, target_kl=1.0,
               pi_lr=1e-4, vf_lr=1e-4, log_std=-1.0, train_iters=3, demos_per_epoch=7, demo_noise=0.1,
               demos_in_B_o=False, clone_iters=3, mask="none", after_kl="all", normalize_obs=True,
               grasp_input=True, clip_value=True)  # fmt: skip


def test_the_default_names_of_runs_that_differ_in_any_setting_differ_and_can_be_folders(tmp_path):
    names = [complete().name] + [complete(**{key: value}).name for key, value in CHANGES.items()]
    assert len(set(names)) == len(names) and set(CHANGES) | logx.NOT_A_VARIANT == set(vars(complete()))
    for name in (*names, complete(**CHANGES).name):
        (tmp_path / name).mkdir()  # also with every flag of them at once: no longer than a file name may be


def test_a_variant_is_what_differs_from_the_recipe_beside_the_columns_and_lengths_of_the_tables():
    def variant(**given):
        return ppo.complete(ppo.Flags(**given))[1]

    for given in (dict(), dict(recipe="robust"), dict(task="p2p", seed=5, num_demos=7, lambda_bc=9.0, symmetry="so2"),
                  dict(epochs=3, quick=True, eval_every=1, checkpoint_every=1, data_dir="x", name="y"),
                  dict(gamma=0.99, hidden_sizes=[512, 512, 256], clip_value=False)):  # fmt: skip
        assert variant(**given) == ""
    assert variant(gamma=0.9) == variant(gamma=0.9, seed=3, num_demos=0) != variant(gamma=0.8)
    assert "gamma" in variant(gamma=0.9) and "clip_value" in variant(clip_value=True)
    assert variant(recipe="robust", clip_value=True) == "" != variant(recipe="robust", clip_value=False)


@pytest.mark.parametrize("given", [dict(lam=1.1), dict(clip_ratio=-0.1), dict(train_iters=0), dict(demos_per_epoch=0),
                                   dict(log_std=math.nan), dict(target_kl=-1.0), dict(clone_iters=-1),
                                   dict(name="a/b"), dict(seed=-1)], ids=str)  # fmt: skip
def test_a_flag_out_of_range_is_bad_input_that_names_it(given, capsys):
    with pytest.raises(SystemExit) as stopped:
        complete(**given)
    assert stopped.value.code == 2 and f"--{next(iter(given))} " in capsys.readouterr().err


# ---- training loop, on a scripted environment ------------------------------------------------------------------------


def scripted_run(data_dir, name, at_step=None, recorded=None, **changes):
    """train() on a Scripted environment: (run folder, training environment with the exit code of the run, and what
    each epoch() was given and gave: B_o, B_d, R_demo, measured). recorded: what pid_demo.record gives."""
    made, exit_code, epochs, epoch = [], None, [], ppo.Learner.epoch

    def make(env_id, stage, **kwargs):
        made.append(Scripted())
        made[-1].stage, made[-1].at_step = stage, at_step if stage == "train" else None
        return made[-1]

    def noted(self, B_o, B_d, R_demo):
        rows = B_o.rows[: B_o.filled].clone(), B_d.rows[: B_d.filled].clone() if B_d else None
        epochs.append(SimpleNamespace(B_o=rows[0], B_d=rows[1], R_demo=R_demo, before=weights_of(self),
                                      measured=epoch(self, B_o, B_d, R_demo)))  # fmt: skip
        return epochs[-1].measured

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ppo, "gymnasium", SimpleNamespace(make=make))
        patch.setattr(ppo.Learner, "epoch", noted)
        if recorded:
            patch.setattr(pid_demo, "record", lambda *args, **kwargs: recorded)
        try:
            ppo.train(complete(**TINY | dict(name=name, data_dir=str(data_dir)) | changes))
        except SystemExit as stopped:
            exit_code = stopped.code
    env = next((env for env in made if env.stage == "train"), SimpleNamespace(steps=[]))
    env.exit_code, env.epochs = exit_code, epochs
    return data_dir / name, env


@pytest.fixture
def world(tmp_path):
    return lambda name, **changes: scripted_run(tmp_path, name, **changes)


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """(folder, environment) of the run of TINY, from begin to end."""
    return scripted_run(tmp_path_factory.mktemp("plain"), "plain")


def transitions(steps, view=lambda s: s):
    """The rows that B_o holds of an epoch of these steps."""
    rows = [np.concatenate([view(x.s), x.a, [x.r], view(x.s2), [x.terminated, bool(x.end), 1]]) for x in steps]
    rows[-1][-2] = 1  # the cut
    return torch.from_numpy(np.stack(rows).astype(np.float32))


def demo_rows(demos, view=lambda s: s):
    """The rows of B_d."""
    end = np.append(np.diff(demos["episode"]), 1)
    columns = (demos[name] for name in ("obs", "act", "rew", "obs2", "terminated"))
    rows = [np.concatenate([view(s), a, [r], view(s2), [zeta, last, 0]])
            for s, a, r, s2, zeta, last in zip(*columns, end, strict=True)]  # fmt: skip
    return torch.from_numpy(np.stack(rows).astype(np.float32))


@pytest.mark.parametrize("symmetry", ["none", "gas", "so2", "canonical"])
def test_an_epoch_learns_from_each_of_its_own_steps_in_order_and_a_timeout_or_a_cut_is_no_true_end(world, symmetry):
    folder, env = world("a", symmetry=symmetry)
    view = gas.canonical if symmetry == "canonical" else lambda s: s
    assert len(env.steps) == 120 and len(env.epochs) == 3
    zeta, end = {}, {}
    for n, epoch in enumerate(env.epochs):
        steps = env.steps[40 * n : 40 * (n + 1)]
        assert torch.equal(epoch.B_o, transitions(steps, view)) and epoch.B_d is None
        assert epoch.B_o[-1, -2] == 1  # cut, or not
        for x, row in list(zip(steps, epoch.B_o, strict=True))[:-1]:
            zeta.setdefault(x.end, set()).add(row[-3].item())
            end.setdefault(x.end, set()).add(row[-2].item())
    assert zeta == {"": {0}, "timeout": {0}, "success": {1}, "self": {1}}
    assert end == {"": {0}, "timeout": {1}, "success": {1}, "self": {1}}
    cut = [epoch.B_o[-1, -3] for n, epoch in enumerate(env.epochs) if env.steps[40 * n + 39].end == ""]
    assert cut and not any(cut)  # an epoch that ends in the middle of an episode


def test_the_real_environments_timeouts_end_a_trajectory_and_bootstrap(tmp_path, monkeypatch):
    stored, epoch = [], ppo.Learner.epoch
    monkeypatch.setattr(ppo.Learner, "epoch", lambda *args: stored.append(args[1].state()) or epoch(*args))
    changes = dict(max_ep_len=15, epochs=1, steps_per_epoch=70, name="a", data_dir=str(tmp_path))
    folder = ppo.train(complete(**TINY | changes))
    rows = rows_of(folder / "episodes.csv")
    true_ends = [int(row["env_steps"]) for row in rows if row["success"] == "1" or row["collision"]]
    assert len(true_ends) < len(rows) >= 4  # most of them time out
    assert (1 + stored[0][:, -3].nonzero().flatten()).tolist() == true_ends
    assert (1 + stored[0][:, -2].nonzero().flatten()).tolist() == [*(int(row["env_steps"]) for row in rows), 70]


def test_actions_are_drawn_from_the_policy_and_neither_clipped_nor_squashed(world):
    folder, env = world("a", pi_lr=0.0, log_std=0.3, epochs=12)  # never updated: the one that acted
    net = evaluate.load_policy(folder).net
    with torch.no_grad():
        mu = net(torch.from_numpy(np.stack([x.s for x in env.steps]))).numpy()
    a = np.stack([x.a for x in env.steps])
    z = (a - mu) / math.exp(0.3)
    assert abs(z.mean()) < 0.1 and 0.93 < z.std() < 1.07 and 0.63 < np.mean(np.abs(z) < 1) < 0.74  # normal: 0.68
    assert np.mean(np.abs(a) > 1) > 0.2 and np.abs(np.corrcoef(z.T) - np.eye(4)).max() < 0.2


def test_canonical_acts_on_the_state_in_the_arms_own_frame(world):
    folder, env = world("a", symmetry="canonical", pi_lr=0.0, log_std=-20.0)
    policy = evaluate.load_policy(folder)
    for x in env.steps:
        assert np.abs(policy(x.s) - np.clip(x.a, -1, 1)).max() < 1e-5


def test_epochs_cut_no_episode(world):
    folder, env = world("a", steps_per_epoch=10, epochs=12, checkpoint_every=9)
    rows, ends = rows_of(folder / "episodes.csv"), [t + 1 for t, x in enumerate(env.steps) if x.end]
    assert [int(row["env_steps"]) for row in rows] == ends and len(ends) >= 7
    assert [int(row["length"]) for row in rows] == np.diff([0, *ends]).tolist()
    assert max(int(row["length"]) for row in rows) > 10
    assert [int(row["episode"]) for row in rows] == list(range(1, len(ends) + 1))
    for row, begin, end in zip(rows, [0, *ends[:-1]], ends, strict=True):
        last = env.steps[end - 1].end
        assert float(row["return"]) == pytest.approx(sum(x.r for x in env.steps[begin:end]), abs=1e-6)
        assert row["success"] == str(int(last == "success")) and row["collision"] == ("self" if last == "self" else "")


def test_a_row_of_progress_averages_its_own_epoch(world):
    folder, env = world("a", steps_per_epoch=20, epochs=6, checkpoint_every=9, recorded=(demo_arrays(), 18),
                        num_demos=4, lambda_bc=1.0)  # fmt: skip
    episodes, progress = rows_of(folder / "episodes.csv"), rows_of(folder / "progress.csv")
    assert [int(row["epoch"]) for row in progress] == list(range(1, 7))
    for row, epoch in zip(progress, env.epochs, strict=True):
        begin, end = int(row["env_steps"]) - 20, int(row["env_steps"])
        assert end == 20 * int(row["epoch"]) and row["demo_env_steps"] == "18"
        mine = [e for e in episodes if begin < int(e["env_steps"]) <= end]
        for column, name in (("EpRet", "return"), ("EpLen", "length"), ("Success", "success")):
            values = [float(e[name]) for e in mine]
            assert row[column] == "" if not mine else float(row[column]) == pytest.approx(np.mean(values), abs=1e-6)
        for name in ("L_O", "L_BC", "L_C", "L_A", "mask_fraction", "Q_mean", "Q_max", "pretanh_own", "pretanh_demo",
                     "bc_relative_error"):  # fmt: skip
            assert float(row[name]) == pytest.approx(epoch.measured[name], rel=1e-5), name
    assert "" in {row["EpRet"] for row in progress} or len(episodes) >= 6


# ---- demonstrations in the loop --------------------------------------------------------------------------------------

LENGTHS = np.cumsum([length for _, length in DEMO_ENDS]).tolist()  # rows of the first 1, 2, 3, 4 of demo_arrays()


@pytest.mark.parametrize("recipe, in_B_o, filled", [
    ("paper", None, [LENGTHS[0], LENGTHS[1], LENGTHS[2], LENGTHS[3], LENGTHS[3]]),
    ("paper", False, [LENGTHS[0], LENGTHS[1], LENGTHS[2], LENGTHS[3], LENGTHS[3]]),
    ("robust", None, [LENGTHS[3]] * 5), ("robust", True, [LENGTHS[3]] * 5),
])  # fmt: skip
def test_demonstrations_open_the_early_epochs_until_B_d_is_full(world, recipe, in_B_o, filled):
    """N_demos / 5 (at least one) an epoch in the paper's recipe, into both buffers; all at once in the robust one."""
    changes = {} if in_B_o is None else dict(demos_in_B_o=in_B_o)
    folder, env = world("a", recipe=recipe, symmetry="none", num_demos=4, recorded=(demo_arrays(), 18), epochs=5,
                        clone_iters=2, **changes)  # fmt: skip
    rows, R, begin = demo_rows(demo_arrays()), [], 0
    assert [len(epoch.B_d) for epoch in env.epochs] == filled
    for n, (epoch, now) in enumerate(zip(env.epochs, filled, strict=True)):
        before, own = ([0, *filled][n], transitions(env.steps[40 * n : 40 * (n + 1)]))
        opened = rows[before:now] if (recipe == "paper" if in_B_o is None else in_B_o) else rows[:0]
        assert torch.equal(epoch.B_d, rows[:now]) and torch.equal(epoch.B_o, torch.cat((opened, own)))
    for length in np.diff([0, *LENGTHS]).tolist():
        r, begin = rows[begin : begin + length, 26].tolist(), begin + length
        R += [sum(0.99 ** (k - t) * r[k] for k in range(t, length)) for t in range(length)]
    torch.testing.assert_close(env.epochs[0].R_demo, torch.tensor(R), rtol=1e-4, atol=1e-5)
    assert rows[:, -3].nonzero().flatten().tolist() == [5, 9]  # neither timeout stops bootstrapping
    assert rows[:, -2].nonzero().flatten().tolist() == [n - 1 for n in LENGTHS]


def test_demos_per_epoch_says_how_many_open_an_epoch(world):
    for per_epoch, filled in ((3, [LENGTHS[2], LENGTHS[3], LENGTHS[3]]), (9, [LENGTHS[3]] * 3)):
        _, env = world(f"{per_epoch}", num_demos=4, recorded=(demo_arrays(), 18), demos_per_epoch=per_epoch)
        assert [len(epoch.B_d) for epoch in env.epochs] == filled


def test_canonical_demonstrations_are_stored_in_the_arms_own_frame(world):
    _, env = world("a", symmetry="canonical", num_demos=4, recorded=(demo_arrays(), 18), demos_per_epoch=4)
    rows = demo_rows(demo_arrays(), gas.canonical)
    assert torch.equal(env.epochs[0].B_d, rows) and torch.equal(env.epochs[0].B_o[: len(rows)], rows)


@pytest.mark.parametrize("normalize_obs", [True, False])
@pytest.mark.parametrize("clone_iters", [0, 3])
def test_normalisation_and_cloning_come_before_the_first_step(world, normalize_obs, clone_iters):
    changes = dict(num_demos=4, recorded=(demo_arrays(), 18), symmetry="none", epochs=1, demos_per_epoch=2)
    folder, env = world("a", normalize_obs=normalize_obs, clone_iters=clone_iters, **changes)
    _, other = world("b", normalize_obs=normalize_obs, clone_iters=0, **changes)
    net, untouched = env.epochs[0].before, other.epochs[0].before
    s = demo_rows(demo_arrays())[: LENGTHS[1], :22]  # the first B_d
    if normalize_obs:
        torch.testing.assert_close(net["s_mean"], s.mean(0))
        torch.testing.assert_close(net["s_std"], s.std(0))
    else:
        assert net["s_mean"].tolist() == [0] * 22 and net["s_std"].tolist() == [1] * 22
    same = [torch.equal(w, untouched[name]) for name, w in net.items() if "net" in name]
    assert all(same) if clone_iters == 0 else not any(same)
    assert (env.steps[0].a == other.steps[0].a).all() == (clone_iters == 0)


def test_without_demonstrations_it_is_plain_ppo_whatever_lambda_is(plain, world):
    other, env = world("a", num_demos=0, lambda_bc=5.0)
    assert curves(plain[0]) == curves(other)
    for row in rows_of(other / "progress.csv"):
        assert row["L_A"] == row["L_O"] != "" and row["L_BC"] == row["mask_fraction"] == row["pretanh_demo"] == ""
        assert row["bc_relative_error"] == "" and row["demo_env_steps"] == "0"


@pytest.mark.parametrize("recipe, symmetry", [("robust", "so2"), ("paper", "gas")])
def test_demonstrations_from_a_file_equal_recording_the_same(world, tmp_path, recipe, symmetry):
    settings = dict(recipe=recipe, symmetry=symmetry, num_demos=3, lambda_bc=1.8, gains="fast", epochs=2, clone_iters=2)
    noise = 0.2 if recipe == "robust" else 0.0
    recorded, steps = pid_demo.record("p2p", 3, "fast", seed=3, symmetry=symmetry, noise=noise)
    path = demo_file(tmp_path / "demos.npz", recorded, env_steps=steps, symmetry="gas" if symmetry == "gas" else "none")
    (own, env), (read, other) = world("a", **settings), world("b", demos=path, **settings)
    assert env.exit_code is other.exit_code is None and curves(own) == curves(read)
    assert all(torch.equal(x.B_d, y.B_d) for x, y in zip(env.epochs, other.epochs, strict=True))
    assert len(env.epochs[-1].B_d) == recorded["length"][: 3 if recipe == "robust" else 2].sum() > 50
    _, fewer = world("c", demos=path, **settings | dict(num_demos=2))
    assert len(fewer.epochs[-1].B_d) == recorded["length"][:2].sum()


def test_a_file_of_one_partition_is_mapped_to_all_by_gas(world, tmp_path):
    demos = demo_arrays()
    demos["partition"][1] = 2  # left out
    _, env = world("a", demos=demo_file(tmp_path / "demos.npz", demos), num_demos=12, symmetry="gas", epochs=1,
                   demos_per_epoch=12)  # fmt: skip
    rows, begin = env.epochs[0].B_d, 0
    for source in (0, 2, 3):
        mine = demos["episode"] == source
        for k in range(4):
            part = rows[begin : (begin := begin + mine.sum())]
            assert np.allclose(part[:, :22], gas.phi(demos["obs"][mine], k), atol=1e-6)
            assert np.allclose(part[:, 27:49], gas.phi(demos["obs2"][mine], k), atol=1e-6)
            assert np.array_equal(part[:, 22:26], demos["act"][mine])
            assert part[:, -2].tolist() == [0] * (mine.sum() - 1) + [1]
    assert begin == len(rows)


@pytest.mark.parametrize("changes, meta, needle", [
    (dict(num_demos=5), dict(), "--num_demos 5"), (dict(num_demos=4, symmetry="gas"), dict(partitions=8), "partitions"),
    (dict(num_demos=4, task="p2po"), dict(), "task p2p"),
])  # fmt: skip
def test_a_file_that_does_not_fit_is_bad_input_and_makes_no_folder(world, tmp_path, capsys, changes, meta, needle):
    path = demo_file(tmp_path / "demos.npz", demo_arrays(), **meta)
    folder, env = world("a", **dict(symmetry="none") | changes, demos=path)
    err = capsys.readouterr().err
    assert env.exit_code == 2 and err.count("\n") == 1 and needle in err and not folder.exists()


def test_demonstrations_with_noise_do_not_go_into_B_o(world, capsys):
    """Their actions are what the controller asked for, not what led to s2."""
    demos = demo_arrays()
    demos["executed"] = demos["act"] + 0.1
    folder, env = world("a", num_demos=4, recorded=(demos, 18), demos_in_B_o=True)
    assert env.exit_code == 2 and "--demos_in_B_o" in capsys.readouterr().err and not folder.exists()
    _, env = world("a", num_demos=4, recorded=(demos, 18), demos_in_B_o=False, demos_per_epoch=4, symmetry="none")
    assert torch.equal(env.epochs[0].B_d, demo_rows(demo_arrays()))


@pytest.mark.parametrize("recipe, settings", [
    ("paper", dict(gains="authors", symmetry="gas", noise=0.0)),
    ("robust", dict(gains="fast", symmetry="canonical", noise=0.2)),
])  # fmt: skip
def test_the_demonstrator_is_that_of_the_recipe(recipe, settings, monkeypatch):
    asked = []
    monkeypatch.setattr(pid_demo, "record", lambda *args, **kwargs: asked.append((args, kwargs)) or ({}, 0))
    pid_demo.demonstrations(complete(recipe=recipe, num_demos=9, seed=4, partitions=6, quiet=True))
    assert asked == [(("pnp", 9), settings | dict(seed=4, partitions=6, quiet=True))]


# ---- whole runs ------------------------------------------------------------------------------------------------------


def test_the_same_seed_gives_the_same_run_and_another_does_not(plain, world):
    (one, env), (again, _), (other, other_env) = plain, world("b"), world("c", seed=4)
    assert curves(one) == curves(again)
    assert not np.array_equal(env.steps[0].s, other_env.steps[0].s)  # the episodes too, not the exploration alone
    assert all(x != y for x, y in zip(curves(one), curves(other), strict=True))


def test_evaluation_is_logged_and_changes_nothing_in_the_run(plain, world):
    (silent, _), (evaluated, _) = plain, world("b", eval_every=2, eval_trials=2)
    rows = rows_of(evaluated / "progress.csv")
    measured = [row["epoch"] for row in rows if row["eval_success"] != "" and row["eval_return"] != ""]
    assert measured == ["2", "3"]  # every second, and the last
    assert curves(silent)[0] == curves(evaluated)[0] and curves(silent)[2] == curves(evaluated)[2]


DEMONSTRATED = dict(num_demos=4, recorded=(demo_arrays(), 18), lambda_bc=1.0)
VARIANTS = {
    "plain": {},
    "paper": DEMONSTRATED | dict(recipe="paper"),
    "robust": DEMONSTRATED | dict(recipe="robust", symmetry="so2", clone_iters=2, train_iters=4, demos_per_epoch=2),
}


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    return {name: scripted_run(tmp_path_factory.mktemp(name), name, **VARIANTS[name])[0] for name in VARIANTS}


@pytest.mark.parametrize("variant, number, at", [
    *(("plain", signal.SIGINT, at) for at in (5, 79, 80, 81)), ("plain", signal.SIGTERM, 119),
    *(("paper", signal.SIGINT, at) for at in (5, 40, 63)), *(("robust", signal.SIGTERM, at) for at in (39, 63)),
])  # fmt: skip
def test_an_interrupted_run_resumes_as_if_it_had_never_stopped(uninterrupted, world, variant, number, at):
    """Also while demonstrations still open epochs (the first four of paper, the first two of robust)."""

    def interrupt(n):
        if n == at:
            signal.raise_signal(number)

    folder, env = world("a", at_step=interrupt, **VARIANTS[variant])
    assert env.exit_code == 130 and len(env.steps) == at
    saved = torch.load(folder / "checkpoint.pt", weights_only=True)
    assert json.loads(saved["loop"])["t"] == at
    changes = VARIANTS[variant] | dict(recorded=None)  # what was recorded lies in the checkpoint
    folder, env = world("a", resume=True, **changes)
    assert env.exit_code is None and curves(folder) == curves(uninterrupted[variant])


@pytest.mark.parametrize("variant", ["plain", "paper"])
def test_a_finished_run_goes_on_with_more_epochs_as_if_asked_for_them_at_first(uninterrupted, world, variant):
    world("a", **VARIANTS[variant] | dict(epochs=2))
    folder, env = world("a", resume=True, **VARIANTS[variant])
    assert curves(folder) == curves(uninterrupted[variant]) and len(env.steps) < 120
    before = curves(folder)
    _, env = world("a", resume=True, **VARIANTS[variant])
    assert env.exit_code is None and env.steps == [] and curves(folder) == before  # nothing left to do


def test_after_a_run_an_interrupt_is_an_interrupt_again(world):
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    world("a", epochs=1)
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == before


@pytest.mark.parametrize("recipe", ["paper", "robust"])
@pytest.mark.parametrize("rate", ["pi_lr", "vf_lr"])
def test_a_run_that_turns_nan_stops_with_3_and_keeps_its_last_checkpoint(world, capsys, rate, recipe):
    epoch, calls = ppo.Learner.epoch, []

    def second_is_poisoned(self, *args):
        calls.append(1)
        if len(calls) == 2:
            self.optimizer.param_groups[("pi_lr", "vf_lr").index(rate)]["lr"] = math.inf
        return epoch(self, *args)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ppo.Learner, "epoch", second_is_poisoned)
        folder, env = world("a", recipe=recipe)
    err = capsys.readouterr().err
    assert env.exit_code == 3 and err.count("\n") == 1 and "NaN" in err
    assert "net" in torch.load(folder / "nan.pt", weights_only=True)
    kept = torch.load(folder / "checkpoint.pt", weights_only=True)
    assert json.loads(kept["loop"])["t"] == 40
    assert all(w.isfinite().all() for w in kept["learner"]["net"].values())


def test_quick_ends_with_test_trials_of_the_agent_and_of_the_demonstrator_and_a_film(tmp_path, monkeypatch, capsys):
    trials, shown = evaluate.run_trials, []
    monkeypatch.setattr(evaluate, "run_trials", lambda task, source, n, **kw: trials(task, source, 1, quiet=True))
    monkeypatch.setattr(evaluate, "show", lambda agents, trials, path: shown.append((agents, list(trials), path)))
    argv = "ppo_demoease.py --task p2p --quick --quiet --epochs 1 --steps_per_epoch 20 --num_demos 1 --hidden_sizes 8 "
    argv += f"--train_iters 2 --clone_iters 2 --max_ep_len 20 --eval_every 0 --name q --data_dir {tmp_path}"
    monkeypatch.setattr("sys.argv", argv.split())
    ppo.main()
    out = capsys.readouterr().out
    assert len(rows_of(tmp_path / "q" / "evaluation.csv")) == 1
    assert str(tmp_path / "q") in out and "PID, fast gains" in out
    folder = tmp_path / "q"
    assert shown == [({str(folder): ("p2p", folder)}, list(range(6)), folder / "agent.gif")]
