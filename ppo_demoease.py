"""On-policy Demo-EASE (Alg. 2): PPO-Clip with demonstrations, masked cloning.

    python ppo_demoease.py --recipe robust                  # learns in minutes
    python ppo_demoease.py                                  # as published
    python ppo_demoease.py --num_demos 0 --lambda_bc 0      # plain PPO
    python ppo_demoease.py --seed 1 --resume                # where it stopped

`--recipe paper`, the default, is the algorithm as published (Table 2); where
table and algorithm are silent, the values are Spinning Up's or, where
DIFFERENCES.md says so, ours. `--recipe robust` changes a few things, each a
flag of its own. What they reach, in how many minutes, with how many seeds:
data/results/README.md. A run is a folder, DATA_DIR/NAME (logx.py).
"""

import math
from dataclasses import dataclass, replace

import gymnasium
import numpy as np
import torch
from torch import nn
from torch.distributions import Independent, Normal, kl_divergence
from tqdm import trange

import evaluate
import gas
import logx
import pid_demo
from kinova_env import OBS_DIM, TASKS, grasped
from logx import flag

ALGO = "ppo"  # in a run's name and the tables; a copy of this file is another algorithm, with another name

# ---- flags -----------------------------------------------------------------------------------------------------------


@dataclass
class Flags(logx.RunFlags):
    # the experiment
    task: str = flag("pnp", "the task", choices=tuple(TASKS))
    recipe: str | None = flag(None, "paper: as published (the default); robust: with our parts", ("paper", "robust"))
    num_demos: int | None = flag(None, "N_demos, in B_d; p2p 100, p2po 250, pnp 400, of --demos: all", low=0,
                                 high=1_000_000)  # fmt: skip
    lambda_bc: float | None = flag(None, "lambda_BC (Eq. 6); p2p 1.8, p2po 2, pnp 15", low=0)
    symmetry: str | None = flag(None, "see gas.py; paper: gas, robust: mirror", gas.SYMMETRIES)
    partitions: int = flag(4, "K", low=1, high=100)
    gains: str | None = flag(None, "the demonstrator's; paper: authors, robust: fast", tuple(pid_demo.GAINS))
    demos: str | None = flag(None, "a recording of pid_demo.py, or minari:NAME, in place of own ones", metavar="FILE")
    seed: int = flag(0, "of networks, exploration, goals and demonstrations", low=0, high=2**32 - 1)
    # length (Table 2)
    epochs: int = flag(50, "N_ep", low=1)
    steps_per_epoch: int = flag(4000, "N_o, the agent's own steps in B_o", low=1, high=10_000_000)
    max_ep_len: int | None = flag(None, "T of own episodes; p2p 400, p2po 500, pnp 800", low=1)
    # the algorithm (Table 2; pi_lr, vf_lr, log_std: spinningup; demos_per_epoch: ours)
    demos_per_epoch: int | None = flag(None, "demonstrations that open an epoch; N_demos / 5, robust: N_demos", low=1)
    train_iters: int = flag(20, "N_up, updates an epoch at most", low=1)
    batch_size: int = flag(800, "transitions of B_o in an update", low=1)
    demo_batch_size: int = flag(100, "transitions of B_d in an update", low=1)
    gamma: float = flag(0.99, "discount factor", low=0, high=1)
    lam: float = flag(0.97, "of the advantage estimates: lambda in Alg. 2, gamma^GAE in Table 2", low=0, high=1)
    clip_ratio: float = flag(0.2, "epsilon", low=0)
    target_kl: float = flag(
        0.02, "D_KL from the policy that acted, on own samples, that ends the updates; 0: before the first", low=0
    )
    pi_lr: float | None = flag(None, "of the actor; 3e-4, robust: 3e-6", low=0)
    vf_lr: float = flag(1e-3, "of the critic, and of both networks while cloning first", low=0)
    log_std: float | None = flag(None, "log sigma to begin with; -0.5, robust: -2", low=-20, high=5)
    hidden_sizes: tuple[int, ...] | None = flag(None, "of both networks; p2p 128 512 128, p2po 256 1024 256, pnp "
                                                "512 512 256", low=1, high=10_000)  # fmt: skip
    mask: str = flag("reward", "reward: Eq. 9; none: M = 1", ("reward", "none"))
    demos_in_B_o: bool | None = flag(None, "demonstrations go into B_o too (Alg. 2); robust: no")
    # the parts of the robust recipe (ours)
    demo_noise: float | None = flag(None, "of demonstrated actions (pid_demo.record); 0, robust: 0.2", low=0, high=10)
    clone_iters: int | None = flag(None, "updates on the first epoch's B_d before any step; 0, robust: 10000", low=0)
    grasp_input: bool | None = flag(None, "one more input: whether the cube is grasped, P_o = P_e; robust: on pnp")


