"""ddpg_demoease.py against the paper: the update against a plain reimplementation, what the loop stores, and when."""

import csv
import io
import json
import math
import signal
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
import torch
from torch import nn

import ddpg_demoease as ddpg
import evaluate
import gas
import pid_demo

TINY = dict(hidden_sizes=(16, 16), epochs=3, steps_per_epoch=40, max_ep_len=40, num_demos=0, lambda_bc=0.0, seed=3,
            start_steps=20, update_after=60, update_every=7, replay_size=1000, eval_every=0, checkpoint_every=1,
            quiet=True)  # fmt: skip


@pytest.fixture(autouse=True)
def as_main_does():
    """The process settings of main(), and the signal handlers that train() leaves behind put back."""
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    yield
    torch.set_num_threads(threads)
    torch.set_flush_denormal(False)
    for number, handler in handlers.items():
        signal.signal(number, handler)


def complete(**changes):
    return ddpg.complete(ddpg.Flags(**changes))[0]


def rows_of(path):
    return list(csv.DictReader(path.open()))


# ---- the update against the paper ------------------------------------------------------------------------------------


class Paper:
    """ag:d-ease-off, eq:loss_actor, eq:bc_gain and eq:mask_q in plain autograd with two torch.optim.Adam.

    Shares nothing with the source but the weights it starts from. The arguments from `layernorm` on are the parts of
    the robust recipe (clip: the range of targets).
    """

    def __init__(self, learner, obs_dim, hidden, gamma, omega, lambda_bc, pi_lr, q_lr, layernorm=False, clip=None,
                 normalize=False, conservative=0.0):  # fmt: skip
        self.gamma, self.omega, self.lambda_bc = gamma, omega, lambda_bc
        self.clip, self.normalize, self.conservative = clip, normalize, conservative

        def copy_of(source, n_in, n_out, norm):
            layers = []
            for n in hidden:
                layers += [nn.Linear(n_in, n)] + [nn.LayerNorm(n)] * norm + [nn.ReLU()]
                n_in = n
            net = nn.Sequential(*layers, nn.Linear(n_in, n_out))
            net.load_state_dict({name: w.clone() for name, w in source.state_dict().items()})  # strict
            return net

        self.u, self.u_target = (copy_of(nets.u, obs_dim, 4, False) for nets in (learner.net, learner.target))
        self.q, self.q_target = (copy_of(nets.q, obs_dim + 4, 1, layernorm) for nets in (learner.net, learner.target))
        self.mu, self.nu = list(self.u.parameters()), list(self.q.parameters())
        self.adam_mu, self.adam_nu = torch.optim.Adam(self.mu, lr=pi_lr), torch.optim.Adam(self.nu, lr=q_lr)
        self.pairs = [(self.u, learner.net.u), (self.u_target, learner.target.u)]
        self.pairs += [(self.q, learner.net.q), (self.q_target, learner.target.q)]

    def update(self, batch, demo):
        """One step. batch: (s, a, r, s2, zeta), demo: (s, a) or None. Returns its figures, floats by name."""
        s, a, r, s2, zeta = batch

        def value(q, s, a):
            return q(torch.cat([s, a], -1))[:, 0]

        def pi(s):
            return torch.tanh(self.u(s))

        with torch.no_grad():
            y = r + self.gamma * (1 - zeta) * value(self.q_target, s2, torch.tanh(self.u_target(s2)))
            if self.clip:
                y = torch.clip(y, self.clip[0], self.clip[1])
        Q, Q_pi = value(self.q, s, a), value(self.q, s, pi(s))
        L_C = torch.sum((y - Q) ** 2) / len(s)
        L_O = -torch.sum(Q_pi) / len(s)
        if self.normalize:
            L_O = L_O / abs(torch.sum(Q_pi) / len(s)).item()
        L_A, figures = L_O, {}
        if demo is not None:
            s_d, a_d = demo
            a_hat = pi(s_d)
            M = value(self.q, s_d, a_hat) < value(self.q, s_d, a_d)
            L_BC = torch.sum((a_d[M] - a_hat[M]) ** 2) / (4 * len(s_d))
            L_A = self.lambda_bc * L_BC + L_O
            if self.conservative:  # the weights of the critic alone see it
                Q_own, Q_demo = value(self.q, s_d, a_hat.detach()), value(self.q, s_d, a_d)
                L_C = L_C + self.conservative * torch.sum((Q_own - Q_demo)[~M]) / len(s_d)
            figures = {
                "L_BC": L_BC,
                "mask_fraction": M.float().mean(),
                "pretanh_demo": self.u(s_d).abs().mean(),
                "bc_relative_error": torch.mean((a_d - a_hat) ** 2) / torch.mean(a_d**2),
            }
        figures |= {"L_O": L_O, "L_C": L_C, "L_A": L_A, "Q_mean": Q.mean(), "Q_max": Q.max()}
        figures |= {"pretanh_own": self.u(s).abs().mean()}
        self.gradients = [torch.autograd.grad(L_A, self.mu, retain_graph=True), torch.autograd.grad(L_C, self.nu)]
        for parameters, gradients in zip((self.mu, self.nu), self.gradients, strict=True):
            for p, g in zip(parameters, gradients, strict=True):
                p.grad = g
        self.adam_mu.step()
        self.adam_nu.step()
        with torch.no_grad():
            for target, now in ((self.u_target, self.u), (self.q_target, self.q)):
                for p2, p in zip(target.parameters(), now.parameters(), strict=True):
                    p2.copy_(self.omega * p2 + (1 - self.omega) * p)
        return {name: value.item() for name, value in figures.items()}


def batch_of(n, obs_dim, generator, scale=4.0):
    """Random rows of a replay buffer as (rows, (s, a, r, s2, zeta)): a third of them true ends."""
    s, s2 = (0.7 * torch.randn(n, obs_dim, generator=generator) for _ in range(2))
    a = 2 * torch.rand(n, 4, generator=generator) - 1
    r = scale * torch.randn(n, generator=generator)
    zeta = (torch.rand(n, generator=generator) < 1 / 3).float()
    return torch.cat([s, a, r[:, None], s2, zeta[:, None]], dim=1), (s, a, r, s2, zeta)


PARTS = {  # flags of the source, and the same in the reimplementation
    "paper": (dict(recipe="paper"), dict()),
    "layernorm": (dict(critic_layernorm=True), dict(layernorm=True)),
    "clip": (dict(clip_target=True), dict(clip=True)),
    "normalize": (dict(normalize_q=True), dict(normalize=True)),
    "conservative": (dict(conservative=2.0), dict(conservative=2.0)),
    "robust": (dict(recipe="robust"), dict(layernorm=True, clip=True, normalize=True, conservative=0.5)),
}


