"""Off-policy Demo-EASE (Alg. 1): DDPG with demonstrations and masked cloning.

    python ddpg_demoease.py --task p2p --recipe robust      # learns in minutes
    python ddpg_demoease.py --task p2p                      # as published
    python ddpg_demoease.py --num_demos 0 --lambda_bc 0     # plain DDPG
    python ddpg_demoease.py --seed 1 --resume               # where it stopped

`--recipe paper`, the default, is the algorithm as published (Table 1); `robust`
changes settings and adds parts, each a flag. What they reach, in how many
minutes: data/results/README.md. Differences from the paper: DIFFERENCES.md.
"""

import math
from copy import deepcopy
from dataclasses import dataclass, replace

import gymnasium
import numpy as np
import torch
from torch import nn
from torch.optim.swa_utils import get_ema_multi_avg_fn
from tqdm import trange

import evaluate
import gas
import logx
import pid_demo
from kinova_env import OBS_DIM, TASKS, grasped
from logx import flag

ALGO = "ddpg"  # in a run's name and the tables; a copy of this file is another algorithm, with another name

# ---- flags -----------------------------------------------------------------------------------------------------------


@dataclass
class Flags(logx.RunFlags):
    # the experiment
    task: str = flag("p2p", "the task", choices=tuple(TASKS))
    recipe: str | None = flag(None, "paper: as published (the default); robust: with our parts", ("paper", "robust"))
    num_demos: int | None = flag(None, "N_demos, in B_d; p2p 100, p2po 250, pnp 400, of --demos: all", low=0,
                                 high=1_000_000)  # fmt: skip
    lambda_bc: float | None = flag(None, "lambda_BC (Eq. 6); p2p 1.8, p2po 2, pnp 15", low=0)
    symmetry: str | None = flag(None, "see gas.py; paper: gas, robust: mirror", gas.SYMMETRIES)
    partitions: int = flag(4, "K", low=1, high=100)
    gains: str | None = flag(None, "the demonstrator's; paper: authors, robust: fast", tuple(pid_demo.GAINS))
    demos: str | None = flag(None, "a recording of pid_demo.py, or minari:NAME, in place of own ones", metavar="FILE")
    seed: int = flag(0, "of networks, exploration, goals and demonstrations", low=0, high=2**32 - 1)
    # length (Table 1; 5 T steps an epoch: the authors' code)
    epochs: int | None = flag(None, "N_ep; p2p 250, p2po 500, pnp 250; robust: 25, 40, 25", low=1)
    steps_per_epoch: int | None = flag(None, "environment steps an epoch; 5 T, robust p2p: 1000", low=1)
    max_ep_len: int | None = flag(None, "T of own episodes; p2p 400, p2po 500, pnp 800", low=1)
    # the algorithm (Table 1; start_steps and update_after: the authors' code)
    update_every: int | None = flag(None, "N_up, steps between blocks of N_up * updates_per_step updates; T/20", low=1)
    start_steps: int | None = flag(None, "uniformly random actions first; 2 T, robust: 0", low=0)
    update_after: int | None = flag(None, "no updates before; T", low=0)
    replay_size: int = flag(1_000_000, "N_o", low=1, high=10_000_000)
    batch_size: int = flag(100, "transitions of B_o in an update", low=1)
    demo_batch_size: int = flag(100, "transitions of B_d in an update", low=1)
    gamma: float = flag(0.99, "discount factor", low=0, high=1)
    act_noise: float | None = flag(None, "sigma of the exploration noise; 0.1, robust: 0.2, on p2po 0.1", low=0,
                                   high=10)  # fmt: skip
    polyak: float = flag(0.995, "omega, target update coefficient", low=0, high=1)
    pi_lr: float | None = flag(None, "alpha_mu; 1e-3, robust: 3e-4", low=0)
    q_lr: float = flag(1e-3, "alpha_nu, and of the actor while cloning first", low=0)
    hidden_sizes: tuple[int, ...] | None = flag(None, "of both networks; p2p 128 512 128, p2po 256 1024 256, pnp "
                                                "512 512 256", low=1, high=10_000)  # fmt: skip
    mask: str = flag("q", "q: Eq. 8; none: M = 1", ("q", "none"))
    demos_in_B_o: bool = flag(True, "demonstrations go into B_o too (Sec. 3.3; Alg. 1 prints an empty B_o)")
    timeout_ends: bool = flag(False, "a timeout ends bootstrapping too (zeta as Sec. 3.2 prints it)")
    # the parts of the robust recipe (ours)
    demo_noise: float | None = flag(None, "of demonstrated actions (pid_demo.record); 0, robust: 0.2", low=0, high=10)
    noise_kept: float | None = flag(None, "of the noise, in the next step's; 0, robust: 0.9", low=0, high=1)
    n_step: int | None = flag(None, "rewards before the bootstrapped value in a target; 1, robust: 10", low=1)
    clone_iters: int | None = flag(None, "updates of the actor on B_d before the first step; 0, robust: 10000", low=0)
    keep_clone: float | None = flag(None, "weight of staying near that clone in states of B_o; 0, robust: 10", low=0)
    updates_per_step: float | None = flag(None, "gradient steps an environment step; 1, robust: 0.25", low=1e-6)
    normalize_obs: bool | None = flag(None, "states less the mean of B_d's, over their deviation; robust: on pnp")
    grasp_input: bool | None = flag(None, "one more input: whether the cube is grasped, P_o = P_e; robust: on pnp")