TASK_DEFAULTS = {  # Sec. 4.2; N_demos, lambda: best columns of Tables 3 to 5
    "p2p": dict(num_demos=100, lambda_bc=1.8, hidden_sizes=(128, 512, 128)),
    "p2po": dict(num_demos=250, lambda_bc=2.0, hidden_sizes=(256, 1024, 256)),
    "pnp": dict(num_demos=400, lambda_bc=15.0, hidden_sizes=(512, 512, 256)),
}
PAPER = dict(symmetry="gas", gains="authors", pi_lr=3e-4, log_std=-0.5, demos_in_B_o=True, demo_noise=0.0,
             clone_iters=0, grasp_input=False)  # fmt: skip
ROBUST = PAPER | dict(symmetry="mirror", gains="fast", pi_lr=3e-6, log_std=-2.0, demos_in_B_o=False, demo_noise=0.2,
                      clone_iters=10_000, grasp_input=True)  # fmt: skip


def recipe_defaults(task, recipe, num_demos=None):
    """{flag: value} of all that task and recipe decide."""
    defaults = TASK_DEFAULTS[task] | (PAPER if recipe == "paper" else ROBUST)
    N = defaults["num_demos"] if num_demos is None else num_demos
    defaults["demos_per_epoch"] = max(1, math.ceil(N / 5) if recipe == "paper" else N)
    return defaults | {"max_ep_len": TASKS[task].horizon, "grasp_input": defaults["grasp_input"] and task == "pnp"}


def resolve(flags):
    """The flags with what task and recipe decide in place of None, and a name. Raises logx.BadInput."""
    flags = logx.check_flags(replace(flags, recipe=flags.recipe or ("robust" if flags.quick else "paper")))
    if flags.demos and flags.num_demos is None:
        flags = replace(flags, num_demos=pid_demo.all_of(flags, PAPER if flags.recipe == "paper" else ROBUST))
    defaults = recipe_defaults(flags.task, flags.recipe, flags.num_demos)
    flags = logx.fill_in(flags, defaults, ALGO)
    pid_demo.check_used(flags, defaults)
    if flags.grasp_input and flags.task != "pnp":
        raise logx.BadInput(f"--grasp_input: --task {flags.task} has nothing to grasp; allowed on --task pnp")
    if flags.demos_in_B_o and flags.demo_noise:
        raise logx.BadInput("--demos_in_B_o: B_o would not hold what was done where demonstrations are recorded with "
                            "noise; use --no-demos_in_B_o or --demo_noise 0")  # fmt: skip
    return flags


# ---- replay buffers (B_o, B_d) ---------------------------------------------------------------------------------------