@pytest.mark.parametrize("task, part, with_demos", [
    *(("p2p", part, True) for part in PARTS), ("p2p", "paper", False), ("p2p", "robust", False),
    ("pnp", "paper", True), ("pnp", "robust", True),
], ids=lambda x: ("with B_d" if x else "without B_d") if isinstance(x, bool) else x)  # fmt: skip
def test_updates_are_those_of_a_plain_reimplementation_of_the_paper(task, part, with_demos):
    torch.manual_seed(1)
    theirs, mine = PARTS[part]
    if "clip" in mine:
        mine = mine | dict(clip={"p2p": (-4, 10), "pnp": (-4, 12)}[task])
    hidden, obs_dim = (24, 40, 16), {"p2p": 22, "pnp": 25}[task]
    flags = complete(task=task, hidden_sizes=hidden, gamma=0.9, polyak=0.8, lambda_bc=1.3, pi_lr=2e-3, q_lr=5e-3,
                     **theirs)  # fmt: skip
    learner = ddpg.Learner(flags, obs_dim)
    paper = Paper(learner, obs_dim, hidden, 0.9, 0.8, 1.3, 2e-3, 5e-3, **mine)
    generator = torch.Generator().manual_seed(2)
    fractions = []
    for _ in range(6):
        rows, batch = batch_of(48, obs_dim, generator, scale=8.0)  # some targets are beyond the clip
        rows_demo, (s_d, a_d, *_) = batch_of(30, obs_dim, generator)
        expected = paper.update(batch, (s_d, a_d) if with_demos else None)
        measured = learner.update(rows, rows_demo if with_demos else None, measure=True)
        measured = {name: value.item() for name, value in measured.items()}
        for name, value in expected.items():
            assert measured.pop(name) == pytest.approx(value, rel=1e-4, abs=1e-5), name
        assert all(math.isnan(value) for value in measured.values())  # what needs B_d, without it
        fractions.append(expected.get("mask_fraction"))
        for net, gradients in zip((learner.net.u, learner.net.q), paper.gradients, strict=True):
            for p, g in zip(net.parameters(), gradients, strict=True):
                torch.testing.assert_close(p.grad, g, rtol=1e-3, atol=2e-6)
        for mine, theirs in paper.pairs:
            for p, q in zip(mine.parameters(), theirs.parameters(), strict=True):
                torch.testing.assert_close(q.detach(), p.detach(), rtol=0, atol=2e-5)
    if with_demos:
        assert min(fractions) > 0 and max(fractions) < 1  # the mask mattered


def test_an_update_moves_every_network_and_the_policy_that_is_saved_is_the_one_that_acts():
    flags = complete(recipe="robust", hidden_sizes=(16, 16))
    learner = ddpg.Learner(flags, 22)
    before = learner.state()
    rows, _ = batch_of(20, 22, torch.Generator().manual_seed(0))
    learner.update(rows, rows)
    after = learner.state()
    assert not torch.equal(before["net"], after["net"]) and not torch.equal(before["target"], after["target"])
    s = rows[0, :22]
    weights = learner.policy()["weights"]
    assert torch.equal(learner.actor(s), learner.net.u(s))
    assert all(torch.equal(weights[name], w) for name, w in learner.net.u.state_dict().items())


def test_a_saved_learner_goes_on_bit_for_bit():
    flags = complete(recipe="robust", hidden_sizes=(16, 16))
    generator = torch.Generator().manual_seed(0)
    batches = [batch_of(20, 22, generator)[0] for _ in range(6)]
    torch.manual_seed(0)
    learner = ddpg.Learner(flags, 22)
    for rows in batches[:3]:
        learner.update(rows, rows)
    torch.manual_seed(99)
    other = ddpg.Learner(flags, 22)
    file = io.BytesIO()
    torch.save(learner.state(), file)
    other.load(torch.load(io.BytesIO(file.getvalue()), weights_only=True))
    for rows in batches[3:]:
        learner.update(rows, rows)
        other.update(rows, rows)
    assert torch.equal(learner.net.flat, other.net.flat) and torch.equal(learner.target.flat, other.target.flat)


@pytest.mark.parametrize("left, weight", [(1.0, 0.8), (0.9, 0.48), (0.75, 0.0), (0.3, 0.0)])
def test_the_conservative_term_falls_to_0_over_the_first_quarter_of_the_run(left, weight, monkeypatch):
    weights, update = [], ddpg.Learner.update
    monkeypatch.setattr(ddpg.Learner, "update", lambda self, *a, **kw: weights.append(self.conservative)
                        or update(self, *a, **kw))  # fmt: skip
    learner, buffer = ddpg.Learner(complete(hidden_sizes=(8,), conservative=0.8), 22), ddpg.ReplayBuffer(22, 10)
    buffer.load({"rows": batch_of(10, 22, torch.Generator().manual_seed(0))[0], "next": 0})
    learner.block(buffer, buffer, 3, left)
    assert weights == [pytest.approx(weight)] * 3


def test_the_conservative_loss_is_how_far_the_critic_prefers_the_policys_action():
    Q_demo, Q_own = torch.tensor([1.0, 2.0, -1.0, -3.0]), torch.tensor([0.5, 2.0, -0.5, 3.0])
    assert ddpg.loss_conservative(Q_demo, Q_own).item() == pytest.approx(6.5 / 4)


@pytest.mark.parametrize("decay, left, factor", [(True, 0.25, 0.5), (True, 0.75, 1.0), (True, 0, 0), (False, 0.25, 1)])
def test_lr_decay_lets_both_learning_rates_fall_to_0_over_the_second_half_of_the_run(decay, left, factor):
    flags = complete(hidden_sizes=(8,), pi_lr=2e-3, q_lr=5e-3, lr_decay=decay, update_every=2, symmetry="none")
    learner, buffer = ddpg.Learner(flags, 22), ddpg.ReplayBuffer(22, 10)
    buffer.load({"rows": batch_of(10, 22, torch.Generator().manual_seed(0))[0], "next": 0})
    learner.block(buffer, buffer, 2, left)
    assert learner.lr == (2e-3 * factor, 5e-3 * factor)


# ---- losses ----------------------------------------------------------------------------------------------------------


def test_mask_picks_exactly_the_rows_where_the_demonstrated_action_is_worth_more():
    Q_demo, Q_own = torch.tensor([1.0, 2.0, -1.0, -3.0, 0.0]), torch.tensor([0.5, 2.0, -2.0, -2.0, 1e-6])
    assert ddpg.mask(Q_demo, Q_own).tolist() == [1, 0, 1, 0, 0]  # eq:mask_q: <, so not where they are equal


def test_bc_loss_averages_over_the_batch_and_the_four_actions():
    a_demo = torch.tensor([[1.0, 0, 0, 0], [0, 0.5, 0, 0], [1, 1, 1, 1]])
    a_hat = torch.tensor([[0.0, 0, 0, 1], [0, 0, 0, 0], [0, 0, 0, 0]])
    # rows: 2, 0.25 and (masked out) 4; over 3 rows of 4 actions
    assert ddpg.loss_BC(a_demo, a_hat, torch.tensor([1.0, 1, 0])).item() == pytest.approx(2.25 / 12)
    assert ddpg.loss_BC(a_demo, a_hat, torch.zeros(3)).item() == 0


