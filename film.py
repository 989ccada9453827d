"""What films show: the scene around the arm, the camera, and GIF or MP4 files. Nothing here changes what is simulated.

`KinovaEnv(render_mode=...)` stands in this scene; `film` is what `--gif` of evaluate.py and pid_demo.py writes.
"""

import contextlib
import ctypes
import importlib.util
import math
import os
import sys
from pathlib import Path

import numpy as np
from tqdm import tqdm

import logx

FLOOR = Path(__file__).parent / "data" / "robot" / "floor.png"
ORANGE, GREEN, RED = (0.84, 0.37, 0.0), (0.0, 0.62, 0.45), (0.80, 0.15, 0.15)
CAMERA = dict(distance=1.5, yaw=38, pitch=-20)  # m, degrees
TARGET = (0, 0, 0.4)  # that the camera looks at
FIELD, NEAR, FAR = 42, 0.1, 5.0  # of view, degrees; clipping planes, m
LIGHT = np.array([0.3, -0.4, 2.0])  # from where: nearly above, so that a shadow lies under what throws it
SMOOTH = 2  # each pixel is the mean of so many by so many
EVERY = 4  # steps a picture


@contextlib.contextmanager
def silence(*streams):
    """PyBullet's own prints, which come from C, go nowhere."""
    sys.stdout.flush()
    kept = [(stream, os.dup(stream)) for stream in streams]
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        for stream in streams:
            os.dup2(nowhere, stream)
        yield
    finally:
        ctypes.CDLL(None).fflush(None)  # C keeps what it prints, where that is no terminal
        for stream, copy in kept:
            os.dup2(copy, stream)
            os.close(copy)
        os.close(nowhere)


with silence(2):  # its build time
    import pybullet


def has_display():
    """Whether PyBullet can open its window; where it cannot it would end the process."""
    if not sys.platform.startswith("linux"):
        return True
    try:
        x11 = ctypes.CDLL("libX11.so.6")
    except OSError:
        return False
    x11.XOpenDisplay.restype, x11.XCloseDisplay.argtypes = ctypes.c_void_p, [ctypes.c_void_p]
    display = x11.XOpenDisplay(None)
    if display:
        x11.XCloseDisplay(display)
    return bool(display)


def furnish(client, robot, window, radius):
    """The scene around `robot`: a floor with a grid of 0.1 m; a thin line that stands under the goal and a disc at its
    foot, so that depth can be read; and in a window the goal, a ball (`picture` draws its own). Returns move(goal)."""
    id_ = {"physicsClientId": client}
    corners = [[x, y, 0] for x, y in ((-0.8, -0.8), (0.8, -0.8), (0.8, 0.8), (-0.8, 0.8))]
    look = dict(normals=[[0, 0, 1]] * 4, uvs=[[0, 0], [1, 0], [1, 1], [0, 1]], specularColor=[0, 0, 0])
    shape = pybullet.createVisualShape(
        pybullet.GEOM_MESH, vertices=corners, indices=[0, 1, 2, 0, 2, 3], rgbaColor=[1, 1, 1, 1], **look, **id_
    )
    floor = pybullet.createMultiBody(0, -1, shape, [0, 0, 0], **id_)
    pybullet.changeVisualShape(floor, -1, textureUniqueId=pybullet.loadTexture(str(FLOOR), **id_), **id_)

    rod = dict(shapeType=pybullet.GEOM_CYLINDER, radius=0.002, length=1.0)  # what is too long of it is underground
    disc = dict(shapeType=pybullet.GEOM_CYLINDER, radius=radius, length=0.002)
    ball = dict(shapeType=pybullet.GEOM_SPHERE, radius=radius)
    marks = []  # (body, its height as a function of the goal's)
    for shape, opacity, height in (
        (rod, 1, lambda z: z - 0.5), (disc, 1, lambda z: 0.0), (ball, 0.6, lambda z: z),
    )[: 3 if window else 2]:  # fmt: skip
        visual = pybullet.createVisualShape(**shape, rgbaColor=[*GREEN, opacity], **id_)
        marks.append((pybullet.createMultiBody(0, -1, visual, [0, 0, -5], **id_), height))

    if window:  # where a link has one colour: the lightest of its shapes
        for shape in sorted(pybullet.getVisualShapeData(robot, **id_), key=lambda shape: shape[7]):
            pybullet.changeVisualShape(robot, shape[1], rgbaColor=shape[7], **id_)

    def move(goal):
        for body, height in marks:
            pybullet.resetBasePositionAndOrientation(body, [*goal[:2], height(goal[2])], [0, 0, 0, 1], **id_)

    return move