class TrajectoryBuffer:
    """Transitions (s, a, r, s', zeta, end, own), one row each, in the order they were lived.

    zeta is 1 at a true end only; end is 1 on a trajectory's last row: there, at a timeout, where a demonstration leaves
    its sector, and where an epoch cuts it; own is 0 for the demonstrator's.
    """

    def __init__(self, obs_dim, size, symmetry):
        self.widths, self.symmetry = (obs_dim, 4, 1, obs_dim, 1, 1, 1), symmetry
        self.rows = torch.zeros(size, sum(self.widths))
        self.filled = 0

    def store(self, s, a, r, s2, zeta, end, own):
        """s, s2 (obs_dim,), a (4,), float32; r a number; the others booleans."""
        s, s2 = gas.seen(s, self.symmetry), gas.seen(s2, self.symmetry)
        row = np.concatenate((s, a, (r,), s2, (zeta, end, own)), dtype=np.float32, casting="same_kind")
        self.extend(torch.from_numpy(row[None]))

    def extend(self, rows):
        self.rows[self.filled : self.filled + len(rows)] = rows
        self.filled += len(rows)

    def columns(self, i=None, angle=None):
        """s, a, r, s', zeta, end, own of the rows i (all), each turned by its angle: (n, width), (n,) where
        that is 1."""
        rows = self.rows[: self.filled] if i is None else self.rows[i]
        s, a, r, s2, *rest = (x.squeeze(1) if x.shape[1] == 1 else x for x in rows.split(self.widths, dim=1))
        if angle is not None:
            s, s2 = gas.rotate(s, angle), gas.rotate(s2, angle)  # psi is the identity: a stays
        return s, a, r, s2, *rest


def discounted_sum(x, end, last, discount):
    """y_t = x_t + discount y_{t+1}, on a trajectory's last row x_t + discount last_t. All (M,)."""
    total, out = 0.0, []
    for x_t, ends, after in zip(*(column.flip(0).tolist() for column in (x, end, last)), strict=True):
        total = x_t + discount * (after if ends else total)
        out.append(total)
    return torch.tensor(out[::-1])


def advantages(r, end, V, last_V, gamma, lam):
    """A^_t by GAE (Alg. 2), mean 0 and deviation 1 over B_o (spinningup). All (M,)."""
    delta = r + gamma * torch.where(end > 0, last_V, V.roll(-1)) - V
    A = discounted_sum(delta, end, torch.zeros_like(delta), gamma * lam)
    return (A - A.mean()) / A.std(correction=0).clamp(min=1e-8)


def demonstration_buffer(demos, f):
    """B_d with room for all demonstrations, which lie in its rows, none shown yet (`filled` is 0). Their action is what
    the demonstrator asked for; with --demo_noise another one was done, and r and s' are of that."""
    columns = [demos[name] for name in ("obs", "act", "rew", "obs2", "terminated", "truncated")] if demos else [[]] * 6
    B = TrajectoryBuffer(OBS_DIM[f.task], len(columns[0]), f.symmetry)
    for s, a, r, s2, terminated, truncated in zip(*columns, strict=True):
        B.store(s, a, r, s2, terminated, terminated or truncated, own=False)
    B.filled = 0
    return B


# ---- networks --------------------------------------------------------------------------------------------------------


def mlp(sizes):
    layers = []
    for n_in, n_out in zip(sizes[:-2], sizes[1:-1], strict=True):
        layers += [nn.Linear(n_in, n_out), nn.ReLU()]
    return nn.Sequential(*layers, nn.Linear(sizes[-2], sizes[-1]))


class ActorCritic(nn.Module):
    """pi_omega: s -> N(mu, sigma), sigma the same in every state, and V_nu: s -> R; with grasp_input they have one more
    input, 1 where the cube is grasped, else 0."""

    def __init__(self, obs_dim, hidden_sizes, log_std, grasp_input):
        super().__init__()
        self.grasp_input = grasp_input
        self.mu_net = mlp([obs_dim + grasp_input, *hidden_sizes, 4])
        self.v_net = mlp([obs_dim + grasp_input, *hidden_sizes, 1])
        self.log_std = nn.Parameter(torch.full((4,), log_std))

    def inputs(self, s):
        return torch.cat((s, grasped(s).unsqueeze(-1).float()), dim=-1) if self.grasp_input else s

    def mu(self, s):
        """The mean action of s (n, obs_dim): (n, 4), not bounded."""
        return self.mu_net(self.inputs(s))

    def V(self, s):
        """V_nu of s (n, obs_dim): (n,)."""
        return self.v_net(self.inputs(s)).squeeze(-1)

    def pi(self, s):
        """pi_omega(.|s), a distribution, of s (n, obs_dim)."""
        return gaussian(self.mu(s), self.log_std.exp())