def test_actor_loss_adds_lambda_times_the_cloning_loss():
    assert ddpg.loss_A(torch.tensor(2.0), torch.tensor(3.0), 1.5).item() == 6.5


def test_normalize_q_makes_the_loss_minus_or_plus_one_with_a_gradient_free_of_the_scale():
    gradients = []
    for scale in (0.1, 1.0, 1e4):
        Q = torch.tensor([1.0, 2.0, 6.0], requires_grad=True)
        L = ddpg.loss_O(scale * Q, True)
        assert L.item() == pytest.approx(-1)
        gradients.append(torch.autograd.grad(L, Q)[0])
        assert ddpg.loss_O(-scale * Q, True).item() == pytest.approx(1)
    for g in gradients:  # of -mean(Q) / 3 with the 3 held fixed; were it not detached, 0
        assert g.tolist() == pytest.approx([-1 / 9] * 3)


def test_without_normalize_q_the_loss_is_minus_the_mean():
    Q = torch.tensor([1.0, 2.0, 6.0], requires_grad=True)
    L = ddpg.loss_O(Q, False)
    assert L.item() == -3 and torch.autograd.grad(L, Q)[0].tolist() == pytest.approx([-1 / 3] * 3)


def one_target(zeta, reward, **changes):
    """(L_C of one transition under gamma 0.5 with this zeta and reward; Q(s, a); Q'(s', pi'(s'))). Small weights."""
    torch.manual_seed(0)
    task = changes.get("task", "p2p")
    width = 22 if task == "p2p" else 25
    flags = complete(gamma=0.5, hidden_sizes=(8,), **changes)
    learner = ddpg.Learner(flags, width)
    s, s2, a = torch.randn(1, width), torch.randn(1, width), torch.rand(1, 4)
    with torch.no_grad():
        Q, Q2 = learner.net.Q(s, a).item(), learner.target.Q(s2, learner.target.pi(s2)).item()
    rows = torch.cat([s, a, torch.tensor([[reward]]), s2, torch.tensor([[zeta]])], dim=1)
    return learner.update(rows, None, measure=True)["L_C"].item(), Q, Q2


def test_only_a_true_end_stops_bootstrapping():
    loss, Q, Q2 = one_target(0.0, 3.0)
    assert abs(Q2) > 1e-3 and loss == pytest.approx((3 + 0.5 * Q2 - Q) ** 2, rel=1e-4)
    loss, Q, Q2 = one_target(1.0, 3.0)
    assert loss == pytest.approx((3 - Q) ** 2, rel=1e-4)


@pytest.mark.parametrize("task, highest", [("p2p", 10.0), ("p2po", 10.0), ("pnp", 12.0)])
def test_clip_target_holds_targets_between_minus_four_and_the_largest_return(task, highest):
    for reward, y in ((100.0, highest), (11.0, min(11.0, highest)), (-100.0, -4.0), (-3.0, -3.0), (9.0, 9.0)):
        loss, Q, _ = one_target(1.0, reward, task=task, recipe="paper", clip_target=True)
        assert loss == pytest.approx((y - Q) ** 2, rel=1e-4)
    loss, Q, _ = one_target(1.0, 100.0, task=task, recipe="paper")
    assert loss == pytest.approx((100 - Q) ** 2, rel=1e-4)  # not in the printed algorithm


# ---- networks --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("layernorm", [True, False])
def test_layernorm_sits_after_each_hidden_linear_layer_of_the_critic_only(layernorm):
    net = ddpg.Learner(complete(hidden_sizes=(8, 12), critic_layernorm=layernorm), 22).net
    hidden = ["Linear", "LayerNorm", "ReLU"] if layernorm else ["Linear", "ReLU"]
    assert [type(layer).__name__ for layer in net.q] == 2 * hidden + ["Linear"]
    assert [type(layer).__name__ for layer in net.u] == 2 * ["Linear", "ReLU"] + ["Linear"]
    assert [p.shape[0] for p in net.u.parameters()] == [8, 8, 12, 12, 4, 4]
    s, a = torch.randn(5, 22), torch.rand(5, 4)
    with torch.no_grad():
        torch.testing.assert_close(net.Q(s, a), net.q(torch.cat((s, a), 1))[:, 0])
        torch.testing.assert_close(net.pi(s), torch.tanh(net.u(s)))


# ---- replay buffers --------------------------------------------------------------------------------------------------


def filled(n, size, obs_dim=22):
    """A ReplayBuffer that got n transitions; number i has reward i."""
    buffer = ddpg.ReplayBuffer(obs_dim, size)
    for i in range(n):
        buffer.store(np.full(obs_dim, i, np.float32), np.zeros(4, np.float32), i, np.full(obs_dim, -i), i % 3 == 0)
    return buffer


def test_the_ring_overwrites_the_oldest():
    buffer = filled(13, 5)
    assert sorted(buffer.sample(5, 200)[..., 26].unique().tolist()) == [8, 9, 10, 11, 12]
    buffer.store(np.zeros(22), np.zeros(4), 13, np.zeros(22), False)
    assert sorted(buffer.sample(5, 200)[..., 26].unique().tolist()) == [9, 10, 11, 12, 13]


def test_a_row_is_s_a_r_s2_zeta():
    buffer = ddpg.ReplayBuffer(22, 3)
    s, a, s2 = (np.random.default_rng(0).normal(size=n).astype(np.float32) for n in (22, 4, 22))
    buffer.store(s, a, -0.25, s2, True)
    assert buffer.sample(1, 1)[0, 0].tolist() == [*s.tolist(), *a.tolist(), -0.25, *s2.tolist(), 1.0]


@pytest.mark.parametrize("n", [1, 2, 3, 5, 9])
def test_a_row_of_n_steps_gives_the_discounted_rewards_and_the_value_n_steps_on(n):
    """Three episodes: a true end, a timeout, and one that goes on. gamma (1 - zeta) is what multiplies Q(s')."""
    gamma, buffer = 0.9, ddpg.ReplayBuffer(22, 50, n, 0.9)
    rng, episodes = np.random.default_rng(0), [(5, True, False), (4, False, True), (6, False, False)]
    expected = []
    for length, terminated, truncated in episodes:
        s, r, a = rng.normal(size=(length + 1, 22)), rng.normal(size=length), rng.uniform(-1, 1, (length, 4))
        for t in range(length):
            end = t == length - 1
            buffer.store(*(x.astype(np.float32) for x in (s[t], a[t])), r[t], s[t + 1].astype(np.float32),
                         terminated and end, truncated and end)  # fmt: skip
        for t in range(length if terminated or truncated else length - n + 1):
            m = min(n, length - t)
            discount = 0 if terminated and t + m == length else gamma**m
            expected.append((*s[t], *a[t], sum(gamma**i * r[t + i] for i in range(m)), *s[t + m], 1 - discount / gamma))
    assert len(expected) == buffer.filled >= 9
    np.testing.assert_allclose(buffer.rows[: buffer.filled], np.array(expected), rtol=1e-5, atol=1e-6)
    assert len(buffer.pending) == min(n - 1, 6)  # of the episode that goes on


