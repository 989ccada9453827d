"""What one would take instead: SAC, TD3 and DDPG of Stable-Baselines3.

    pip install -e '.[sb3]'
    python sb3_baseline.py --algo sac --task p2p
    python sb3_baseline.py --algo td3 --num_demos 100    # demonstrations too

Its settings are Stable-Baselines3's own, but for the noise of td3 and ddpg.
With --num_demos the demonstrations of the robust recipe lie in the replay
buffer from the start, and targets sum 10 rewards, as ours do. The run's folder
is like ours: evaluate.py measures and films the agent, and tables and figures
show it beside ours. An interrupted run begins anew with --resume.

It is also an example of how the environment is used with another library.
"""

from dataclasses import dataclass

import gymnasium
import torch
from torch import nn

import evaluate
import logx
import pid_demo
from kinova_env import TASKS
from logx import flag


@dataclass
class Flags(logx.RunFlags):
    algo: str = flag("sac", "the algorithm", ("sac", "td3", "ddpg"))
    task: str = flag("p2p", "the task", choices=tuple(TASKS))
    num_demos: int = flag(0, "demonstrations in the replay buffer", low=0, high=1_000_000)
    n_step: int | None = flag(None, "rewards in a target; 1, with demonstrations 10", low=1, high=1000)
    seed: int = flag(0, "of all that is random", low=0, high=2**32 - 1)
    epochs: int = flag(100, "of 1000 steps", low=1)
    act_noise: float | None = flag(None, "of td3 and ddpg, which have none of their own; 0.1", low=0)
    resume: bool = flag(False, "begin an interrupted run anew")
    # of the other scripts, or what tables and the recording of demonstrations ask for
    quick: bool = False
    checkpoint_every: int = 5
    steps_per_epoch: int = 1000
    recipe: str = "sb3"
    symmetry: str = "none"
    lambda_bc: float = 0.0
    max_ep_len: int | None = None  # T
    partitions: int = 4
    gains: str | None = "fast"
    demo_noise: float | None = 0.2
    demos: str | None = None


def resolve(flags):
    """The flags, with a name. Raises logx.BadInput."""
    flags = logx.check_flags(flags)
    if flags.algo == "sac" and flags.act_noise is not None:
        raise logx.BadInput(f"--act_noise {flags.act_noise}: --algo sac has noise of its own; allowed with td3, ddpg")
    defaults = {"algo": flags.algo, "max_ep_len": TASKS[flags.task].horizon, "n_step": 10 if flags.num_demos else 1,
                "act_noise": None if flags.algo == "sac" else 0.1}  # fmt: skip
    return logx.fill_in(flags, defaults, flags.algo)


def make_model(f):
    """The algorithm, on the training environment."""
    import stable_baselines3 as sb3

    env = gymnasium.make(TASKS[f.task].env_id, stage="train")
    settings = dict(seed=f.seed, device=f.device, n_steps=f.n_step)
    if f.algo != "sac":
        zero = [0.0] * 4
        settings["action_noise"] = sb3.common.noise.NormalActionNoise(zero, [f.act_noise] * 4)
    return {"sac": sb3.SAC, "td3": sb3.TD3, "ddpg": sb3.DDPG}[f.algo]("MlpPolicy", env, **settings)


def preload(model, demos):
    """Demonstrations, the arrays of pid_demo.record, into the replay buffer, as what was done."""
    columns = [demos[name] for name in ("obs", "obs2", "executed", "rew", "terminated", "truncated")]
    for s, s2, a, r, terminated, truncated in zip(*columns, strict=True):
        infos = [{"TimeLimit.truncated": bool(truncated and not terminated)}]
        model.replay_buffer.add(s, s2, a, r, terminated or truncated, infos)


def pack_policy(model, task):
    """What policy.pt holds (evaluate.Policy): the layers of the actor, whose mean is squashed by tanh."""
    actor = model.policy.actor
    mean = [*actor.latent_pi, actor.mu] if hasattr(actor, "latent_pi") else actor.mu  # of SAC, of TD3 and DDPG
    layers = [layer for layer in mean if isinstance(layer, nn.Linear)]
    weights = {f"{2 * i}.{name}": w.detach().cpu().clone() for i, layer in enumerate(layers)
               for name, w in layer.named_parameters()}  # fmt: skip
    sizes = [layers[0].in_features, *(layer.out_features for layer in layers)]
    return {"task": task, "symmetry": "none", "sizes": sizes, "output": "tanh", "weights": weights}


def train(flags):
    """Trains to the end. Returns the run's folder (Path). Raises logx.BadInput, and KeyboardInterrupt when stopped."""
    try:
        from stable_baselines3.common.callbacks import BaseCallback
    except ImportError:
        raise logx.BadInput("--algo: needs Stable-Baselines3 (pip install -e '.[sb3]')") from None

    class Record(BaseCallback):
        """Writes each episode and each epoch into the run's folder."""

        def _on_step(self):
            t, info = self.num_timesteps, self.locals["infos"][0]
            if "episode" in info:
                run.log_episode(t, info)
            if t % f.steps_per_epoch == 0:
                run.log_epoch(t, lambda: evaluate.while_training(pack_policy(model, f.task), f))
            return not run.stop_signals

    torch.set_num_threads(1)
    f = resolve(flags)
    with logx.RunFolder(f, f.algo, []) as run:
        if run.checkpoint:  # written at the end alone
            if run.checkpoint["t"] < run.total_steps:
                raise logx.BadInput(f"--epochs {f.epochs}: a finished run cannot go on; begin a new --name")
            print(f"{run.folder}: finished")
            return run.folder
        demos, steps = pid_demo.demonstrations(f)
        model = make_model(f)
        if demos:
            preload(model, demos)
        run.begin(steps)
        model.learn(run.total_steps, callback=Record())
        if model.num_timesteps < run.total_steps:
            raise KeyboardInterrupt(f"{run.folder}: stopped; --resume begins it anew")
        run.save({"t": run.total_steps}, pack_policy(model, f.task))
    return run.folder


if __name__ == "__main__":
    logx.run_script(lambda: print(train(logx.parse_flags(Flags, __doc__))))