def gaussian(mu, sigma):
    """N(mu, sigma), the four actions independent. A weight that is NaN is found by logx, so not here."""
    return Independent(Normal(mu, sigma, validate_args=False), 1, validate_args=False)


# ---- losses ----------------------------------------------------------------------------------------------------------
# V, R, A, ratio and M are (n,), actions (n, 4); a loss is a scalar tensor. These are what backward() runs through.


def loss_C(V_s, R):
    """Alg. 2."""
    return ((V_s - R) ** 2).mean()


def loss_O(ratio, A, clip_ratio):
    """Alg. 2: r^omega_t and A^_t."""
    return -torch.min(ratio * A, ratio.clamp(1 - clip_ratio, 1 + clip_ratio) * A).mean()


def mask(V_demo, r_demo):
    """M_t, Eq. 9: 1 where the demonstrated reward is greater than the value of the state."""
    return (V_demo < r_demo).float()


def loss_BC(a_demo, a_hat, M):
    """Eq. 7, averaged over the batch and the 4 actions; of `clone` too, with M = 1."""
    return (M.unsqueeze(-1) * (a_demo - a_hat) ** 2).mean()


def loss_A(L_O, L_BC, lambda_bc):
    """Eq. 6."""
    return L_O + lambda_bc * L_BC


# ---- update ----------------------------------------------------------------------------------------------------------

MEASURED = ["L_O", "L_BC", "L_C", "L_A", "mask_fraction", "V_mean", "V_max", "mean_action_own", "mean_action_demo",
            "bc_relative_error", "KL", "sigma"]  # fmt: skip