def test_a_sample_draws_every_filled_row_alike_and_no_other():
    torch.manual_seed(0)
    rewards = filled(7, 50).sample(7, 2000)[..., 26]
    assert rewards.shape == (2000, 7)
    counts = torch.bincount(rewards.flatten().long(), minlength=7)
    assert len(counts) == 7 and (counts - 2000).abs().max() < 200  # 4.8 standard deviations


def test_a_batch_larger_than_what_is_stored_takes_as_many_as_are_stored():
    assert filled(7, 50).sample(100, 3).shape == (3, 7, 50)
    assert filled(70, 50).sample(100, 3).shape == (3, 50, 50)
    assert filled(70, 50).sample(20, 3).shape == (3, 20, 50)


def test_a_saved_ring_goes_on_where_it_was():
    for n in (3, 13):
        one, other = filled(n, 5), ddpg.ReplayBuffer(22, 5)
        other.load(one.state())
        for buffer in (one, other):
            for r in (100, 101, 102):
                buffer.store(np.zeros(22), np.zeros(4), r, np.zeros(22), False)
        assert torch.equal(one.rows, other.rows) and one.next == other.next and one.filled == other.filled


def states(n, obs_dim, seed=0):
    """Random states with sines and cosines that fit the angles."""
    rng = np.random.default_rng(seed)
    s = rng.normal(size=(n, obs_dim))
    s[:, :4] = rng.uniform(-math.pi, math.pi, (n, 4))
    s[:, 4:8], s[:, 8:12] = np.sin(s[:, :4]), np.cos(s[:, :4])
    return torch.from_numpy(s.astype(np.float32))


@pytest.mark.parametrize("obs_dim", [22, 25])
def test_turn_turns_s_and_s2_of_a_row_by_one_angle_and_every_row_by_its_own(obs_dim):
    torch.manual_seed(0)
    n, widths = 400, (obs_dim, 4, 1, obs_dim, 1)
    s, s2 = states(n, obs_dim), states(n, obs_dim, seed=1)
    kept = torch.rand(n, 4), torch.randn(n, 1), (torch.rand(n, 1) < 0.5).float()
    rows = torch.cat((s, kept[0], kept[1], s2, kept[2]), dim=1).view(4, 100, -1)  # a block of batches
    t, a, r, t2, zeta = ddpg.turn(rows, widths).view(n, -1).split(widths, dim=1)
    assert all(torch.equal(x, y) for x, y in zip((a, r, zeta), kept, strict=True))
    angle = s[:, 0] - t[:, 0]  # q_1 goes down where the world turns up
    for before, after in ((s, t), (s2, t2)):
        c, sn = torch.cos(angle), torch.sin(angle)
        expected = before.clone()
        expected[:, 0] = torch.remainder(before[:, 0] - angle + math.pi, 2 * math.pi) - math.pi
        expected[:, 4], expected[:, 8] = torch.sin(before[:, 0] - angle), torch.cos(before[:, 0] - angle)
        for i in range(16, obs_dim, 3):
            x, y = before[:, i], before[:, i + 1]
            expected[:, i], expected[:, i + 1] = c * x - sn * y, sn * x + c * y
        off = (after - expected).abs()
        off[:, 0] = torch.minimum(off[:, 0], (2 * math.pi - off[:, 0]).abs())
        assert off.max() < 1e-5
    turns = torch.remainder(angle, 2 * math.pi)
    assert len(turns.unique()) > 390
    assert (torch.histc(turns, 8, 0, 2 * math.pi) - 50).abs().max() < 32  # all round: 4.8 standard deviations


# ---- defaults --------------------------------------------------------------------------------------------------------

DEFAULTS = {  # by hand from tab:reward and the text above it; N, lambda, 5 T, 2 T and T from DESIGN
    "p2p": dict(max_ep_len=400, epochs=250, update_every=20, num_demos=100, lambda_bc=1.8, hidden_sizes=(128, 512, 128),
                steps_per_epoch=2000, start_steps=800, update_after=400),
    "p2po": dict(max_ep_len=500, epochs=500, update_every=25, num_demos=250, lambda_bc=2,
                 hidden_sizes=(256, 1024, 256), steps_per_epoch=2500, start_steps=1000, update_after=500),
    "pnp": dict(max_ep_len=800, num_demos=400, lambda_bc=15, hidden_sizes=(512, 512, 256), steps_per_epoch=4000,
                start_steps=1600, update_after=800),
}  # fmt: skip
BOTH_TASKS = dict(replay_size=10**6, batch_size=100, demo_batch_size=100, gamma=0.99, act_noise=0.1,
                  pi_lr=1e-3, q_lr=1e-3, partitions=4, seed=0, device="cpu", data_dir="data/runs")  # fmt: skip
RECIPES = {
    "paper": dict(symmetry="gas", gains="authors", critic_layernorm=False, clip_target=False, normalize_q=False,
                  lr_decay=False, polyak=0.995, demo_noise=0, conservative=0, n_step=1, updates_per_step=1),
    "robust": dict(symmetry="canonical", gains="fast", critic_layernorm=True, clip_target=True, normalize_q=True,
                   lr_decay=True, polyak=0.98, demo_noise=0.2, conservative=0.5, n_step=10, updates_per_step=0.25),
}  # fmt: skip


@pytest.mark.parametrize("recipe", [None, "paper", "robust"])
@pytest.mark.parametrize("task", DEFAULTS)
def test_defaults_are_those_of_the_papers_table_and_the_recipe(task, recipe):
    flags = vars(complete(task=task, recipe=recipe))
    expected = DEFAULTS[task] | BOTH_TASKS | RECIPES[recipe or "paper"] | {"recipe": recipe or "paper"}
    assert {name: flags[name] for name in expected} == expected
    assert None not in {name: value for name, value in flags.items() if name != "demos"}.values()


def test_quick_is_a_short_run_of_the_robust_recipe():
    flags = vars(complete(quick=True))
    expected = DEFAULTS["p2p"] | RECIPES["robust"] | dict(recipe="robust", epochs=25)
    assert {name: flags[name] for name in expected} == expected


def test_explicit_flags_win_over_quick_the_recipe_and_the_task():
    given = dict(epochs=3, recipe="paper", lambda_bc=0.0, num_demos=0, hidden_sizes=(8, 8), max_ep_len=50, gains="fast")
    flags = vars(complete(quick=True, **given))
    assert {name: flags[name] for name in given} == given
    assert flags["symmetry"] == "gas" and flags["steps_per_epoch"] == 250 and flags["update_every"] == 2
    given = dict(recipe="robust", symmetry="none", critic_layernorm=False, clip_target=False, normalize_q=False,
                 update_every=3, start_steps=0, update_after=0, steps_per_epoch=7)  # fmt: skip
    flags = vars(complete(**given))
    assert {name: flags[name] for name in given} == given and flags["gains"] == "fast"