TASK_DEFAULTS = {  # Table 1, Sec. 4.2; N_demos, lambda: best columns of Tables 3 to 5; epochs of pnp: ours
    "p2p": dict(epochs=250, num_demos=100, lambda_bc=1.8, hidden_sizes=(128, 512, 128)),
    "p2po": dict(epochs=500, num_demos=250, lambda_bc=2.0, hidden_sizes=(256, 1024, 256)),
    "pnp": dict(epochs=250, num_demos=400, lambda_bc=15.0, hidden_sizes=(512, 512, 256)),
}
PAPER = dict(symmetry="gas", gains="authors", act_noise=0.1, pi_lr=1e-3, demo_noise=0.0, noise_kept=0.0, n_step=1,
             clone_iters=0, keep_clone=0.0, updates_per_step=1.0, normalize_obs=False, grasp_input=False)  # fmt: skip
ROBUST = PAPER | dict(symmetry="mirror", gains="fast", act_noise=0.2, pi_lr=3e-4, demo_noise=0.2, noise_kept=0.9,
                      n_step=10, clone_iters=10_000, keep_clone=10.0, updates_per_step=0.25, start_steps=0)  # fmt: skip
ROBUST_TASK = dict(p2p=dict(epochs=25, steps_per_epoch=1000), p2po=dict(epochs=40, act_noise=0.1),
                   pnp=dict(epochs=25, normalize_obs=True, grasp_input=True))  # fmt: skip