class Learner:
    """Networks, optimiser, and the gradient steps of Alg. 2."""

    def __init__(self, flags):
        f = self.flags = flags
        self.net = ActorCritic(OBS_DIM[f.task], f.hidden_sizes, f.log_std, f.grasp_input).to(f.device)
        self.omega, self.nu = [*self.net.mu_net.parameters(), self.net.log_std], list(self.net.v_net.parameters())
        self.optimizer = self.adam(f.pi_lr, f.vf_lr)

    def adam(self, pi_lr, vf_lr):
        return torch.optim.Adam([dict(params=self.omega, lr=pi_lr), dict(params=self.nu, lr=vf_lr)], fused=True)

    @torch.inference_mode()
    def act(self, s):
        """mu and sigma of one observation, (4,) numpy each."""
        s = gas.seen(s, self.flags.symmetry)
        mu = self.net.mu(torch.from_numpy(s).to(self.flags.device))
        return mu.cpu().numpy(), self.net.log_std.exp().cpu().numpy()

    def demo_batch(self, B_d):
        """Rows i (n,) of B_d, drawn at random, and their s (n, obs_dim), a (n, 4), r (n,). so2 turns each at random,
        mirror reflects half of them."""
        i = torch.randint(B_d.filled, (min(self.flags.demo_batch_size, B_d.filled),))
        angle = 2 * math.pi * torch.rand(len(i)) if self.flags.symmetry == "so2" else None
        s, a, r, *_ = B_d.columns(i, angle)
        if self.flags.symmetry == "mirror":
            half = slice(None, None, 2)  # rows are drawn at random: this half of them is a random one
            s[half], a[half] = gas.mirror(s[half], a[half])
        return i, *(x.to(self.flags.device) for x in (s, a, r))

    def clone(self, B_d, stop_signals=()):
        """Before the first step: clone_iters updates on the first epoch's B_d, L_BC with M = 1 for the actor, L_C on
        the demonstrated rewards-to-go for the critic, both at the critic's rate, which falls to 0 (a cosine)."""
        f, net = self.flags, self.net
        _, _, r, *_, end, _ = B_d.columns()
        R = discounted_sum(r, end, torch.zeros_like(end), f.gamma)  # no V yet: nothing follows a timeout
        optimizer = self.adam(f.vf_lr, f.vf_lr)
        decay = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, f.clone_iters)
        for _ in trange(f.clone_iters, desc="cloning", disable=f.quiet or None):
            if stop_signals:
                raise KeyboardInterrupt(f"{f.name}: stopped while cloning; --resume begins it anew")
            i, s, a, r = self.demo_batch(B_d)
            loss = loss_BC(a, net.mu(s), torch.ones_like(r)) + loss_C(net.V(s), R[i].to(f.device))
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            decay.step()

    def updates(self, B_o, B_d):
        """At most N_up updates, an epoch's (B_d empty: no cloning). Returns {name: float}, means over them; None where
        target_kl let none through."""
        f, net = self.flags, self.net
        angle = None
        if f.symmetry == "so2":  # each trajectory turned by an angle of its own, as if it had been lived there
            *_, end, _ = B_o.columns()
            trajectory = torch.cat((torch.zeros(1), end[:-1])).cumsum(0).long()
            angle = (2 * math.pi * torch.rand(int(trajectory[-1]) + 1))[trajectory]
        s, a, r, s2, zeta, end, own = (x.to(f.device) for x in B_o.columns(angle=angle))
        with torch.no_grad():
            mu_old, sigma_old = net.mu(s), net.log_std.exp()
            log_prob_old = gaussian(mu_old, sigma_old).log_prob(a)
            V = net.V(s)
            last_V = torch.where(end > 0, (1 - zeta) * net.V(s2), 0.0)  # a timeout is no true end
        R = discounted_sum(r, end, last_V, f.gamma).to(f.device)
        A = advantages(r, end, V, last_V, f.gamma, f.lam).to(f.device)

        measured, nothing = [], torch.tensor(math.nan)
        for _ in range(f.train_iters):
            i = torch.randint(len(s), (min(f.batch_size, len(s)),)).to(f.device)
            pi, own_i = net.pi(s[i]), own[i] > 0
            with torch.no_grad():
                D_KL = kl_divergence(gaussian(mu_old[i], sigma_old), pi)[own_i].mean()
            if f.target_kl <= D_KL:  # NaN, of a batch without own samples, goes on
                break
            V_s = net.V(s[i])
            L_C = loss_C(V_s, R[i])
            ratio = (pi.log_prob(a[i]) - log_prob_old[i]).exp()
            L_O = loss_O(ratio, A[i], f.clip_ratio)
            if not B_d.filled:
                L_A, L_BC = L_O, nothing
                M = mean_action_demo = bc_relative_error = nothing
            else:
                _, s_demo, a_demo, r_demo = self.demo_batch(B_d)
                a_hat = net.mu(s_demo)
                with torch.no_grad():
                    M = mask(net.V(s_demo), r_demo) if f.mask == "reward" else torch.ones_like(r_demo)
                L_BC = loss_BC(a_demo, a_hat, M)
                L_A = loss_A(L_O, L_BC, f.lambda_bc)
                mean_action_demo = a_hat.abs().mean()
                bc_relative_error = ((a_hat - a_demo) ** 2).sum() / (a_demo**2).sum()

            self.optimizer.zero_grad()
            (L_C + L_A).backward()  # L_C moves the critic, L_A the actor
            self.optimizer.step()
            measured.append([x.detach() for x in (
                L_O, L_BC, L_C, L_A, M.mean(), V_s.mean(), V_s.max(),
                pi.mean[own_i].abs().mean(), mean_action_demo, bc_relative_error, D_KL, net.log_std.exp().mean(),
            )])  # fmt: skip
        if not measured:
            return None
        return dict(zip(MEASURED, torch.tensor(measured).nanmean(0).tolist(), strict=True))

    def state(self):
        return {"net": self.net.state_dict(), "optimizer": self.optimizer.state_dict()}

    def load(self, state):
        for name, part in state.items():
            getattr(self, name).load_state_dict(part)

    def policy(self):
        """What policy.pt holds."""
        return evaluate.pack_policy(self.flags, self.net, "linear")