def test_a_very_short_episode_still_updates():
    assert complete(max_ep_len=5).update_every == 1


@pytest.mark.parametrize("given, name", [
    (dict(), "p2p-ddpg-paper-N100-lambda1.8-gas-seed0"),
    (dict(recipe="robust", seed=7), "p2p-ddpg-robust-N100-lambda1.8-canonical-seed7"),
    (dict(task="p2po", symmetry="canonical", recipe="robust"), "p2po-ddpg-robust-N250-lambda2-canonical-seed0"),
    (dict(task="pnp", num_demos=15, lambda_bc=0.5), "pnp-ddpg-paper-N15-lambda0.5-gas-seed0"),
    (dict(num_demos=0, lambda_bc=0.0), "p2p-ddpg-paper-N0-lambda0-gas-seed0"),
    (dict(quick=True), "p2p-ddpg-robust-N100-lambda1.8-canonical-seed0-quick"),
    (dict(name="mine", seed=7), "mine"),
    (dict(epochs=9, data_dir="x", quiet=True, eval_every=0, resume=True), "p2p-ddpg-paper-N100-lambda1.8-gas-seed0"),
])  # fmt: skip
def test_the_default_name_says_task_algorithm_recipe_demonstrations_lambda_symmetry_and_seed(given, name):
    assert complete(**given).name == name


def test_the_default_names_of_runs_that_differ_in_any_setting_differ_and_can_be_folders(tmp_path):
    changes = dict(gamma=0.9, gains="fast", hidden_sizes=(8, 8), critic_layernorm=True, demos="some/where/demos.npz",
                   partitions=8, max_ep_len=100, update_every=3, start_steps=10, update_after=10, steps_per_epoch=300,
                   replay_size=500, batch_size=10, demo_batch_size=10, act_noise=0.2, polyak=0.9, pi_lr=1e-4, q_lr=1e-4,
                   clip_target=True, normalize_q=True, demo_noise=0.1, conservative=0.1, n_step=2,
                   updates_per_step=0.5)  # fmt: skip
    names = [complete().name] + [complete(**{key: value}).name for key, value in changes.items()]
    assert len(set(names)) == len(names)
    for name in (*names, complete(**changes).name):
        (tmp_path / name).mkdir()  # also with every flag of them at once: no longer than a file name may be


def test_a_variant_is_what_differs_from_the_recipe_beside_the_columns_and_lengths_of_the_tables():
    def variant(**given):
        return ddpg.complete(ddpg.Flags(**given))[1]

    for given in (dict(), dict(recipe="robust"), dict(task="pnp", seed=5, num_demos=7, lambda_bc=9.0, symmetry="so2"),
                  dict(epochs=3, quick=True, eval_every=1, checkpoint_every=1, data_dir="x", name="y"),
                  dict(gamma=0.99, hidden_sizes=[128, 512, 128], critic_layernorm=False)):  # fmt: skip
        assert variant(**given) == ""
    assert variant(gamma=0.9) == variant(gamma=0.9, seed=3, num_demos=0) != variant(gamma=0.8)
    assert "gamma" in variant(gamma=0.9) and "clip_target" in variant(clip_target=True)
    assert variant(recipe="robust", clip_target=True) == "" != variant(recipe="robust", clip_target=False)


# ---- training loop, on a scripted environment ------------------------------------------------------------------------


class Scripted:
    """What train() needs of an environment; all follows from the seed and the actions. Remembers every step."""

    observation_space = gymnasium.spaces.Box(-9, 9, (22,), np.float32)
    goal, tcp = (0.3, 0.4, 0.5), (0.0, 0.0, 0.5)

    def __init__(self):
        self.np_random, self.unwrapped, self.steps, self.at_step = np.random.default_rng(), self, [], None

    def reset(self, seed=None, options=None):
        if seed is not None:
            self.np_random = np.random.default_rng(seed)
        self.s = self.np_random.normal(size=22).astype(np.float32)
        self.left = int(self.np_random.integers(3, 25))
        self.end = ("timeout", "success", "self")[self.np_random.integers(3)]
        return self.s, {"distance": 1.0}

    def step(self, a):
        assert a.dtype == np.float32 and a.shape == (4,)
        if np.isnan(a).any():
            raise ValueError("NaN")  # as the real one does
        s, self.left = self.s, self.left - 1
        self.s = (0.95 * s + 0.2 * np.resize(a, 22)).astype(np.float32)
        end = "" if self.left else self.end
        r = float(self.s[5]) + (10 if end == "success" else 0)
        info = {"is_success": end == "success", "collision": "self" if end == "self" else "", "distance": 0.5,
                "effort": 1.0, "grasped": False}  # fmt: skip
        self.steps.append(SimpleNamespace(s=s, a=a.copy(), r=r, s2=self.s, terminated=end in ("success", "self"),
                                          truncated=end == "timeout", end=end))  # fmt: skip
        if self.at_step:
            self.at_step(len(self.steps))
        return self.s, r, self.steps[-1].terminated, end == "timeout", info

    def close(self):
        pass


def scripted_run(data_dir, name, at_step=None, **changes):
    """train() on a Scripted environment: (run folder, training environment with the exit code of the run)."""
    made = []

    def make(env_id, stage, **kwargs):
        made.append(Scripted())
        made[-1].stage, made[-1].at_step = stage, at_step if stage == "train" else None
        return made[-1]

    exit_code = None
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ddpg, "gymnasium", SimpleNamespace(make=make))
        try:
            ddpg.train(complete(**TINY | dict(name=name, data_dir=str(data_dir)) | changes))
        except SystemExit as stopped:
            exit_code = stopped.code
    env = next(env for env in made if env.stage == "train")
    env.exit_code = exit_code
    return data_dir / name, env


@pytest.fixture
def world(tmp_path):
    return lambda name, **changes: scripted_run(tmp_path, name, **changes)


@pytest.fixture(scope="session")
def plain(tmp_path_factory):
    """(folder, environment) of the run of TINY, from begin to end."""
    return scripted_run(tmp_path_factory.mktemp("plain"), "plain")


def stored(folder, buffer="B_o"):
    return torch.load(folder / "checkpoint.pt", weights_only=True)[buffer]["rows"]


def transitions(steps, view=lambda s: s):
    """The rows that a buffer of these steps holds."""
    rows = [np.concatenate([view(x.s), x.a, [x.r], view(x.s2), [x.terminated]]).astype(np.float32) for x in steps]
    return torch.from_numpy(np.stack(rows))


def curves(folder):
    """(episodes.csv, progress.csv without its wall-clock column, policy.pt): what two equal runs share byte by byte."""
    progress = rows_of(folder / "progress.csv")
    for row in progress:
        row.pop("seconds")
    return (folder / "episodes.csv").read_bytes(), progress, (folder / "policy.pt").read_bytes()


