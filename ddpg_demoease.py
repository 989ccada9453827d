"""Off-policy Demo-EASE: DDPG with a demonstration buffer and masked behaviour cloning (`ag:d-ease-off`, `tab:reward`).

    python ddpg_demoease.py --task p2p --quick                                 # a few minutes, to see it learn
    python ddpg_demoease.py --task p2p --recipe robust --epochs 50             # 100,000 steps
    python ddpg_demoease.py --task p2po --recipe robust --epochs 80            # 200,000 steps
    python ddpg_demoease.py --task p2p --recipe paper                          # as printed: 250 epochs, 500,000 steps
    python ddpg_demoease.py --task p2p --num_demos 0 --lambda_bc 0             # plain DDPG
    python ddpg_demoease.py --task p2p --seed 1 --resume                       # goes on where it was stopped

Two recipes. `paper` is the algorithm as printed. `robust` adds parts, each a flag of its own: targets of ten steps, a
critic that is conservative on demonstrations at first, noise while demonstrations are recorded, one update in four
steps, LayerNorm in the critic, targets clipped to possible returns, faster target networks, L_O divided by |mean Q|,
learning rates that fall to 0 in the second half, the faster PID gains, and the arm's own frame for the networks.
README.md has every measured figure, with the minutes it took, and the list of differences from the paper.
A run is a folder, DATA_DIR/NAME: see logx.py.
"""

import json
import math
import signal
import sys
from copy import deepcopy
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import gymnasium
import numpy as np
import torch
from torch import nn
from tqdm import tqdm

import evaluate
import gas
import logx
import pid_demo
from kinova_env import OBSERVATION, TASKS
from logx import flag

# ---- flags -----------------------------------------------------------------------------------------------------------


@dataclass
class Flags:
    # the experiment
    task: str = flag("p2p", choices=tuple(TASKS))
    recipe: str | None = flag(None, "paper (as printed; the default) or robust (the default of --quick)",
                              ("paper", "robust"))  # fmt: skip
    num_demos: int | None = flag(None, "N_demos, episodes in B_d; 100 on p2p, 250 on p2po, 400 on pnp", low=0)
    lambda_bc: float | None = flag(None, "lambda_BC (eq:loss_actor); 1.8 on p2p, 2 on p2po, 15 on pnp", low=0)
    symmetry: str | None = flag(None, "none; gas: demonstrations of one partition mapped to K (paper); so2: samples "
                                "turned by random angles; canonical: the networks see the arm's own frame",
                                ("none", "gas", "so2", "canonical"))  # fmt: skip
    partitions: int = flag(4, "K", low=1)
    gains: str | None = flag(None, "the demonstrator's; paper: authors, robust: fast", tuple(pid_demo.GAINS))
    demos: str | None = flag(None, "a file of pid_demo.py --record instead of own recordings")
    seed: int = flag(0, low=0, high=2**32 - 1)
    # length (tab:reward; 5 T steps an epoch is ours: the paper does not say)
    epochs: int | None = flag(None, "N_ep; 250 on p2p, 500 on p2po, 250 on pnp", low=1)
    steps_per_epoch: int | None = flag(None, "5 T", low=1)
    max_ep_len: int | None = flag(None, "T; 400, 500, 800", low=1)
    # the algorithm (tab:reward; start_steps and update_after: ours)
    update_every: int | None = flag(None, "N_up, steps between blocks of as many updates; T/20", low=1)
    start_steps: int | None = flag(None, "uniformly random actions first; 2 T", low=0)
    update_after: int | None = flag(None, "no updates before; T", low=0)
    replay_size: int = flag(1_000_000, "N_o", low=1)
    batch_size: int = flag(100, "of B_o", low=1)
    demo_batch_size: int = flag(100, "of B_d", low=1)
    gamma: float = flag(0.99, low=0, high=1)
    act_noise: float = flag(0.1, "sigma, standard deviation of the exploration noise", low=0)
    polyak: float | None = flag(None, "omega, target update coefficient; 0.995, robust: 0.98", low=0, high=1)
    pi_lr: float = flag(1e-3, "alpha_mu", low=0)
    q_lr: float = flag(1e-3, "alpha_nu", low=0)
    hidden_sizes: tuple[int, ...] | None = flag(None, "128 512 128 on p2p, 256 1024 256 on p2po, 512 512 256 on pnp",
                                                low=1)  # fmt: skip
    # the parts of the robust recipe (ours)
    demo_noise: float | None = flag(None, "standard deviation of noise on the actions that demonstrations are recorded "
                                    "with (pid_demo.record); 0, robust: 0.2", low=0)  # fmt: skip
    conservative: float | None = flag(None, "weight in L_C of loss_conservative at first; falls linearly to 0 over the "
                                      "run's first quarter; 0, robust: 0.5", low=0)  # fmt: skip
    n_step: int | None = flag(None, "rewards before the bootstrapped value in a target of B_o; 1, robust: 10", low=1)
    updates_per_step: float | None = flag(None, "gradient steps an environment step; 1, robust: 0.25", low=1e-6)
    critic_layernorm: bool | None = flag(None, "LayerNorm after each hidden layer of the critic")
    clip_target: bool | None = flag(None, "clip Bellman targets to the range of possible returns")
    normalize_q: bool | None = flag(None, "divide L_O by the detached |mean Q| of the batch")
    lr_decay: bool | None = flag(None, "both learning rates fall linearly to 0 over the second half of the run")
    # the run
    name: str | None = flag(None, "of the run's folder; says task, algorithm, recipe, N, lambda, symmetry and seed")
    data_dir: str = flag("data/runs", "where run folders lie")
    resume: bool = flag(False, "go on from the checkpoint, if there is one")
    device: str = flag("cpu", choices=("cpu", "cuda"))
    eval_every: int = flag(5, "epochs between test trials; 0 never", low=0)
    eval_trials: int = flag(50, low=1)
    checkpoint_every: int = flag(5, "epochs", low=1)
    quick: bool = flag(False, "a few minutes: the robust recipe, 25 epochs, then test trials and a GIF of the agent")
    quiet: bool = flag(False, "no progress bar and table")
    tensorboard: bool = flag(False)