# ---- training loop ---------------------------------------------------------------------------------------------------


def train(flags):
    """Runs Alg. 2 to the end, or on from the checkpoint. Returns the run's folder (Path). Raises logx.BadInput,
    logx.NotFinite, and KeyboardInterrupt with the state saved."""
    torch.set_num_threads(1)  # the networks are small: more threads would wait for each other
    torch.set_flush_denormal(True)
    flags = resolve(flags)
    with logx.RunFolder(flags, ALGO, MEASURED) as run:
        if not run.finished():
            loop(flags, run)
    return run.folder


def loop(f, run):
    demos, demo_env_steps = (None, 0) if run.checkpoint else pid_demo.demonstrations(f)
    if f.demos_in_B_o and demos and "executed" in demos:
        raise logx.BadInput(f"--demos {f.demos}: recorded with noise, so that B_o would not hold what was done; use "
                            "--no-demos_in_B_o")  # fmt: skip
    torch.manual_seed(f.seed)
    rng = np.random.default_rng(f.seed)  # of exploration
    env = gymnasium.make(TASKS[f.task].env_id, stage="train", max_episode_steps=f.max_ep_len, disable_env_checker=True)
    env = logx.Replayable(env, f.seed)
    learner = Learner(f)

    state = run.checkpoint
    B_d = demonstration_buffer(demos, f)
    if state:
        B_d.rows = state["demo_rows"]
    ends = [0, *(1 + torch.nonzero(B_d.rows[:, -2]).flatten()).tolist()]  # demonstration n: rows ends[n] to ends[n + 1]
    B_o = TrajectoryBuffer(OBS_DIM[f.task], f.steps_per_epoch + len(B_d.rows), f.symmetry)

    def open_epoch():
        """The next demonstrations, until B_d is full (Alg. 2)."""
        first = B_d.filled
        B_d.filled = ends[min(ends.index(first) + f.demos_per_epoch, len(ends) - 1)]
        if f.demos_in_B_o:
            B_o.extend(B_d.rows[first : B_d.filled])

    if state:
        t, s = state["t"], env.load(state["env"])
        learner.load(state["learner"])
        B_o.extend(state["B_o"])
        B_d.filled = state["shown"]
        rng.bit_generator.state = state["rng"]
        torch.set_rng_state(state["torch_rng"])
    else:
        t, (s, _) = 0, env.reset()
        open_epoch()
    run.begin(demo_env_steps)
    if demos and f.clone_iters:
        learner.clone(B_d, run.stop_signals)

    while t < run.total_steps:
        # act
        mu, sigma = learner.act(s)
        a = (mu + sigma * rng.standard_normal(4)).astype(np.float32)

        # step, store
        s2, r, terminated, truncated, info = env.step(a)
        t += 1
        cut = t % f.steps_per_epoch == 0  # of the trajectory, for the update; the episode goes on
        B_o.store(s, a, r, s2, terminated, terminated or truncated or cut, own=True)
        s = s2

        # reset
        if terminated or truncated:
            run.log_episode(t, info)
            s, _ = env.reset()

        # update, log
        if cut:
            if measured := learner.updates(B_o, B_d):
                run.log_updates(measured, learner.net)
            B_o.filled = 0
            open_epoch()
            run.log_epoch(t, lambda: evaluate.while_training(learner.policy(), f))
        if run.must_save(t):
            parts = {"learner": learner.state(), "B_o": B_o.rows[: B_o.filled].clone(), "demo_rows": B_d.rows,
                     "shown": B_d.filled, "env": env.state()}  # fmt: skip
            parts |= {"t": t, "rng": rng.bit_generator.state, "torch_rng": torch.get_rng_state()}
            run.save(parts, learner.policy())
            run.stop_if_asked(t)
    env.close()


def main():
    flags = resolve(logx.parse_flags(Flags, __doc__))
    folder = train(flags)
    if flags.quick:
        evaluate.after_training(folder, flags.task, flags.gains, flags.quiet)


if __name__ == "__main__":
    logx.run_script(main)