def test_what_is_stored_is_each_step_and_a_timeout_is_no_end(plain):
    folder, env = plain
    rows = stored(folder)
    assert torch.equal(rows, transitions(env.steps)) and len(rows) == 120
    zeta = dict.fromkeys(("", "timeout", "success", "self"))
    for x, row in zip(env.steps, rows, strict=True):
        zeta[x.end] = (zeta[x.end] or set()) | {row[-1].item()}
    assert zeta == {"": {0}, "timeout": {0}, "success": {1}, "self": {1}}


def test_a_timeout_of_the_real_environment_does_not_stop_bootstrapping(tmp_path):
    changes = dict(max_ep_len=15, update_after=999, start_steps=999, name="a", data_dir=str(tmp_path))
    folder = ddpg.train(complete(**TINY | changes))
    ends = [int(row["env_steps"]) for row in rows_of(folder / "episodes.csv")
            if row["success"] == "1" or row["collision"]]  # fmt: skip
    assert len(ends) < len(rows_of(folder / "episodes.csv")) >= 8  # most of them time out
    assert [t + 1 for t in range(120) if stored(folder)[t, -1]] == ends


@pytest.mark.parametrize("symmetry", ["none", "gas", "so2"])
def test_without_canonical_the_state_is_stored_as_it_is(world, symmetry):
    folder, env = world("a", symmetry=symmetry)
    assert torch.equal(stored(folder), transitions(env.steps))


def test_canonical_stores_the_states_in_the_arms_own_frame_and_acts_on_them(world):
    folder, env = world("a", symmetry="canonical", act_noise=0.0, update_after=999)
    rows = stored(folder)
    assert torch.equal(rows, transitions(env.steps, gas.canonical))
    assert rows[:, 0].unique().tolist() == [0] and not torch.equal(rows, transitions(env.steps))
    policy = evaluate.load_policy(folder)
    for x in env.steps[TINY["start_steps"] :]:
        assert np.array_equal(policy(x.s), x.a)


DEMO_ENDS = [("success", 6), ("self", 4), ("timeout", 5), ("left its sector", 3)]


def demo_arrays():
    """Four demonstrations, one of each end, as pid_demo.record gives them."""
    rng = np.random.default_rng(5)
    n = sum(length for _, length in DEMO_ENDS)
    last = np.cumsum([length for _, length in DEMO_ENDS]) - 1
    demos = dict(obs=states(n, 22, 1).numpy(), act=rng.uniform(-1, 1, (n, 4)).astype(np.float32),
                 rew=rng.normal(size=n), obs2=states(n, 22, 2).numpy(), terminated=np.zeros(n, bool),
                 truncated=np.zeros(n, bool), episode=np.repeat(np.arange(4), [length for _, length in DEMO_ENDS]),
                 partition=np.zeros(4, int), success=np.array([True, False, False, False]),
                 length=np.array([length for _, length in DEMO_ENDS]))  # fmt: skip
    demos["return"] = np.zeros(4)
    demos["terminated"][last[:2]] = True
    demos["truncated"][last[2:]] = True
    return demos


@pytest.mark.parametrize("symmetry", ["none", "canonical"])
def test_demonstrations_go_into_both_buffers_failed_ones_too(world, monkeypatch, symmetry):
    demos = demo_arrays()
    monkeypatch.setattr(pid_demo, "record", lambda *args, **kwargs: (demos, 18))
    folder, env = world("a", num_demos=4, symmetry=symmetry)
    view = gas.canonical if symmetry == "canonical" else lambda s: s
    names = ("s", "a", "r", "s2", "terminated")
    columns = (demos[name] for name in ("obs", "act", "rew", "obs2", "terminated"))
    steps = [SimpleNamespace(**dict(zip(names, row, strict=True))) for row in zip(*columns, strict=True)]
    expected = transitions(steps, view)
    assert torch.equal(stored(folder, "B_d"), expected)
    assert torch.equal(stored(folder), torch.cat((expected, transitions(env.steps, view))))
    assert expected[:, -1].nonzero().flatten().tolist() == [5, 9]  # neither timeout stops bootstrapping
    assert {row["demo_env_steps"] for row in rows_of(folder / "progress.csv")} == {"18"}


def test_B_o_holds_what_was_done_and_B_d_what_the_demonstrator_asked_for(world, monkeypatch):
    demos = demo_arrays()
    demos["executed"] = demos["act"] + 0.1
    monkeypatch.setattr(pid_demo, "record", lambda *args, **kwargs: (demos, 18))
    folder, _ = world("a", num_demos=4, symmetry="none")
    assert torch.equal(stored(folder, "B_d")[:, 22:26], torch.from_numpy(demos["act"]))
    assert torch.equal(stored(folder)[:18, 22:26], torch.from_numpy(demos["executed"]))


def test_windows_of_n_steps_end_with_their_demonstration_or_episode(world, monkeypatch):
    monkeypatch.setattr(pid_demo, "record", lambda *args, **kwargs: (demo_arrays(), 18))
    folder, env = world("a", num_demos=4, n_step=4, symmetry="none")
    rows, demos = stored(folder), demo_arrays()
    expected = ddpg.ReplayBuffer(22, 200, 4, TINY.get("gamma", 0.99))
    ended = np.isin(np.arange(18), np.cumsum(demos["length"]) - 1) & ~demos["terminated"]
    for row in zip(*(demos[name] for name in ("obs", "act", "rew", "obs2", "terminated")), ended, strict=True):
        expected.store(*row)
    assert expected.filled == 18 and expected.pending == []
    for x in env.steps:
        expected.store(x.s, x.a, x.r, x.s2, x.terminated, x.truncated)
    assert torch.equal(rows, expected.rows[: expected.filled]) and len(rows) > 18 + 110
    assert torch.equal(stored(folder, "B_d")[:, 26], torch.from_numpy(demos["rew"].astype(np.float32)))  # one step


def test_the_ring_of_a_run_keeps_the_newest_steps(world):
    folder, env = world("a", replay_size=50)
    kept = {tuple(row) for row in stored(folder).tolist()}
    assert kept == {tuple(row) for row in transitions(env.steps[-50:]).tolist()}


def test_without_demonstrations_it_is_plain_ddpg_whatever_lambda_is(plain, world):
    other, _ = world("a", num_demos=0, lambda_bc=5.0)
    assert curves(plain[0]) == curves(other)
    for row in rows_of(other / "progress.csv")[1:]:
        assert row["L_A"] == row["L_O"] != "" and row["L_BC"] == row["mask_fraction"] == row["pretanh_demo"] == ""
        assert row["bc_relative_error"] == ""