def open_window():
    """A PyBullet client with a window that shows what `picture` does. Returns its number."""
    client = pybullet.connect(pybullet.GUI)
    id_ = {"physicsClientId": client}
    pybullet.configureDebugVisualizer(pybullet.COV_ENABLE_GUI, 0, **id_)
    pybullet.configureDebugVisualizer(lightPosition=(3 * LIGHT).tolist(), rgbBackground=[1, 1, 1], **id_)
    camera = {f"camera{name.capitalize()}": value for name, value in CAMERA.items()}
    camera["cameraDistance"] *= math.tan(math.radians(FIELD / 2)) / math.tan(math.radians(75 / 2))  # its field is wider
    pybullet.resetDebugVisualizerCamera(**camera, cameraTargetPosition=TARGET, **id_)
    return client


def picture(client, width, height, goal, radius):
    """(height, width, 3) uint8 of the scene, with the goal (3,) in m, or None, as a translucent ball."""
    w, h = SMOOTH * width, SMOOTH * height
    view = pybullet.computeViewMatrixFromYawPitchRoll(TARGET, roll=0, upAxisIndex=2, **CAMERA)
    lens = pybullet.computeProjectionMatrixFOV(FIELD, width / height, NEAR, FAR)
    look = dict(lightDirection=LIGHT.tolist(), lightDistance=5, lightAmbientCoeff=0.6, lightDiffuseCoeff=0.42,
                lightSpecularCoeff=0.05, shadow=1, renderer=pybullet.ER_TINY_RENDERER)  # fmt: skip
    *_, rgba, depth, _ = pybullet.getCameraImage(w, h, view, lens, **look, physicsClientId=client)
    image = np.asarray(rgba, dtype=np.float32).reshape(h, w, 4)[..., :3]
    if goal is not None:
        depth = FAR * NEAR / (FAR - (FAR - NEAR) * np.reshape(depth, (h, w)))  # of the buffer, to m
        _ball(image, depth, np.reshape(view, (4, 4)).T, np.reshape(lens, (4, 4)), goal, radius)
    return image.reshape(height, SMOOTH, width, SMOOTH, 3).mean((1, 3)).astype(np.uint8)


def _ball(image, depth, view, lens, centre, radius, alpha=0.6):
    """Blends a ball into a picture (h, w, 3) where nothing lies before it; depth: (h, w) in m along the view."""
    h, w = depth.shape
    c = view[:3, :3] @ centre + view[:3, 3]  # in the camera's frame, which looks along -z
    y, x = np.mgrid[:h, :w]
    ray = np.stack([(2 * x + 1 - w) / (w * lens[0, 0]), (h - 2 * y - 1) / (h * lens[1, 1]), -np.ones((h, w))], axis=-1)
    square, along = (ray**2).sum(-1), ray @ c
    root = along**2 - square * (c @ c - radius**2)
    near = (along - np.sqrt(np.maximum(root, 0))) / square  # where the ray meets the ball, in m along the view
    seen = (root > 0) & (near < depth)
    normal = (ray[seen] * near[seen, None] - c) / radius
    shade = 0.75 + 0.25 * normal @ (view[:3, :3] @ LIGHT / np.linalg.norm(LIGHT))
    image[seen] = (1 - alpha) * image[seen] + alpha * 255 * shade[:, None] * np.array(GREEN)


# ---- films -----------------------------------------------------------------------------------------------------------


def rgb(colour):
    """0 ... 1 to 0 ... 255."""
    return tuple(int(255 * c) for c in colour)


def short(names):
    """The names without folders and without the parts, between dashes, that all of them have; with these where there
    is one name, or two would become alike."""
    parts = [Path(name).name.split("-") for name in names]
    shared = set.intersection(*map(set, parts)) if len(parts) > 1 else set()
    kept = ["-".join(part for part in name if part not in shared) for name in parts]
    return kept if all(kept) and len(set(kept)) == len(kept) else ["-".join(name) for name in parts]