def recipe_defaults(task, recipe, max_ep_len=None, clone_iters=None):
    """{flag: value} of all that task and recipe decide."""
    T = max_ep_len or TASKS[task].horizon
    defaults = TASK_DEFAULTS[task] | dict(max_ep_len=TASKS[task].horizon, steps_per_epoch=5 * T)
    defaults |= dict(update_every=max(1, T // 20), start_steps=2 * T, update_after=T)
    defaults |= PAPER if recipe == "paper" else (ROBUST | ROBUST_TASK.get(task, {}))
    return defaults | ({"keep_clone": 0.0} if clone_iters == 0 else {})  # without a clone there is none to stay near


def resolve(flags):
    """The flags with what task and recipe decide in place of None, and a name. Raises logx.BadInput."""
    flags = logx.check_flags(replace(flags, recipe=flags.recipe or ("robust" if flags.quick else "paper")))
    if flags.demos and flags.num_demos is None:
        flags = replace(flags, num_demos=pid_demo.all_of(flags, PAPER if flags.recipe == "paper" else ROBUST))
    defaults = recipe_defaults(flags.task, flags.recipe, flags.max_ep_len, flags.clone_iters)
    flags = logx.fill_in(flags, defaults, ALGO)
    pid_demo.check_used(flags, defaults)
    if flags.grasp_input and flags.task != "pnp":
        raise logx.BadInput(f"--grasp_input: --task {flags.task} has nothing to grasp; allowed on --task pnp")
    if flags.noise_kept == 1:
        raise logx.BadInput("--noise_kept 1: leaves no new noise; less than 1 is allowed")
    if flags.keep_clone and not flags.clone_iters:
        raise logx.BadInput(f"--keep_clone {flags.keep_clone:g}: there is no clone at --clone_iters 0; 0 is allowed")
    return flags


# ---- replay buffers (B_o, B_d) ---------------------------------------------------------------------------------------


class ReplayBuffer:
    """Transitions (s, a, r, s', discount) in a ring; the value of s' counts for discount = gamma^n (1 - zeta).

    States are stored as `gas.seen` shows them. Of a sample, `so2` turns each row by a random angle, and `mirror`
    reflects every other row. `gas` does nothing here: its demonstrations were mapped before.
    """

    def __init__(self, obs_dim, size, symmetry):
        self.widths, self.symmetry = (obs_dim, 4, 1, obs_dim, 1), symmetry
        self.rows = torch.zeros(size, sum(self.widths))
        self.next, self.filled = 0, 0

    def store(self, s, a, r, s2, discount):
        """s, s2 (obs_dim,), a (4,), float32; r, discount numbers."""
        s, s2 = gas.seen(s, self.symmetry), gas.seen(s2, self.symmetry)
        row = np.concatenate((s, a, (r,), s2, (discount,)), dtype=np.float32, casting="same_kind")
        self.rows[self.next] = torch.from_numpy(row)
        self.next, self.filled = (self.next + 1) % len(self.rows), min(self.filled + 1, len(self.rows))

    def sample(self, batch_size, device):
        """s (n, obs_dim), a (n, 4), r (n,), s' (n, obs_dim), discount (n,), drawn uniformly."""
        i = torch.randint(self.filled, (min(batch_size, self.filled),))
        s, a, r, s2, discount = self.rows[i].split(self.widths, dim=1)
        if self.symmetry == "so2":
            angle = 2 * math.pi * torch.rand(len(i))
            s, s2 = gas.rotate(s, angle), gas.rotate(s2, angle)  # psi is the identity: a stays
        if self.symmetry == "mirror":
            half = slice(None, None, 2)  # rows are drawn at random: this half of them is a random one
            (s[half], s2[half]), a[half] = gas.mirror(torch.stack((s[half], s2[half])), a[half])
        return [x.to(device) for x in (s, a, r.squeeze(1), s2, discount.squeeze(1))]

    def state(self):
        return {"rows": self.rows[: self.filled].clone(), "next": self.next}  # of a view, all would be stored

    def load(self, state):
        self.filled, self.next = len(state["rows"]), state["next"]
        self.rows[: self.filled] = state["rows"]


def n_step_sum(steps, gamma, timeout_ends=False):
    """Consecutive steps (s, a, r, s', terminated, truncated) as one transition: the first s and a, the discounted sum
    of r, the last s', and gamma^n (1 - zeta). Only a true end stops bootstrapping, unless timeout_ends."""
    s, a, *_ = steps[0]
    s2, terminated, truncated = steps[-1][3:]
    zeta = terminated or (timeout_ends and truncated)
    return s, a, sum(gamma**i * step[2] for i, step in enumerate(steps)), s2, gamma ** len(steps) * (1 - zeta)


def store_last_step(B, episode, n, gamma, timeout_ends=False):
    """Stores the transition of the episode's last n steps; at its end the shorter ones too."""
    ended = episode[-1][4] or episode[-1][5]
    for m in range(min(n, len(episode)), 0 if ended else n - 1, -1):
        B.store(*n_step_sum(episode[-m:], gamma, timeout_ends))


def store_demonstrations(demos, B_o, B_d, f):
    """B_d gets what the demonstrator asked for, B_o what was done, which is another thing where noise was added: then
    Eq. 8 asks the critic about actions that it has not seen. Of B_d, s and a alone are used: r is of what was done."""
    episode, columns = [], [demos[name] for name in ("obs", "act", "rew", "obs2", "terminated", "truncated")]
    for (s, a, *rest), executed in zip(zip(*columns, strict=True), demos.get("executed", demos["act"]), strict=True):
        B_d.store(*n_step_sum([(s, a, *rest)], f.gamma, f.timeout_ends))
        episode.append((s, executed, *rest))
        if f.demos_in_B_o:
            store_last_step(B_o, episode, f.n_step, f.gamma, f.timeout_ends)
        if episode[-1][4] or episode[-1][5]:
            episode = []


# ---- networks --------------------------------------------------------------------------------------------------------


def mlp(sizes):
    layers = []
    for n_in, n_out in zip(sizes[:-2], sizes[1:-1], strict=True):
        layers += [nn.Linear(n_in, n_out), nn.ReLU()]
    return nn.Sequential(*layers, nn.Linear(sizes[-2], sizes[-1]))


class ActorCritic(nn.Module):
    """pi_mu: s -> a in [-1, 1]^4, and Q_nu: (s, a) -> R, on (s - s_mean) / s_std, and with grasp_input on 1 where the
    cube is grasped, else 0."""

    def __init__(self, obs_dim, hidden_sizes, grasp_input):
        super().__init__()
        self.grasp_input = grasp_input
        self.mu_net = mlp([obs_dim + grasp_input, *hidden_sizes, 4])
        self.q_net = mlp([obs_dim + grasp_input + 4, *hidden_sizes, 1])
        self.register_buffer("s_mean", torch.zeros(obs_dim))
        self.register_buffer("s_std", torch.ones(obs_dim))

    def inputs(self, s):
        x = (s - self.s_mean) / self.s_std
        return torch.cat((x, grasped(s).unsqueeze(-1).float()), dim=-1) if self.grasp_input else x

    def pi(self, s):
        """pi_mu(s) of s (n, obs_dim): (n, 4). mu_net gives the action before its tanh."""
        return torch.tanh(self.mu_net(self.inputs(s)))

    def Q(self, s, a):
        """Q_nu of s (n, obs_dim), a (n, 4): (n,)."""
        return self.q_net(torch.cat((self.inputs(s), a), dim=-1)).squeeze(-1)


# ---- losses ----------------------------------------------------------------------------------------------------------
# Q, y and M are (n,), actions (n, 4); a loss is a scalar tensor. These are what backward() runs through.


def loss_C(Q_s_a, y):
    """Alg. 1, with the stored action a_t where it prints pi(s_t)."""
    return ((Q_s_a - y) ** 2).mean()


def loss_O(Q_s_pi):
    """Alg. 1."""
    return -Q_s_pi.mean()


def mask(Q_demo, Q_own):
    """M_t, Eq. 8: 1 where the demonstrated action is better than the policy's by the critic."""
    return (Q_own < Q_demo).float()


def loss_BC(a_demo, a_hat, M):
    """Eq. 7, averaged over the batch and the 4 actions; of `clone` too, with M = 1."""
    return (M.unsqueeze(-1) * (a_demo - a_hat) ** 2).mean()


def loss_A(L_O, L_BC, lambda_bc):
    """Eq. 6."""
    return L_O + lambda_bc * L_BC


def loss_keep(a_clone, a_own):
    """Ours: how far the actions in states of B_o are from the first clone's, averaged over the batch and the 4 actions.
    --keep_clone times this is added to Eq. 6."""
    return ((a_clone - a_own) ** 2).mean()


# ---- update ----------------------------------------------------------------------------------------------------------

MEASURED = ["L_O", "L_BC", "L_keep", "L_C", "L_A", "mask_fraction", "Q_mean", "Q_max", "pretanh_own", "pretanh_demo",
            "bc_relative_error"]  # fmt: skip


class Learner:
    """Networks, targets, optimiser, and the gradient step of Alg. 1."""

    def __init__(self, flags):
        f = self.flags = flags
        self.net = ActorCritic(OBS_DIM[f.task], f.hidden_sizes, f.grasp_input).to(f.device)
        self.target = deepcopy(self.net).requires_grad_(False)
        self.clone_net = deepcopy(self.net.mu_net).requires_grad_(False)  # stays as it is after clone()
        self.mu, self.nu = list(self.net.mu_net.parameters()), list(self.net.q_net.parameters())
        groups = dict(params=self.mu, lr=f.pi_lr), dict(params=self.nu, lr=f.q_lr)
        self.optimizer = torch.optim.Adam(groups, fused=True)
        self.move_targets = get_ema_multi_avg_fn(f.polyak)

    @torch.inference_mode()
    def act(self, s):
        """pi_mu of one observation of the environment: (4,) numpy."""
        s = gas.seen(s, self.flags.symmetry)
        return self.net.pi(torch.from_numpy(s).to(self.flags.device)).cpu().numpy()

    def updates(self, B_o, B_d, n):
        """n gradient steps. Returns {name: float} of the last one; what needs demonstrations is NaN without them."""
        for _ in range(n):
            measured = self.update(B_o, B_d)
        return dict(zip(MEASURED, torch.stack(measured).tolist(), strict=True))

    def update(self, B_o, B_d):
        """One gradient step on a batch of B_o and one of B_d (None: no cloning). Returns MEASURED, tensors."""
        f, net = self.flags, self.net
        s, a, r, s2, discount = B_o.sample(f.batch_size, f.device)
        with torch.no_grad():  # y is a constant: no gradient through the targets
            y = r + discount * self.target.Q(s2, self.target.pi(s2))
        Q = net.Q(s, a)
        L_C = loss_C(Q, y)

        s_demo, a_demo, *_ = B_d.sample(f.demo_batch_size, f.device) if B_d else (s[:0], a[:0])
        x = net.inputs(torch.cat((s, s_demo)))  # one pass costs less than two
        u, u_demo = net.mu_net(x).split((len(s), len(s_demo)))
        a_own, a_hat = torch.tanh(u), torch.tanh(u_demo)
        L_O = loss_O(net.Q(s, a_own))
        with torch.no_grad():
            Q_demo, Q_own = net.Q(s_demo, a_demo), net.Q(s_demo, a_hat)
            M = mask(Q_demo, Q_own) if f.mask == "q" else torch.ones_like(Q_demo)
        L_BC = loss_BC(a_demo, a_hat, M)  # without demonstrations NaN, as their other figures: not measured
        L_A = loss_A(L_O, L_BC, f.lambda_bc) if B_d else L_O
        L_keep = torch.full_like(L_O, math.nan)
        if f.keep_clone and B_d:
            L_keep = loss_keep(torch.tanh(self.clone_net(x[: len(s)])), a_own)
            L_A = L_A + f.keep_clone * L_keep
        # Both gradients before either step, as Alg. 1 prints it; L_A moves the actor alone.
        self.optimizer.zero_grad()
        L_C.backward()
        L_A.backward(inputs=self.mu)
        self.optimizer.step()
        # mu' <- omega mu' + (1 - omega) mu, and nu' alike
        self.move_targets(list(self.target.parameters()), list(net.parameters()), None)
        return [x.detach() for x in (
            L_O, L_BC, L_keep, L_C, L_A, M.mean(), Q.mean(), Q.max(), u.abs().mean(), u_demo.abs().mean(),
            # of the demonstrated actions' mean square: 0 is a perfect clone, 1 no better than a = 0
            ((a_hat - a_demo) ** 2).sum() / (a_demo**2).sum(),
        )]  # fmt: skip

    def clone(self, B_d, stop_signals=()):
        """Before the first step: observations are normalised by B_d, then clone_iters updates of the actor on B_d, L_BC
        with M = 1, at the critic's rate, which falls to 0 (a cosine). Its target begins as this clone too."""
        f, net = self.flags, self.net
        if f.normalize_obs:
            s = B_d.rows[:, : B_d.widths[0]]
            net.s_mean.copy_(s.mean(0))
            net.s_std.copy_(s.std(0).clamp(min=0.2))  # less would blow up what the demonstrations hardly show
        optimizer = torch.optim.Adam(self.mu, lr=f.q_lr, fused=True)
        decay = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, max(1, f.clone_iters))
        for _ in trange(f.clone_iters, desc="cloning", disable=f.quiet or None):
            if stop_signals:
                raise KeyboardInterrupt(f"{f.name}: stopped while cloning; --resume begins it anew")
            s, a, *_ = B_d.sample(f.demo_batch_size, f.device)
            L_BC = loss_BC(a, net.pi(s), torch.ones_like(a[:, 0]))
            optimizer.zero_grad()
            L_BC.backward()
            optimizer.step()
            decay.step()
        self.target.load_state_dict(net.state_dict())
        self.clone_net.load_state_dict(net.mu_net.state_dict())

    def state(self):
        return {name: getattr(self, name).state_dict() for name in ("net", "target", "clone_net", "optimizer")}

    def load(self, state):
        for name, part in state.items():
            getattr(self, name).load_state_dict(part)

    def policy(self):
        """What policy.pt holds."""
        return evaluate.pack_policy(self.flags, self.net, "tanh")


# ---- training loop ---------------------------------------------------------------------------------------------------


def train(flags):
    """Runs Alg. 1 to the end, or on from the checkpoint. Returns the run's folder (Path). Raises logx.BadInput,
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
    torch.manual_seed(f.seed)
    rng, noise = np.random.default_rng(f.seed), np.zeros(4)  # of exploration
    env = gymnasium.make(TASKS[f.task].env_id, stage="train", max_episode_steps=f.max_ep_len, disable_env_checker=True)
    env = logx.Replayable(env, f.seed)
    learner, B_d = Learner(f), None
    B_o = ReplayBuffer(OBS_DIM[f.task], f.replay_size, f.symmetry)

    if state := run.checkpoint:
        t, s = state["t"], env.load(state["env"])
        learner.load(state["learner"])
        B_o.load(state["B_o"])
        if state["B_d"]:
            B_d = ReplayBuffer(OBS_DIM[f.task], len(state["B_d"]["rows"]), f.symmetry)
            B_d.load(state["B_d"])
        rng.bit_generator.state, noise = state["rng"], np.array(state["noise"])
        torch.set_rng_state(state["torch_rng"])
    else:
        t, (s, _) = 0, env.reset()
        if demos:
            B_d = ReplayBuffer(OBS_DIM[f.task], len(demos["rew"]), f.symmetry)
            if f.demos_in_B_o and len(B_d.rows) > f.replay_size:
                raise logx.BadInput(f"--replay_size {f.replay_size}: must hold the {len(B_d.rows)} demonstrated steps")
            store_demonstrations(demos, B_o, B_d, f)
    run.begin(demo_env_steps)
    if demos:
        learner.clone(B_d, run.stop_signals)

    while t < run.total_steps:
        # act
        if t < f.start_steps:
            a = rng.uniform(-1, 1, 4)
        else:
            fresh = math.sqrt(1 - f.noise_kept**2) * f.act_noise * rng.standard_normal(4)
            noise = f.noise_kept * noise + fresh
            a = np.clip(learner.act(s) + noise, -1, 1)

        # step, store
        s, _, terminated, truncated, info = env.step(a.astype(np.float32))
        t += 1
        store_last_step(B_o, env.episode, f.n_step, f.gamma, f.timeout_ends)

        # reset
        if terminated or truncated:
            run.log_episode(t, info)
            s, _ = env.reset()

        # update
        if t >= f.update_after and t % f.update_every == 0 and B_o.filled:
            n = math.floor(f.updates_per_step * t) - math.floor(f.updates_per_step * (t - f.update_every))
            if n:
                run.log_updates(learner.updates(B_o, B_d, n), learner.net)

        # log
        if t % f.steps_per_epoch == 0:
            run.log_epoch(t, lambda: evaluate.while_training(learner.policy(), f))
        if run.must_save(t):
            parts = {"learner": learner.state(), "B_o": B_o.state(), "B_d": B_d and B_d.state(), "env": env.state()}
            rngs = {"rng": rng.bit_generator.state, "torch_rng": torch.get_rng_state()}
            run.save(parts | rngs | {"t": t, "noise": noise.tolist()}, learner.policy())
            run.stop_if_asked(t)
    env.close()


def main():
    flags = resolve(logx.parse_flags(Flags, __doc__))
    folder = train(flags)
    if flags.quick:
        evaluate.after_training(folder, flags.task, flags.gains, flags.quiet)


if __name__ == "__main__":
    logx.run_script(main)