def test_updates_begin_after_update_after_and_come_in_blocks_of_update_every(world, monkeypatch):
    blocks, updates, batches = [], [], []
    block, update = ddpg.Learner.block, ddpg.Learner.update

    def counted_block(self, B_o, B_d, *args, **kwargs):
        updates.append(0)
        blocks.append(B_o.filled)
        return block(self, B_o, B_d, *args, **kwargs)

    def counted_update(self, rows, rows_demo, *args, **kwargs):
        updates[-1] += 1
        batches.append(rows.clone())
        return update(self, rows, rows_demo, *args, **kwargs)

    monkeypatch.setattr(ddpg.Learner, "block", counted_block)
    monkeypatch.setattr(ddpg.Learner, "update", counted_update)
    folder, env = world("a", update_after=60, update_every=7, batch_size=25)
    assert blocks == list(range(63, 121, 7)) and updates == [7] * len(blocks)
    of_buffer = {tuple(row) for row in transitions(env.steps).tolist()}
    assert all(len(batch) == 25 and {tuple(row) for row in batch.tolist()} <= of_buffer for batch in batches)
    assert len({tuple(batch.flatten().tolist()) for batch in batches}) == len(batches)  # each update draws anew
    for past, batch in zip(np.repeat(blocks, 7), batches, strict=True):
        assert {tuple(row) for row in batch.tolist()} <= {tuple(r) for r in transitions(env.steps[:past]).tolist()}


def test_updates_begin_at_update_after_itself_where_a_block_is_due(world, monkeypatch):
    blocks, block = [], ddpg.Learner.block
    monkeypatch.setattr(ddpg.Learner, "block", lambda *a, **kw: blocks.append(a[1].filled) or block(*a, **kw))
    world("a", update_after=28, update_every=7, epochs=1, steps_per_epoch=60)
    assert blocks == [28, 35, 42, 49, 56]


@pytest.mark.parametrize("per_step, updates", [(1, 63), (0.25, 15), (2, 126), (0.01, 1), (0.001, 0)])
def test_updates_keep_up_with_updates_per_step_times_the_steps(world, monkeypatch, per_step, updates):
    """Blocks at 63, 70, ..., 119: floor(0.25 * 119) - floor(0.25 * 56) = 15."""
    made, update = [], ddpg.Learner.update
    monkeypatch.setattr(ddpg.Learner, "update", lambda *a, **kw: made.append(0) or update(*a, **kw))
    world("a", update_after=60, update_every=7, updates_per_step=per_step)
    assert len(made) == updates


def test_there_is_no_update_before_the_first_row_of_n_steps(world):
    _, env = world("a", update_after=0, update_every=1, n_step=30)
    assert env.exit_code is None


@pytest.mark.parametrize("symmetry", ["so2", "none"])
def test_so2_turns_the_batches_of_both_buffers_and_nothing_else_does(world, monkeypatch, symmetry):
    batches, update = [], ddpg.Learner.update

    def noted(self, rows, rows_demo, *args, **kwargs):
        batches.append((rows.clone(), rows_demo.clone()))
        return update(self, rows, rows_demo, *args, **kwargs)

    monkeypatch.setattr(ddpg.Learner, "update", noted)
    monkeypatch.setattr(pid_demo, "record", lambda *args, **kwargs: (demo_arrays(), 18))
    folder, env = world("a", num_demos=4, symmetry=symmetry, epochs=1, update_after=20)
    for i, buffer in enumerate(("B_o", "B_d")):
        rows = torch.cat([batch[i] for batch in batches])
        found = {tuple(row[22:27].tolist()): row for row in stored(folder, buffer)}  # known again by their a and r
        original = torch.stack([found[tuple(row[22:27].tolist())] for row in rows])
        angle = original[:, 0] - rows[:, 0]
        for state in (slice(0, 22), slice(27, 49)):
            turned = gas.rotate(original[:, state], angle)
            torch.testing.assert_close(turned[:, 16:], rows[:, state][:, 16:], rtol=0, atol=1e-4)
        assert torch.equal(original[:, -1], rows[:, -1]) and len(rows) > 100
        assert (original != rows).any(dim=1).float().mean() == (symmetry == "so2")


def test_the_first_actions_are_uniform_and_the_policys_with_noise_come_after(world):
    folder, env = world("a", start_steps=90, update_after=999, act_noise=0.0, epochs=4)
    policy = evaluate.load_policy(folder)  # never updated: the one that acted
    first, then = env.steps[:90], env.steps[90:]
    assert all(np.array_equal(policy(x.s), x.a) for x in then)
    a = np.stack([x.a for x in first])
    assert a.min() < -0.95 and a.max() > 0.95 and np.abs(a).max() <= 1
    for joint in a.T:  # uniform: quarters of [-1, 1] alike
        assert np.histogram(joint, 4, (-1, 1))[0].min() >= 11


def test_exploration_noise_has_standard_deviation_sigma_and_actions_are_clipped(world):
    folder, env = world("a", start_steps=0, update_after=999, act_noise=0.1, epochs=12)
    policy = evaluate.load_policy(folder)
    clear = [x for x in env.steps if np.abs(policy(x.s)).max() < 0.6]
    noise = np.stack([x.a - policy(x.s) for x in clear])
    assert noise.size > 800 and abs(noise.mean()) < 0.02 and 0.09 < noise.std() < 0.11
    assert 0.6 < np.mean(np.abs(noise) < 0.1) < 0.76  # normal: 0.68
    _, env = world("b", start_steps=0, update_after=999, act_noise=3.0)
    a = np.stack([x.a for x in env.steps])
    assert np.abs(a).max() == 1 and 0.5 < np.mean(np.abs(a) == 1) < 0.95


def test_epochs_cut_nothing(world):
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


def test_a_row_of_progress_averages_its_own_epoch(world, monkeypatch):
    blocks, block = [], ddpg.Learner.block

    def noted(self, B_o, B_d, *args, **kwargs):
        blocks.append((B_o.filled, block(self, B_o, B_d, *args, **kwargs)))
        return blocks[-1][1]

    monkeypatch.setattr(ddpg.Learner, "block", noted)
    folder, _ = world("a", steps_per_epoch=20, epochs=6, checkpoint_every=9)
    episodes, progress = rows_of(folder / "episodes.csv"), rows_of(folder / "progress.csv")
    assert [int(row["epoch"]) for row in progress] == list(range(1, 7))
    for row in progress:
        begin, end = int(row["env_steps"]) - 20, int(row["env_steps"])
        assert end == 20 * int(row["epoch"])
        mine = [e for e in episodes if begin < int(e["env_steps"]) <= end]
        for column, name in (("EpRet", "return"), ("EpLen", "length"), ("Success", "success")):
            values = [float(e[name]) for e in mine]
            assert row[column] == "" if not mine else float(row[column]) == pytest.approx(np.mean(values), abs=1e-6)
        mine = [figures for t, figures in blocks if begin < t <= end]
        for name in ("L_O", "L_C", "L_A", "Q_mean", "Q_max", "pretanh_own"):
            values = [figures[name] for figures in mine]
            assert row[name] == "" if not mine else float(row[name]) == pytest.approx(np.mean(values), rel=1e-5)
    assert progress[0]["L_C"] == "" and progress[-1]["L_C"] != ""


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