def check(path, watch):
    """Raises logx.BadInput where no film can be written to `path`, or a window is asked for that cannot be opened."""
    no_video = not all(map(importlib.util.find_spec, ("imageio", "imageio_ffmpeg")))
    for wrong, message in (
        (watch and path, "--gif, --watch: one of them at a time"),
        (watch and not has_display(), "--watch: needs a display, and there is none; --gif FILE needs none"),
        (path and path.suffix not in (".gif", ".mp4"), f"--gif {path}: must end in .gif or .mp4"),
        (path and (path.is_dir() or not path.absolute().parent.is_dir()), f"--gif {path}: must be a file in a folder"),
        (path and path.suffix == ".mp4" and no_video, f"--gif {path}: needs pip install -e '.[video]'"),
    ):
        if wrong:
            raise logx.BadInput(message)


def frames(agents, episodes, every=EVERY, quiet=True):
    """The pictures (height, width, 3) uint8 of episodes, one in `every` steps, the agents' side by side, with a clock
    and, at an agent's end, a green border for success or a red one.

    agents: {name: (an env with render_mode "rgb_array", act(obs))}; episodes: {what is written: seed}; quiet: without a
    progress bar.
    """
    from PIL import Image, ImageDraw, ImageFont

    font, names = ImageFont.load_default(14), short(agents)
    dt = 1 / next(iter(agents.values()))[0].metadata["render_fps"]
    bar = tqdm(episodes.items(), "filming", unit="episode", disable=quiet or None, leave=False)  # on a terminal
    for title, seed in bar:
        obs = {name: env.reset(seed=seed)[0] for name, (env, _) in agents.items()}
        shown, t = dict.fromkeys(agents), 0
        while obs:  # those that have ended keep their last picture
            for n, (name, (env, act)) in enumerate(agents.items()):
                border = None
                if name in obs and t:
                    obs[name], _, terminated, truncated, info = env.step(act(obs[name]))
                    if terminated or truncated:
                        border = GREEN if info["is_success"] else RED
                if border or (name in obs and t % every == 0):
                    shown[name] = Image.fromarray(env.render())
                    draw = ImageDraw.Draw(shown[name])
                    text = f"{title}   {t * dt:.1f} s" + f"\n{names[n]}" * (len(agents) > 1)
                    draw.text((10, 8), text, font=font, fill=(40, 40, 40))
                if border:
                    frame = [0, 0, shown[name].width - 1, shown[name].height - 1]
                    draw.rectangle(frame, outline=rgb(border), width=5)
                    del obs[name]
            if t % every == 0 or not obs:
                yield (whole := np.concatenate([np.asarray(shown[name]) for name in agents], axis=1))
            t += 1
        yield from [whole] * 9  # a rest at the end


def film(agents, path, episodes, every=EVERY, quiet=False):
    """Writes `frames` to a GIF, or to an MP4 (with imageio's ffmpeg) where `path` says so, in real time."""
    from PIL import Image

    fps = next(iter(agents.values()))[0].metadata["render_fps"] / every

    def mp4(file):
        import imageio

        with imageio.get_writer(file, format="mp4", fps=fps, macro_block_size=None) as video:
            for one in frames(agents, episodes, every, quiet):
                video.append_data(one)

    def gif(file):
        pictures = [Image.fromarray(one) for one in frames(agents, episodes, every, quiet)]
        sample = pictures[0].copy()  # one palette, that of the first picture and of the borders, makes a small file
        for n, colour in enumerate((GREEN, RED)):
            sample.paste(rgb(colour), (20 * n, 0, 20 * n + 20, 20))
        # method 2, fast octree: the median cut that is Pillow's own choice gives the orange cube a grey
        palette = sample.quantize(64, method=2)
        first, *rest = [picture.quantize(palette=palette, dither=0) for picture in pictures]
        first.save(file, "GIF", save_all=True, append_images=rest, duration=round(1000 / fps), loop=0)

    logx.atomic_write(path, mp4 if str(path).endswith(".mp4") else gif)