BY_TASK = {  # tab:reward; pnp, which the paper gives to PPO: its sizes, 250 epochs (ours)
    "p2p": dict(max_ep_len=400, epochs=250, num_demos=100, lambda_bc=1.8, hidden_sizes=(128, 512, 128)),
    "p2po": dict(max_ep_len=500, epochs=500, num_demos=250, lambda_bc=2.0, hidden_sizes=(256, 1024, 256)),
    "pnp": dict(max_ep_len=800, epochs=250, num_demos=400, lambda_bc=15.0, hidden_sizes=(512, 512, 256)),
}
BY_RECIPE = {
    "paper": dict(symmetry="gas", gains="authors", demo_noise=0.0, conservative=0.0, n_step=1, updates_per_step=1.0,
                  critic_layernorm=False, clip_target=False, normalize_q=False, lr_decay=False, polyak=0.995),
    "robust": dict(symmetry="canonical", gains="fast", demo_noise=0.2, conservative=0.5, n_step=10,
                   updates_per_step=0.25, critic_layernorm=True, clip_target=True, normalize_q=True, lr_decay=True,
                   polyak=0.98),
}  # fmt: skip
QUICK = dict(recipe="robust", epochs=25)


def fill_in(flags):
    """The flags with what the task and the recipe decide in place of None."""
    recipe = flags.recipe or ("robust" if flags.quick else "paper")
    T = flags.max_ep_len or BY_TASK[flags.task]["max_ep_len"]
    schedule = dict(steps_per_epoch=5 * T, update_every=max(1, T // 20), start_steps=2 * T, update_after=T)
    defaults = BY_TASK[flags.task] | BY_RECIPE[recipe] | schedule | (QUICK if flags.quick else {}) | {"recipe": recipe}
    return replace(flags, **{key: value for key, value in defaults.items() if getattr(flags, key) is None})


def complete(flags):
    """(flags filled in, variant: what differs from the recipe); exits with 2 where a flag is out of range."""
    flags = fill_in(flags)
    flags.hidden_sizes = tuple(flags.hidden_sizes)
    logx.check_ranges(flags)
    printed = fill_in(Flags(task=flags.task, recipe=flags.recipe, quick=flags.quick))
    return flags, logx.name_run(flags, printed, "ddpg")


# ---- replay buffers (B_o, B_d) ---------------------------------------------------------------------------------------


class ReplayBuffer:
    """Transitions {s, a, r, s', zeta} in a ring, one row each, so that a batch is one gather.

    With n_step > 1 (ours) r is the discounted sum of m rewards, m = n_step or what is left of the episode, s' what
    came m steps later, and zeta = 1 - gamma^(m-1) (1 - its zeta), so that gamma (1 - zeta) is right for any m.
    """

    def __init__(self, obs_dim, size, n_step=1, gamma=1.0):
        self.rows = torch.zeros(size, 2 * obs_dim + 6)
        self.next, self.filled, self.size = 0, 0, size
        self.n_step, self.gamma, self.pending = n_step, gamma, []  # pending: s, a, r of the last steps of an episode

    def store(self, s, a, r, s2, terminated, truncated=False):
        """One step: s, s2 (obs_dim,), a (4,), float32. Its row is written once its n_step rewards are known."""
        self.pending.append((s, a, r))
        ended = terminated or truncated
        while self.pending and (ended or len(self.pending) == self.n_step):
            (s, a, _), m = self.pending[0], len(self.pending)
            r = sum(self.gamma**i * r for i, (_, _, r) in enumerate(self.pending))
            zeta = 1 - self.gamma ** (m - 1) * (1 - terminated)
            row = np.concatenate((s, a, (r,), s2, (zeta,)), dtype=np.float32, casting="same_kind")
            self.rows[self.next] = torch.from_numpy(row)
            self.next, self.filled = (self.next + 1) % self.size, min(self.filled + 1, self.size)
            del self.pending[0]

    def sample(self, batch_size, batches):
        """Rows (s, a, r, s', zeta) drawn uniformly, (batches, batch_size, width); zeta is 1 on a true end only."""
        i = torch.randint(self.filled, (batches * min(batch_size, self.filled),))
        return self.rows[i].view(batches, -1, self.rows.shape[1])

    def state(self):
        """For a checkpoint: all but `pending`, which the replayed episode gives back."""
        return {"rows": self.rows[: self.filled].clone(), "next": self.next}  # of a view, all would be stored

    def load(self, state):
        self.filled, self.next = len(state["rows"]), state["next"]
        self.rows[: self.filled] = state["rows"]


def turn(rows, widths):
    """Rows of a batch, each with its world turned by a random angle of its own (SO(2), gas.rotate)."""
    s, a, r, s2, zeta = rows.split(widths, dim=-1)
    angle = 2 * math.pi * torch.rand(rows.shape[:-1])
    return torch.cat((gas.rotate(s, angle), gas.psi(a, angle), r, gas.rotate(s2, angle), zeta), dim=-1)


# ---- networks --------------------------------------------------------------------------------------------------------


def mlp(sizes, layernorm=False):
    layers = []
    for n_in, n_out in zip(sizes[:-2], sizes[1:-1], strict=True):
        layers += [nn.Linear(n_in, n_out), *([nn.LayerNorm(n_out)] if layernorm else []), nn.ReLU()]
    return nn.Sequential(*layers, nn.Linear(sizes[-2], sizes[-1]))


class Passes:
    """Both passes through an mlp(), written out: for nets this small, autograd and modules cost as much as the matrix
    products. Its weights and gradients become views of the vectors flat and grad; matrices lie as (n_in, n_out)."""

    def __init__(self, module, flat, grad):
        self.layers, i = [], 0  # of each W, b, W_grad, b_grad, and where a LayerNorm follows, the same four of it
        for layer in module:
            weights, gradients = [], []
            for p in layer.parameters():
                part = slice(i, i := i + p.numel())
                w, g = (vector[part].view(p.t().shape) for vector in (flat, grad))
                p.data, p.grad = w.copy_(p.detach().t()).t(), g.t()
                weights.append(w)
                gradients.append(g)
            if isinstance(layer, nn.Linear):
                self.layers.append([])
            self.layers[-1] += weights + gradients

    def forward(self, x):
        """x (n, n_in) to (n, n_out), and what `backward` needs to know of the way."""
        tape = []
        for W, b, _, _, *norm in self.layers:
            tape.append([x])
            x = torch.addmm(b, x, W)
            if norm:
                tape[-1].append(x)
                x, mean, rstd = torch.native_layer_norm(x, b.shape, norm[0], norm[1], 1e-5)
                tape[-1] += [mean, rstd]
            if len(tape) < len(self.layers):
                x.relu_()
        return x, tape

    def backward(self, g, tape, first=0):
        """From the loss's gradient g (m, n_out) by the first m rows of the output: the weights', by rows `first` to m
        alone, into their places, and that by the rows of x before `first`, which is returned (first, n_in)."""
        m, y = len(g), None  # y: the layer's output
        for (W, b, W_grad, b_grad, *norm), (x, *before_norm) in zip(reversed(self.layers), reversed(tape), strict=True):
            if y is not None:
                torch.ops.aten.threshold_backward.grad_input(g, y[:m], 0, grad_input=g)  # relu
            if norm:
                z, mean, rstd = (t[:m] for t in before_norm)
                z_hat = (z[first:] - mean[first:]).mul_(rstd[first:])
                torch.sum(z_hat.mul_(g[first:]), 0, out=norm[2])
                torch.sum(g[first:], 0, out=norm[3])
                g, *_ = torch.ops.aten.native_layer_norm_backward(
                    g, z, b.shape, mean, rstd, norm[0], norm[1], (True, False, False)
                )
            torch.mm(x[first:m].t(), g[first:], out=W_grad)
            torch.sum(g[first:], 0, out=b_grad)
            if x is tape[0][0]:
                return torch.mm(g[:first], W.t())
            g, y = torch.mm(g, W.t()), x


class ActorCritic:
    """pi_mu: s -> a = tanh(u) in [-1, 1]^4, and Q_nu: (s, a) -> R. All weights, and all gradients, lie in one vector
    each (`flat`, `grad`; `parts` are mu's and nu's), so that optimiser and target update are one operation."""

    def __init__(self, obs_dim, hidden_sizes, critic_layernorm, device):
        self.u = mlp([obs_dim, *hidden_sizes, 4])  # pre-tanh
        self.q = mlp([obs_dim + 4, *hidden_sizes, 1], critic_layernorm)
        n_mu, n_nu = (sum(p.numel() for p in net.parameters()) for net in (self.u, self.q))
        self.flat, self.grad = torch.zeros(2, n_mu + n_nu, device=device)
        self.parts = slice(0, n_mu), slice(n_mu, None)
        self.mu, self.nu = (
            Passes(net.to(device), self.flat[part], self.grad[part])
            for net, part in zip((self.u, self.q), self.parts, strict=True)
        )

    @torch.no_grad()
    def pi(self, s):
        """pi_mu(s) of s (n, obs_dim): (n, 4)."""
        return self.mu.forward(s)[0].tanh_()

    @torch.no_grad()
    def Q(self, s, a):
        """Q_nu of (n, obs_dim) and (n, 4): (n,)."""
        return self.nu.forward(torch.cat((s, a), dim=1))[0].squeeze(1)


# ---- losses ----------------------------------------------------------------------------------------------------------
# Q, y and M are (n,), actions (n, 4); a loss is a scalar tensor.


def loss_C(Q_s_a, y):
    """ag:d-ease-off, with the stored action a_t where it prints pi(s_t)."""
    return ((Q_s_a - y) ** 2).mean()


def loss_conservative(Q_demo, Q_own):
    """Where the critic holds the policy's action better than the demonstrated one, by how much (ours, after Kumar et
    al., CQL, 2020): without it Q is largest at actions that nobody has tried, and the mask is 0 from the start."""
    return (Q_own - Q_demo).clamp(min=0).mean()


def loss_O(Q_s_pi, normalize_q):
    """ag:d-ease-off; normalize_q (ours) keeps its scale, so that lambda_BC means the same throughout training."""
    mean_Q = Q_s_pi.mean()
    return -mean_Q / mean_Q.abs().detach().clamp(min=1e-3) if normalize_q else -mean_Q


def mask(Q_demo, Q_own):
    """M_t, eq:mask_q: 1 where the demonstrated action is better than the policy's by the critic."""
    return (Q_own < Q_demo).float()


def loss_BC(a_demo, a_hat, M):
    """eq:bc_gain, averaged over the batch and the 4 actions."""
    return (M.unsqueeze(-1) * (a_demo - a_hat) ** 2).mean()


def loss_A(L_O, L_BC, lambda_bc):
    """eq:loss_actor."""
    return L_O + lambda_bc * L_BC


# ---- update ----------------------------------------------------------------------------------------------------------


class Learner:
    """Networks, targets, optimisers, and the gradient step of ag:d-ease-off."""

    def __init__(self, flags, obs_dim):
        self.flags, self.widths = flags, (obs_dim, 4, 1, obs_dim, 1)
        sizes = (obs_dim, flags.hidden_sizes, flags.critic_layernorm, flags.device)
        self.net, self.target = ActorCritic(*sizes), ActorCritic(*sizes)
        self.target.flat.copy_(self.net.flat)
        self.moments = torch.zeros(2, *self.net.flat.shape, device=flags.device)  # Adam's
        self.steps = torch.zeros((), device=flags.device)
        vectors = (self.net.flat, self.net.grad, *self.moments)
        self.adam = [[[x[part]] for x in vectors] + [[], [self.steps]] for part in self.net.parts]
        self.lr = (flags.pi_lr, flags.q_lr)
        self.actor = self.net.u if flags.device == "cpu" else deepcopy(self.net.u).cpu()  # what acts
        self.return_range = (-4.0, TASKS[flags.task].return_max)
        self.conservative = flags.conservative

    def block(self, B_o, B_d, n, left=1.0):
        """n updates (B_d None: no cloning). Returns the last one's measurements, floats by name.

        left: the fraction of the run that is still to come, for lr_decay and conservative.
        """
        f = self.flags
        self.conservative = f.conservative * max(0.0, 4 * left - 3)
        if f.lr_decay:
            self.lr = tuple(lr * min(1.0, 2 * left) for lr in (f.pi_lr, f.q_lr))
        rows, rows_demo = B_o.sample(f.batch_size, n), B_d.sample(f.demo_batch_size, n) if B_d else None
        if f.symmetry == "so2":  # each transition turned by an angle of its own
            rows = turn(rows, self.widths)
            rows_demo = turn(rows_demo, self.widths) if B_d else None
        rows = rows.to(f.device)
        batches = [(o, d) for o, d in zip(rows, rows_demo.to(f.device) if B_d else [None] * n, strict=True)]
        for rows, rows_demo in batches[:-1]:
            self.update(rows, rows_demo)
        measured = self.update(*batches[-1], measure=True)
        if self.actor is not self.net.u:
            with torch.no_grad():
                for p, q in zip(self.actor.parameters(), self.net.u.parameters(), strict=True):
                    p.copy_(q)
        return dict(zip(measured, torch.stack(list(measured.values())).tolist(), strict=True))

    @torch.inference_mode()
    def update(self, rows, rows_demo, measure=False):
        """One gradient step of ag:d-ease-off on a batch of B_o and one of B_d (or None). measure: returns tensors."""
        f = self.flags
        rows_demo = rows[:0] if rows_demo is None else rows_demo
        (s, a, r, s2, zeta), (s_demo, a_demo, *_) = (x.split(self.widths, dim=1) for x in (rows, rows_demo))
        n, n_demo = len(rows), len(rows_demo)

        y = r.squeeze(1) + f.gamma * (1 - zeta.squeeze(1)) * self.target.Q(s2, self.target.pi(s2))
        if f.clip_target:
            y = y.clamp(*self.return_range)
        u, tape_mu = self.net.mu.forward(torch.cat((s, s_demo)))
        a_pi, a_hat = (a_all := torch.tanh(u)).split((n, n_demo))
        # one pass of the critic, over (s, pi(s)), (s, a), (s_demo, pi(s_demo)), (s_demo, a_demo)
        x, x_demo = (x[:, : sum(self.widths[:2])] for x in (rows, rows_demo))
        x = torch.cat((x, x, x_demo, x_demo))
        x[:n, -4:], x[2 * n : 2 * n + n_demo, -4:] = a_pi, a_hat
        Q, tape_nu = self.net.nu.forward(x)
        Q_pi, Q_s_a, Q_own, Q_demo = Q.squeeze(1).split((n, n, n_demo, n_demo))
        M = mask(Q_demo, Q_own)

        # the gradient of L_C by Q(s, a) and of L_O by Q(s, pi(s)), then of L_O and lambda L_BC by the actions and by u
        scale = Q_pi.mean().abs().clamp(min=1e-3) if f.normalize_q else 1.0
        g_Q = [torch.full_like(Q_pi, -1 / n).div_(scale), (Q_s_a - y) * (2 / n)]
        if self.conservative and n_demo:
            too_good = (Q_own >= Q_demo) * (self.conservative / n_demo)
            g_Q += [too_good, -too_good]
        g_pi = self.net.nu.backward(torch.cat(g_Q).unsqueeze(1), tape_nu, first=n)[:, -4:]
        g_hat = (a_hat - a_demo) * (M * (f.lambda_bc / (2 * max(1, n_demo)))).unsqueeze(1)
        self.net.mu.backward(torch.cat((g_pi, g_hat)) * (1 - a_all * a_all), tape_mu)

        self.steps += 1
        for tensors, lr in zip(self.adam, self.lr, strict=True):  # torch.optim.Adam(fused=True), without its overhead
            torch._fused_adam_(*tensors, lr=lr, beta1=0.9, beta2=0.999, weight_decay=0, eps=1e-8, amsgrad=False,
                               maximize=False)  # fmt: skip
        self.target.flat.lerp_(self.net.flat, 1 - f.polyak)  # mu' <- omega mu' + (1 - omega) mu, nu' alike
        if not measure:
            return None
        L_C, L_O = loss_C(Q_s_a, y), loss_O(Q_pi, f.normalize_q)
        L_BC = loss_BC(a_demo, a_hat, M)
        if self.conservative and n_demo:
            L_C = L_C + self.conservative * loss_conservative(Q_demo, Q_own)
        return {
            "L_O": L_O,
            "L_BC": L_BC,
            "L_C": L_C,
            "L_A": loss_A(L_O, L_BC, f.lambda_bc) if n_demo else L_O,
            "mask_fraction": M.mean(),
            "Q_mean": Q_s_a.mean(),
            "Q_max": Q_s_a.max(),
            "pretanh_own": u[:n].abs().mean(),
            "pretanh_demo": u[n:].abs().mean(),
            # of the demonstrated actions' mean square: 0 is a perfect clone, 1 no better than a = 0
            "bc_relative_error": ((a_hat - a_demo) ** 2).sum() / (a_demo**2).sum(),
        }

    def state(self):
        return {
            "net": self.net.flat.cpu().clone(),
            "target": self.target.flat.cpu().clone(),
            "moments": self.moments.cpu().clone(),
            "steps": self.steps.item(),
        }

    def load(self, state):
        self.net.flat.copy_(state["net"])
        self.target.flat.copy_(state["target"])
        self.moments.copy_(state["moments"])
        self.steps.fill_(state["steps"])
        self.actor.load_state_dict(self.net.u.state_dict())

    def policy(self):
        """What policy.pt holds: see evaluate.Policy."""
        f = self.flags
        return {
            "task": f.task,
            "symmetry": f.symmetry,
            "sizes": [self.net.u[0].in_features, *f.hidden_sizes, 4],
            "output": "tanh",
            "weights": {name: w.detach().clone() for name, w in self.actor.state_dict().items()},
        }


# ---- training loop ---------------------------------------------------------------------------------------------------


def train(flags, variant=""):
    """Runs ag:d-ease-off to the end, or on from the checkpoint. Returns the run's folder."""
    config = asdict(flags) | {"algo": "ddpg", "variant": variant}
    folder = Path(flags.data_dir) / flags.name
    if logx.is_new(folder, flags.resume):  # before the folder is made: there is nothing to undo if --demos is no good
        try:
            demos, demo_env_steps = pid_demo.demonstrations(flags)
        except ValueError as error:
            logx.fail(f"--{error}")
        if demos and len(demos["rew"]) > flags.replay_size:
            n = len(demos["rew"])
            logx.fail(f"--replay_size {flags.replay_size}: holds less than the {n} demonstrated steps")
    torch.manual_seed(flags.seed)
    obs_dim = sum(width for _, width, _ in OBSERVATION[flags.task])
    try:
        learner = Learner(flags, obs_dim)
        B_o, B_d = ReplayBuffer(obs_dim, flags.replay_size, flags.n_step, flags.gamma), None
    except (RuntimeError, MemoryError):
        logx.fail(f"--hidden_sizes {flags.hidden_sizes} and --replay_size {flags.replay_size}: do not fit in memory")
    run = logx.Run(folder, config, flags.tensorboard)
    rng = np.random.default_rng(flags.seed)  # exploration
    make = dict(max_episode_steps=flags.max_ep_len, disable_env_checker=True)
    env = gymnasium.make(TASKS[flags.task].env_id, stage="train", **make)
    eval_env = gymnasium.make(TASKS[flags.task].env_id, stage="test", **make)
    view = gas.canonical if flags.symmetry == "canonical" else lambda obs: obs
    total_steps = flags.epochs * flags.steps_per_epoch

    if run.checkpoint:
        state = run.checkpoint
        loop = json.loads(state["loop"])
        if loop["t"] >= total_steps:
            print(f"{run.folder}: finished, {loop['t']} steps; more with --epochs")
            return run.folder
        learner.load(state["learner"])
        B_o.load(state["B_o"])
        if state["B_d"] is not None:
            B_d = ReplayBuffer(obs_dim, len(state["B_d"]["rows"]))
            B_d.load(state["B_d"])
        torch.set_rng_state(state["torch_rng"])
        rng.bit_generator.state = loop["rng"]
        # The unfinished episode is played again: the simulator's state is not enough to go on exactly.
        env.unwrapped.np_random.bit_generator.state = loop["episode_rng"]
        s, _ = env.reset()
        actions = list(state["episode_actions"].numpy())
        for a in actions:
            s2, r, *_ = env.step(a)
            B_o.pending.append((view(s), a, r))
            s = s2
        B_o.pending = B_o.pending[max(0, len(actions) + 1 - flags.n_step) :]  # the rest is stored
    else:
        if demos:
            B_d = ReplayBuffer(obs_dim, len(demos["rew"]))
            columns = ("obs", "act", "rew", "obs2", "terminated")
            done = demos.get("executed", demos["act"])  # not what the demonstrator asked for, where noise was added
            last = np.append(np.diff(demos["episode"]) != 0, True)  # of its episode
            rows = zip(*(demos[name] for name in columns), done, last, strict=True)
            for s, a, r, s2, terminated, a_done, ended in rows:
                B_d.store(view(s), a, r, view(s2), terminated)
                B_o.store(view(s), a_done, r, view(s2), terminated, ended)  # both buffers
        loop = {"t": 0, "episodes": 0, "demo_env_steps": demo_env_steps, "ep_ret": 0.0, "epoch_log": []}
        loop["epoch_episodes"] = []
        env.unwrapped.reset(seed=flags.seed)
        loop["episode_rng"] = env.unwrapped.np_random.bit_generator.state
        s, _ = env.reset()
        actions = []

    def save():
        loop["rng"] = rng.bit_generator.state
        run.save(
            {
                "learner": learner.state(),
                "B_o": B_o.state(),
                "B_d": B_d.state() if B_d else None,
                "torch_rng": torch.get_rng_state(),
                "episode_actions": torch.from_numpy(np.array(actions, dtype=np.float32).reshape(-1, 4)),
                "loop": json.dumps(loop),
            },
            config,
            learner.policy(),
        )

    def stop_at_nan(where):
        logx.atomic_write(run.folder / "nan.pt", lambda file: torch.save(learner.state(), file))
        print(f"{run.folder}: NaN in {where} at step {loop['t']}; networks saved to nan.pt", file=sys.stderr)
        raise SystemExit(3)

    stopped = []
    handlers = {number: signal.signal(number, lambda number, frame: stopped.append(number)) for number in STOP_SIGNALS}
    bar = tqdm(total=total_steps, initial=loop["t"], unit="step", disable=flags.quiet, smoothing=0.02, mininterval=1)
    if not flags.quiet:
        print(f"{run.folder}: {total_steps} steps, {loop['demo_env_steps']} of the demonstrator; Q at most "
              f"{TASKS[flags.task].return_max:g}\n" + TABLE.format(*TABLE_COLUMNS))  # fmt: skip
    while loop["t"] < total_steps:
        # act, step, store, advance
        if loop["t"] < flags.start_steps:
            a = rng.uniform(-1, 1, 4).astype(np.float32)
        else:
            with torch.inference_mode():
                a = torch.tanh(learner.actor(torch.from_numpy(view(s)))).numpy()
            a = np.clip(a + flags.act_noise * rng.standard_normal(4), -1, 1).astype(np.float32)
        if not np.all(np.isfinite(a)):
            stop_at_nan("the action")
        s2, r, terminated, truncated, info = env.step(a)
        B_o.store(view(s), a, r, view(s2), terminated, truncated)  # zeta: a timeout is no end to bootstrapping
        s = s2
        actions.append(a)
        loop["t"] += 1
        loop["ep_ret"] += r
        t = loop["t"]

        # reset
        if terminated or truncated:
            loop["episodes"] += 1
            episode = {
                "episode": loop["episodes"],
                "env_steps": t,
                "return": loop["ep_ret"],
                "length": len(actions),
                "success": int(info["is_success"]),
                "collision": info["collision"],
            }
            run.write("episodes", episode)
            loop["epoch_episodes"].append([episode["return"], episode["length"], episode["success"]])
            loop["episode_rng"] = env.unwrapped.np_random.bit_generator.state
            s, _ = env.reset()
            actions, loop["ep_ret"] = [], 0.0

        # update
        n = math.floor(flags.updates_per_step * t) - math.floor(flags.updates_per_step * (t - flags.update_every))
        if n and t >= flags.update_after and t % flags.update_every == 0 and B_o.filled:
            measured = learner.block(B_o, B_d, n, 1 - t / total_steps)
            loop["epoch_log"].append(measured)
            if not math.isfinite(measured["L_A"] + measured["L_C"]):
                stop_at_nan("a loss")
            bar.update(t - bar.n)

        # log
        if t % flags.steps_per_epoch == 0:
            epoch = t // flags.steps_per_epoch
            row = {"epoch": epoch, "env_steps": t, "demo_env_steps": loop["demo_env_steps"]}
            if loop["epoch_episodes"]:
                row |= zip(("EpRet", "EpLen", "Success"), np.mean(loop["epoch_episodes"], axis=0).tolist(), strict=True)
            if loop["epoch_log"]:
                row |= {key: float(np.mean([m[key] for m in loop["epoch_log"]])) for key in loop["epoch_log"][0]}
            if flags.eval_every and (epoch % flags.eval_every == 0 or t == total_steps):
                policy = evaluate.Policy(learner.policy())
                rows = [evaluate.trial(eval_env, policy, i)[0] for i in range(flags.eval_trials)]
                row["eval_success"] = float(np.mean([row["success"] for row in rows]))
                row["eval_return"] = float(np.mean([row["return"] for row in rows]))
            row["seconds"] = run.seconds()
            run.write("progress", row)
            loop["epoch_log"], loop["epoch_episodes"] = [], []
            if not flags.quiet:
                bar.write(TABLE.format(*(f"{row.get(c, math.nan):.4g}" for c in TABLE_COLUMNS)))
            if epoch % flags.checkpoint_every == 0 or t == total_steps:
                save()
        if stopped and t < total_steps:
            save()
            bar.close()
            print(f"{run.folder}: stopped at step {t}, state saved; go on with --resume", file=sys.stderr)
            raise SystemExit(130)
    bar.close()
    env.close()
    eval_env.close()
    for number, handler in handlers.items():
        signal.signal(number, handler)
    return run.folder


STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR2)  # the last is what Slurm sends before the time is up
TABLE_COLUMNS = ("epoch", "env_steps", "EpRet", "Success", "EpLen", "L_BC", "mask_fraction", "Q_mean", "Q_max",
                 "pretanh_own", "bc_relative_error", "eval_success")  # fmt: skip
TABLE = "{:>5} {:>9} {:>7} {:>7} {:>6} {:>9} {:>13} {:>7} {:>6} {:>11} {:>17} {:>12}"


def main():
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    flags, variant = complete(logx.parse_flags(Flags, __doc__))
    folder = train(flags, variant)
    if flags.quick:
        gains = flags.gains or "fast"
        agents = {str(folder): folder, f"PID, {gains} gains": gains}
        found = {name: evaluate.run_trials(flags.task, agent, 100, quiet=flags.quiet) for name, agent in agents.items()}
        evaluate.write(folder, *found[str(folder)])
        evaluate.print_table({name: rows for name, (rows, _) in found.items()})
        evaluate.show({str(folder): (flags.task, folder)}, range(6), folder / "agent.gif")
        print(f"wrote {folder / 'agent.gif'}")


if __name__ == "__main__":
    try:
        main()
    except KeyboardInterrupt:  # before or after the training loop, which saves its state and says so
        sys.exit(130)