@pytest.mark.parametrize("number, at", [*((signal.SIGINT, at) for at in (5, 63, 79, 80, 81, 119)),
                                        (signal.SIGTERM, 41)])  # fmt: skip
def test_an_interrupted_run_resumes_as_if_it_had_never_stopped(plain, world, number, at):
    """Also between the last update of an epoch (at 77) and its end (at 80)."""

    def interrupt(n):
        if n == at:
            signal.raise_signal(number)

    folder, env = world("a", at_step=interrupt)
    assert env.exit_code == 130 and len(env.steps) == at
    saved = torch.load(folder / "checkpoint.pt", weights_only=True)
    assert json.loads(saved["loop"])["t"] == at
    folder, env = world("a", resume=True)
    assert env.exit_code is None and curves(folder) == curves(plain[0])


@pytest.mark.parametrize("at", [3, 8, 63, 80, 81])
def test_the_rows_that_wait_for_their_n_steps_come_back_on_a_resume(world, at):
    """At 3 and 8 before n = 10 steps are done, else in the middle of windows."""
    whole, _ = world("whole", n_step=10)
    folder, env = world("a", n_step=10, at_step=lambda n: signal.raise_signal(signal.SIGINT) if n == at else None)
    assert env.exit_code == 130
    folder, env = world("a", n_step=10, resume=True)
    assert env.exit_code is None and curves(folder) == curves(whole)
    assert torch.equal(stored(folder), stored(whole))


def test_after_a_run_an_interrupt_is_an_interrupt_again(world):
    """As in the test trials that end a --quick run."""
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    world("a", epochs=1)
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == before


def test_a_finished_run_goes_on_with_more_epochs_as_if_asked_for_them_at_first(plain, world):
    _, (folder, env) = world("a", epochs=2), world("a", epochs=3, resume=True)
    assert curves(folder) == curves(plain[0]) and len(env.steps) < 120


def test_a_checkpoint_holds_the_filled_rows_alone(world):
    folder, _ = world("a", replay_size=1_000_000, epochs=1)
    assert (folder / "checkpoint.pt").stat().st_size < 200_000  # 40 rows of 50 numbers, and small networks


@pytest.mark.parametrize("update_every", [1, 7])
@pytest.mark.parametrize("rate", ["pi_lr", "q_lr"])
def test_a_run_that_turns_nan_stops_with_3_and_keeps_its_last_checkpoint(world, capsys, rate, update_every):
    changes = {rate: 1e30, "update_every": update_every, "update_after": 50, "start_steps": 0}
    folder, env = world("a", **changes)
    err = capsys.readouterr().err
    assert env.exit_code == 3 and err.count("\n") == 1 and "NaN" in err
    assert set(torch.load(folder / "nan.pt", weights_only=True)) >= {"net", "target"}
    kept = torch.load(folder / "checkpoint.pt", weights_only=True)
    assert json.loads(kept["loop"])["t"] == 40 and kept["learner"]["net"].isfinite().all()


def demo_file(path, demos, **meta):
    meta = dict(task="p2p", stage="demo", env_steps=len(demos["rew"]), gains=[1, 0.2, 0], seed=3, partitions=4,
                symmetry="none") | meta  # fmt: skip
    np.savez_compressed(path, **demos, meta=np.array(json.dumps(meta)))
    return str(path)


@pytest.mark.parametrize("symmetry", ["gas", "so2"])
def test_demonstrations_from_a_file_equal_recording_the_same(world, tmp_path, symmetry):
    settings = dict(num_demos=5, lambda_bc=1.8, gains="fast", symmetry=symmetry, epochs=1)
    recorded, steps = pid_demo.record("p2p", 5, "fast", seed=3, symmetry=symmetry)
    path = demo_file(tmp_path / "demos.npz", recorded, env_steps=steps, symmetry="gas" if symmetry == "gas" else "none")
    (own, _), (read, _) = world("a", **settings), world("b", demos=path, **settings)
    assert curves(own) == curves(read) and torch.equal(stored(own, "B_d"), stored(read, "B_d"))
    assert len(stored(own, "B_d")) == len(recorded["rew"]) > 100
    fewer, _ = world("c", demos=path, **settings | dict(num_demos=2))
    n = int(recorded["length"][:2].sum())
    assert torch.equal(stored(fewer, "B_d"), stored(own, "B_d")[:n])


def test_a_file_of_one_partition_is_mapped_to_all_by_gas(world, tmp_path):
    demos = demo_arrays()
    demos["partition"][1] = 2  # left out
    path = demo_file(tmp_path / "demos.npz", demos)
    folder, _ = world("a", demos=path, num_demos=12, symmetry="gas", epochs=1)
    rows, begin = stored(folder, "B_d"), 0
    for source in (0, 2, 3):
        mine = demos["episode"] == source
        for k in range(4):
            part = rows[begin : begin + mine.sum()]
            assert np.allclose(part[:, :22], gas.phi(demos["obs"][mine], k), atol=1e-6)
            assert np.allclose(part[:, 27:49], gas.phi(demos["obs2"][mine], k), atol=1e-6)
            assert np.array_equal(part[:, 22:26], demos["act"][mine])
            begin += mine.sum()
    assert begin == len(rows)


def test_gas_needs_a_real_episode_for_every_k_demonstrations_and_the_others_one_each(world):
    steps = {}
    for symmetry in ("gas", "none"):
        folder, _ = world(symmetry, num_demos=4, lambda_bc=1.0, symmetry=symmetry, gains="fast", epochs=1)
        row = rows_of(folder / "progress.csv")[0]
        steps[symmetry] = int(row["demo_env_steps"]), len(stored(folder, "B_d"))
    assert 4 * steps["gas"][0] == steps["gas"][1] and steps["none"][0] == steps["none"][1]


def test_quick_ends_with_test_trials_of_the_agent_and_of_the_demonstrator_and_a_film(tmp_path, monkeypatch, capsys):
    trials, shown = evaluate.run_trials, []
    monkeypatch.setattr(evaluate, "run_trials", lambda task, source, n, **kw: trials(task, source, 2, quiet=True))
    monkeypatch.setattr(evaluate, "show", lambda agents, trials, path: shown.append((agents, list(trials), path)))
    argv = "ddpg_demoease.py --quick --quiet --epochs 1 --steps_per_epoch 20 --num_demos 1 --hidden_sizes 8 --name q"
    monkeypatch.setattr("sys.argv", [*argv.split(), "--max_ep_len", "20", "--data_dir", str(tmp_path)])
    ddpg.main()
    out = capsys.readouterr().out
    assert len(rows_of(tmp_path / "q" / "evaluation.csv")) == 2
    assert str(tmp_path / "q") in out and "PID, fast gains" in out
    folder = tmp_path / "q"
    assert shown == [({str(folder): ("p2p", folder)}, list(range(6)), folder / "agent.gif")]
