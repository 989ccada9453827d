"""On-policy Demo-EASE: PPO-Clip with demonstrations and masked behaviour cloning (`ag:d-ease-on`, `tab:reward2`).

    python ppo_demoease.py --task pnp --quick                                  # a few minutes, to see it learn
    python ppo_demoease.py --task pnp --recipe robust                          # 50 epochs, 200,000 steps
    python ppo_demoease.py --task pnp --recipe paper                           # as printed
    python ppo_demoease.py --task pnp --num_demos 0 --lambda_bc 0              # plain PPO
    python ppo_demoease.py --task pnp --seed 1 --resume                        # goes on where it was stopped

Two recipes. `paper` is the algorithm as printed. `robust` begins with a clone of the demonstrations (which are recorded
with noise, and go into B_d alone), and then lets PPO take small steps from it, the cloning never masked; each part is a
flag of its own. README.md has every measured figure and the list of differences from the paper; where table and
algorithm are silent, the values are Spinning Up's (but ReLU networks, as DDPG's). GAE, and the policy that the ratio
and D_KL refer to, are those of the epoch's beginning (Spinning Up), where the algorithm prints them anew for every
update k.
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
from kinova_env import OBSERVATION, TASKS, grasped
from logx import flag

# ---- flags -----------------------------------------------------------------------------------------------------------


@dataclass
class Flags:
    # the experiment
    task: str = flag("pnp", choices=tuple(TASKS))
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
    # length (tab:reward2)
    epochs: int | None = flag(None, "N_ep; 50", low=1)
    steps_per_epoch: int = flag(4000, "N_o, the agent's own steps in B_o", low=1, high=10_000_000)
    max_ep_len: int | None = flag(None, "T; 400, 500, 800", low=1)
    # the algorithm (tab:reward2; pi_lr, vf_lr, log_std: spinningup; demos_per_epoch: ours)
    demos_per_epoch: int | None = flag(None, "demonstrations that open an epoch until B_d is full; N_demos / 5, "
                                       "robust: N_demos", low=1)  # fmt: skip
    train_iters: int | None = flag(None, "N_up, updates an epoch; 20, robust: 80", low=1)
    batch_size: int = flag(800, "of B_o", low=1)
    demo_batch_size: int | None = flag(None, "of B_d; 100, robust: 256", low=1)
    gamma: float = flag(0.99, low=0, high=1)
    lam: float = flag(0.97, "gamma^GAE, of the advantage estimates", low=0, high=1)
    clip_ratio: float = flag(0.2, "epsilon", low=0)
    target_kl: float = flag(0.02, "largest D_KL from the policy that acted, on its own samples", low=0)
    pi_lr: float | None = flag(None, "of the actor; 3e-4, robust: 3e-6", low=0)
    vf_lr: float = flag(1e-3, "of the critic", low=0)
    log_std: float | None = flag(None, "log sigma to begin with; -0.5, robust: -2", low=-20, high=5)
    hidden_sizes: tuple[int, ...] | None = flag(None, "128 512 128 on p2p, 256 1024 256 on p2po, 512 512 256 on pnp",
                                                low=1)  # fmt: skip
    # the parts of the robust recipe (ours)
    demo_noise: float | None = flag(None, "standard deviation of noise on the actions that demonstrations are recorded "
                                    "with (pid_demo.record); 0, robust: 0.2", low=0)  # fmt: skip
    demos_in_B_o: bool | None = flag(None, "demonstrations go into B_o too")
    clone_iters: int | None = flag(None, "updates with L_BC and L_C on B_d alone before the first epoch; 0, robust: "
                                   "4000", low=0)  # fmt: skip
    mask: str | None = flag(None, "reward: V(s) < R(s, a), eq:mask_v; return: V(s) < the demonstrated reward-to-go; "
                            "none: M = 1", ("reward", "return", "none"))  # fmt: skip
    after_kl: str | None = flag(None, "what goes on for the rest of an epoch once D_KL has reached target_kl: "
                                "none, critic: L_C, all: L_BC and L_C", ("none", "critic", "all"))  # fmt: skip
    normalize_obs: bool | None = flag(None, "observations less mean, over deviation, of the first B_d")
    grasp_input: bool | None = flag(None, "the networks are told, as one more input, whether the cube is grasped "
                                    "(P_o = P_e); pnp only")  # fmt: skip
    clip_value: bool | None = flag(None, "clip V to the range of possible returns")
    # the run
    name: str | None = flag(None, "of the run's folder; says task, algorithm, recipe, N, lambda, symmetry and seed")
    data_dir: str = flag("data/runs", "where run folders lie")
    resume: bool = flag(False, "go on from the checkpoint, if there is one")
    device: str = flag("cpu", choices=("cpu", "cuda"))
    eval_every: int = flag(5, "epochs between test trials; 0 never", low=0)
    eval_trials: int = flag(50, low=1)
    checkpoint_every: int = flag(5, "epochs", low=1)
    quick: bool = flag(False, "a few minutes: the robust recipe, 5 epochs, then test trials and a GIF of the agent")
    quiet: bool = flag(False, "no progress bar and table")
    tensorboard: bool = flag(False)


BY_TASK = {  # tab:reward, tab:reward2
    "p2p": dict(max_ep_len=400, num_demos=100, lambda_bc=1.8, hidden_sizes=(128, 512, 128)),
    "p2po": dict(max_ep_len=500, num_demos=250, lambda_bc=2.0, hidden_sizes=(256, 1024, 256)),
    "pnp": dict(max_ep_len=800, num_demos=400, lambda_bc=15.0, hidden_sizes=(512, 512, 256)),
}
BY_RECIPE = {
    "paper": dict(symmetry="gas", gains="authors", train_iters=20, demo_batch_size=100, log_std=-0.5, pi_lr=3e-4,
                  demo_noise=0.0, demos_in_B_o=True, clone_iters=0, mask="reward", after_kl="none",
                  normalize_obs=False, grasp_input=False, clip_value=False),
    "robust": dict(symmetry="canonical", gains="fast", train_iters=80, demo_batch_size=256, log_std=-2.0, pi_lr=3e-6,
                   demo_noise=0.2, demos_in_B_o=False, clone_iters=4000, mask="none", after_kl="critic",
                   normalize_obs=True, grasp_input=True, clip_value=True),
}  # fmt: skip
QUICK = dict(recipe="robust", epochs=5)


def fill_in(flags):
    """The flags with what the task and the recipe decide in place of None."""
    recipe = flags.recipe or ("robust" if flags.quick else "paper")
    defaults = {"epochs": 50} | BY_TASK[flags.task] | BY_RECIPE[recipe] | (QUICK if flags.quick else {})
    defaults |= {"recipe": recipe, "grasp_input": defaults["grasp_input"] and flags.task == "pnp"}
    N = defaults["num_demos"] if flags.num_demos is None else flags.num_demos
    defaults["demos_per_epoch"] = max(1, N if recipe == "robust" else -(-N // 5))
    return replace(flags, **{key: value for key, value in defaults.items() if getattr(flags, key) is None})


def complete(flags):
    """(flags filled in, variant: what differs from the recipe); exits with 2 where a flag is out of range."""
    flags = fill_in(flags)
    flags.hidden_sizes = tuple(flags.hidden_sizes)
    logx.check_ranges(flags)
    printed = fill_in(Flags(task=flags.task, recipe=flags.recipe, num_demos=flags.num_demos, quick=flags.quick))
    if flags.grasp_input and flags.task != "pnp":
        logx.fail(f"--grasp_input: on --task pnp only, not {flags.task}, which has nothing to grasp")
    return flags, logx.name_run(flags, printed, "ppo")


# ---- replay buffers (B_o, B_d) ---------------------------------------------------------------------------------------


class TrajectoryBuffer:
    """Transitions {s, a, r, s', zeta, end, own}, one row each, in the order they were lived.

    end is 1 where the next row is not what came next (true ends, timeouts, cuts); own is 0 for the demonstrator's.
    """

    def __init__(self, obs_dim, size):
        self.rows = torch.zeros(size, 2 * obs_dim + 8)
        self.filled = 0

    def store(self, s, a, r, s2, terminated, end, own):
        """One step: s, s2 (obs_dim,), a (4,), float32."""
        row = np.concatenate((s, a, (r,), s2, (terminated, end, own)), dtype=np.float32, casting="same_kind")
        self.store_rows(torch.from_numpy(row[None]))

    def store_rows(self, rows):
        self.rows[self.filled : self.filled + len(rows)] = rows
        self.filled += len(rows)

    def state(self):
        return self.rows[: self.filled].clone()  # of a view, all would be stored

    def load(self, rows):
        self.filled = 0
        self.store_rows(rows)


def turn(rows, widths, angle):
    """Rows of a batch, each with its world turned by its angle (SO(2), gas.rotate)."""
    s, a, r, s2, ends = rows.split((*widths[:4], 3), dim=-1)
    return torch.cat((gas.rotate(s, angle), gas.psi(a, angle), r, gas.rotate(s2, angle), ends), dim=-1)


def rewards_to_go(r, end, last_V, gamma):
    """R^_t, the discounted sum of rewards to the trajectory's end, where gamma * last_V follows. All (M,)."""
    R, out = 0.0, []
    for r_t, ends, V in zip(*(x.flip(0).tolist() for x in (r, end, last_V)), strict=True):
        R = r_t + gamma * (V if ends else R)
        out.append(R)
    return torch.tensor(out[::-1])


def advantages(r, end, V, last_V, gamma, lam):
    """A^_t by GAE (ag:d-ease-on), mean 0 and deviation 1 over the batch (spinningup). All (M,)."""
    delta = r + gamma * torch.where(end > 0, last_V, V.roll(-1)) - V
    A = rewards_to_go(delta, end, torch.zeros_like(delta), gamma * lam)
    return (A - A.mean()) / A.std(correction=0).clamp(min=1e-8)


# ---- networks --------------------------------------------------------------------------------------------------------


def mlp(sizes):
    layers = []
    for n_in, n_out in zip(sizes[:-1], sizes[1:], strict=True):
        layers += [nn.Linear(n_in, n_out), nn.ReLU()]
    return nn.Sequential(*layers[:-1])


class ActorCritic(nn.Module):
    """pi_omega: s -> N(mu, sigma), sigma the same in every state, and V_nu: s -> R, on (s - s_mean) / s_std, and with
    grasp_input on 1 where the cube is grasped, else 0."""

    def __init__(self, obs_dim, hidden_sizes, log_std, grasp_input, device):
        super().__init__()
        self.grasp_input = grasp_input
        self.mu_net = mlp([obs_dim + grasp_input, *hidden_sizes, 4])
        self.v_net = mlp([obs_dim + grasp_input, *hidden_sizes, 1])
        self.log_std = nn.Parameter(torch.full((4,), log_std))
        self.register_buffer("s_mean", torch.zeros(obs_dim))
        self.register_buffer("s_std", torch.ones(obs_dim))
        self.to(device)

    def inputs(self, s):
        x = (s - self.s_mean) / self.s_std
        return torch.cat((x, grasped(s).unsqueeze(-1).float()), dim=-1) if self.grasp_input else x

    def mu(self, s):
        """The mean action of s (n, obs_dim): (n, 4), not bounded."""
        return self.mu_net(self.inputs(s))

    def V(self, s):
        """V_nu of s (n, obs_dim): (n,)."""
        return self.v_net(self.inputs(s)).squeeze(-1)

    def log_prob(self, mu, a):
        """log pi(a|s) of mu, a (n, 4): (n,)."""
        z = (a - mu) / self.log_std.exp()
        return -(0.5 * z**2 + self.log_std + 0.5 * math.log(2 * math.pi)).sum(-1)

    def kl(self, mu, mu_old, log_std_old):
        """D_KL(pi_old, pi) in closed form, averaged over the batch (spinningup's order)."""
        var = (2 * (log_std_old - self.log_std)).exp()
        z = (mu - mu_old) / self.log_std.exp()
        return 0.5 * (var + z**2 - 1 - var.log()).sum(-1).mean()


# ---- losses ----------------------------------------------------------------------------------------------------------
# V, R, A, ratio and M are (n,), actions (n, 4); a loss is a scalar tensor.


def loss_C(V_s, R):
    """ag:d-ease-on."""
    return ((V_s - R) ** 2).mean()


def loss_O(ratio, A, clip_ratio):
    """ag:d-ease-on: r^omega_t and A^_t."""
    return -torch.min(ratio * A, ratio.clamp(1 - clip_ratio, 1 + clip_ratio) * A).mean()


def mask(V_demo, threshold):
    """M_t, eq:mask_v: 1 where the demonstrated reward (ours: reward-to-go) is above the value of the state."""
    return (V_demo < threshold).float()


def loss_BC(a_demo, a_hat, M):
    """eq:bc_gain, averaged over the batch and the 4 actions."""
    return (M.unsqueeze(-1) * (a_demo - a_hat) ** 2).mean()


def loss_A(L_O, L_BC, lambda_bc):
    """eq:loss_actor."""
    return L_O + lambda_bc * L_BC


# ---- update ----------------------------------------------------------------------------------------------------------


class Learner:
    """Networks, optimisers, and the gradient steps of ag:d-ease-on."""

    def __init__(self, flags, obs_dim):
        self.flags, self.widths = flags, (obs_dim, 4, 1, obs_dim, 1, 1, 1)
        self.net = ActorCritic(obs_dim, flags.hidden_sizes, flags.log_std, flags.grasp_input, flags.device)
        self.optimizer = self.make_optimizer(flags.pi_lr, flags.vf_lr)
        self.actor = self.net if flags.device == "cpu" else deepcopy(self.net).cpu()  # what acts
        self.return_range = (-4.0, TASKS[flags.task].return_max)

    def make_optimizer(self, pi_lr, vf_lr):
        actor = [*self.net.mu_net.parameters(), self.net.log_std]
        groups = [dict(params=actor, lr=pi_lr), dict(params=self.net.v_net.parameters(), lr=vf_lr)]
        return torch.optim.Adam(groups, fused=True)

    def V(self, s):
        """V_nu(s), with clip_value within possible returns."""
        V = self.net.V(s)
        return V.clamp(*self.return_range) if self.flags.clip_value else V

    def normalize(self, B):
        s = B.rows[: B.filled, : self.widths[0]]
        self.net.s_mean.copy_(s.mean(0))
        self.net.s_std.copy_(s.std(0).clamp(min=0.2))  # more would blow up what the demonstrations hardly show
        self.act_with_these()

    def act_with_these(self):
        if self.actor is not self.net:
            self.actor.load_state_dict(self.net.state_dict())

    def demo_batch(self, B_d, R_demo):
        """A batch of B_d: s, a, and what eq:mask_v compares V(s) with."""
        f = self.flags
        i = torch.randint(B_d.filled, (min(f.demo_batch_size, B_d.filled),))
        rows = B_d.rows[i]
        if f.symmetry == "so2":
            rows = turn(rows, self.widths, 2 * math.pi * torch.rand(len(rows)))
        s, a, r = rows.split(self.widths, dim=-1)[:3]
        return [x.to(f.device) for x in (s, a, r.squeeze(1) if f.mask == "reward" else R_demo[i], R_demo[i])]

    def clone(self, B_d, R_demo):
        """clone_iters updates on B_d alone: L_BC with M = 1 for the actor, L_C on the demonstrated rewards-to-go."""
        optimizer = self.make_optimizer(self.flags.vf_lr, self.flags.vf_lr)
        decay = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, self.flags.clone_iters)
        for _ in tqdm(range(self.flags.clone_iters), desc="cloning", unit="update", disable=self.flags.quiet):
            s, a, _, R = self.demo_batch(B_d, R_demo)
            loss = loss_BC(a, self.net.mu(s), torch.ones_like(R)) + loss_C(self.net.V(s), R)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            decay.step()
        self.act_with_these()

    def epoch(self, B_o, B_d, R_demo):
        """The N_up updates of an epoch (B_d None: no cloning). Returns their mean measurements, floats by name."""
        f, net = self.flags, self.net
        rows = B_o.rows[: B_o.filled]
        if f.symmetry == "so2":  # each trajectory turned by an angle of its own, as if it had been acted there
            trajectory = rows[:, -2].cumsum(0).long().roll(1)
            trajectory[0] = 0
            rows = turn(rows, self.widths, 2 * math.pi * torch.rand(int(trajectory[-1]) + 1)[trajectory])
        s, a, r, s2, zeta, end, own = (x.squeeze(1) if x.shape[1] == 1 else x for x in
                                       rows.to(f.device).split(self.widths, dim=-1))  # fmt: skip
        with torch.no_grad():
            mu_old, log_std_old = net.mu(s), net.log_std.clone()
            log_prob_old = net.log_prob(mu_old, a)
            V = self.V(s)
            last_V = torch.where(end > 0, (1 - zeta) * self.V(s2), 0.0)
        R = rewards_to_go(r, end, last_V, f.gamma).to(f.device)
        A = advantages(r, end, V, last_V, f.gamma, f.lam).to(f.device)
        measured, learn_O = [], True
        for _ in range(f.train_iters):
            i = torch.randint(len(s), (min(f.batch_size, len(s)),)).to(f.device)
            mu = net.mu(s[i])
            mine = own[i] > 0
            with torch.no_grad():
                D_KL = net.kl(mu[mine], mu_old[i][mine], log_std_old)
            if f.target_kl <= D_KL:
                learn_O = False
                if f.after_kl == "none":
                    break
            V_s = net.V(s[i])
            L_C = loss_C(V_s, R[i])
            ratio = (net.log_prob(mu, a[i]) - log_prob_old[i]).exp()
            L_O = L_A = loss_O(ratio, A[i], f.clip_ratio) if learn_O else mu.new_zeros(())
            L_BC = M = bc = mu.new_full((), math.nan)
            mu_demo = mu[:0]
            if B_d:
                s_demo, a_demo, threshold, _ = self.demo_batch(B_d, R_demo)
                mu_demo = net.mu(s_demo)
                with torch.no_grad():
                    M = torch.ones_like(threshold) if f.mask == "none" else mask(self.V(s_demo), threshold)
                    bc = ((mu_demo - a_demo) ** 2).sum() / (a_demo**2).sum()
                L_BC = loss_BC(a_demo, mu_demo, M)
                L_A = loss_A(L_O, L_BC, f.lambda_bc)
            if not learn_O and f.after_kl == "critic":
                L_A = L_A.new_zeros(())
            self.optimizer.zero_grad()
            (L_A + L_C).backward()  # a net without a gradient rests
            self.optimizer.step()
            measured.append(
                {
                    "L_O": L_O.detach() if learn_O else L_O.new_full((), math.nan),
                    "L_BC": L_BC.detach(),
                    "L_C": L_C.detach(),
                    "L_A": L_A.detach() if L_A.requires_grad else L_A.new_full((), math.nan),
                    "mask_fraction": M.mean(),
                    "Q_mean": V_s.detach().mean(),
                    "Q_max": V_s.detach().max(),
                    "pretanh_own": mu.detach()[mine].abs().mean(),
                    "pretanh_demo": mu_demo.detach().abs().mean(),
                    "bc_relative_error": bc,
                    "KL": D_KL,
                    "learn_O": mu.new_tensor(float(learn_O)),
                }
            )
        self.act_with_these()
        if not measured:
            return {}
        table = {key: torch.stack([m[key] for m in measured]) for key in measured[0]}
        last = {"KL": table["KL"][-1].item(), "updates": float(len(measured)), "sigma": net.log_std.exp().mean().item()}
        return {key: column.nanmean().item() for key, column in table.items()} | last

    def state(self):
        return {
            "net": {name: x.cpu().clone() for name, x in self.net.state_dict().items()},
            "optimizer": self.optimizer.state_dict(),
        }

    def load(self, state):
        self.net.load_state_dict(state["net"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.act_with_these()

    def policy(self):
        """What policy.pt holds: see evaluate.Policy. The normalisation is folded into the first layer."""
        f, net = self.flags, self.net
        weights = {name: w.detach().cpu().clone() for name, w in net.mu_net.state_dict().items()}
        of_s = weights["0.weight"][:, : self.widths[0]]
        of_s /= net.s_std.cpu()
        weights["0.bias"] -= of_s @ net.s_mean.cpu()
        return {
            "task": f.task,
            "symmetry": f.symmetry,
            "sizes": [net.mu_net[0].in_features, *f.hidden_sizes, 4],
            "output": "linear",
            "grasp_input": f.grasp_input,
            "weights": weights,
        }


# ---- training loop ---------------------------------------------------------------------------------------------------


def train(flags, variant=""):
    """Runs ag:d-ease-on to the end, or on from the checkpoint. Returns the run's folder."""
    config = asdict(flags) | {"algo": "ppo", "variant": variant}
    folder = Path(flags.data_dir) / flags.name
    if logx.is_new(folder, flags.resume):  # before the folder is made: there is nothing to undo if --demos is no good
        try:
            demos, demo_env_steps = pid_demo.demonstrations(flags)
        except ValueError as error:
            logx.fail(f"--{error}")
        if demos and flags.demos_in_B_o and "executed" in demos:
            logx.fail("--demos_in_B_o: B_o would not hold what was done where demonstrations were recorded with noise; "
                      "use --no-demos_in_B_o or --demo_noise 0")  # fmt: skip
    torch.manual_seed(flags.seed)
    obs_dim = sum(width for _, width, _ in OBSERVATION[flags.task])
    try:
        learner = Learner(flags, obs_dim)
    except (RuntimeError, MemoryError):
        logx.fail(f"--hidden_sizes {flags.hidden_sizes}: do not fit in memory")
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
        demo_rows = state["demos"]
        torch.set_rng_state(state["torch_rng"])
        rng.bit_generator.state = loop["rng"]
        # The unfinished episode is played again: the simulator's state is not enough to go on exactly.
        env.unwrapped.np_random.bit_generator.state = loop["episode_rng"]
        s, _ = env.reset()
        actions = list(state["episode_actions"].numpy())
        for a in actions:
            s, *_ = env.step(a)
    else:
        columns = ("obs", "act", "rew", "obs2", "terminated")
        last = np.append(np.diff(demos["episode"]) > 0, True) if demos else ()
        recorded = TrajectoryBuffer(obs_dim, len(last))
        for s, a, r, s2, terminated, end in zip(*(demos[name] for name in columns), last, strict=True) if demos else ():
            recorded.store(view(s), a, r, view(s2), terminated, end, own=0)
        demo_rows = recorded.rows
        loop = {"t": 0, "episodes": 0, "demo_env_steps": demo_env_steps, "demos": 0, "ep_ret": 0.0}
        loop["epoch_episodes"] = []
        env.unwrapped.reset(seed=flags.seed)
        loop["episode_rng"] = env.unwrapped.np_random.bit_generator.state
        s, _ = env.reset()
        actions = []
    # The demonstrations lie in B_d from the start, and are "filled" as the epochs open with them.
    ends = [0, *(1 + torch.nonzero(demo_rows[:, -2]).flatten()).tolist()]
    # Nothing follows a demonstration's end, be it a timeout: there is no V yet when it is recorded.
    R_demo = rewards_to_go(demo_rows[:, obs_dim + 4], demo_rows[:, -2], torch.zeros(len(demo_rows)), flags.gamma)
    B_o, B_d = TrajectoryBuffer(obs_dim, flags.steps_per_epoch + len(demo_rows)), TrajectoryBuffer(obs_dim, 0)
    B_d.rows, B_d.filled = demo_rows, ends[loop["demos"]]

    def open_epoch():
        """Demonstrations, until B_d is full."""
        first, loop["demos"] = B_d.filled, min(loop["demos"] + flags.demos_per_epoch, len(ends) - 1)
        B_d.filled = ends[loop["demos"]]
        if flags.demos_in_B_o:
            B_o.store_rows(demo_rows[first : B_d.filled])

    if run.checkpoint:
        B_o.load(state["B_o"])
    else:
        open_epoch()
        if B_d.filled:
            if flags.normalize_obs:
                learner.normalize(B_d)
            learner.clone(B_d, R_demo)

    def save():
        loop["rng"] = rng.bit_generator.state
        run.save(
            {
                "learner": learner.state(),
                "B_o": B_o.state(),
                "demos": demo_rows,
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
        with torch.inference_mode():
            mu, std = learner.actor.mu(torch.from_numpy(view(s))).numpy(), learner.actor.log_std.exp().numpy()
        a = (mu + std * rng.standard_normal(4)).astype(np.float32)
        if not np.all(np.isfinite(a)):
            stop_at_nan("the action")
        s2, r, terminated, truncated, info = env.step(a)
        cut = (loop["t"] + 1) % flags.steps_per_epoch == 0  # of the trajectory, for the update; the episode goes on
        B_o.store(view(s), a, r, view(s2), terminated, terminated or truncated or cut, own=1)
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

        if t % 100 == 0:
            bar.update(t - bar.n)

        # update, log
        if cut:
            measured = learner.epoch(B_o, B_d if B_d.filled else None, R_demo)
            B_o.filled = 0
            if not all(torch.isfinite(p).all() for p in learner.net.parameters()):
                stop_at_nan("the networks")
            epoch = t // flags.steps_per_epoch
            row = {"epoch": epoch, "env_steps": t, "demo_env_steps": loop["demo_env_steps"]}
            if loop["epoch_episodes"]:
                row |= zip(("EpRet", "EpLen", "Success"), np.mean(loop["epoch_episodes"], axis=0).tolist(), strict=True)
            row |= measured
            if flags.eval_every and (epoch % flags.eval_every == 0 or t == total_steps):
                policy = evaluate.Policy(learner.policy())
                rows = [evaluate.trial(eval_env, policy, i)[0] for i in range(flags.eval_trials)]
                row["eval_success"] = float(np.mean([row["success"] for row in rows]))
                row["eval_return"] = float(np.mean([row["return"] for row in rows]))
            row["seconds"] = run.seconds()
            run.write("progress", row)
            loop["epoch_episodes"] = []
            open_epoch()
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
                 "sigma", "KL", "learn_O", "bc_relative_error", "eval_success")  # fmt: skip
TABLE = "{:>5} {:>9} {:>7} {:>7} {:>6} {:>9} {:>13} {:>7} {:>6} {:>6} {:>8} {:>7} {:>17} {:>12}"


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
