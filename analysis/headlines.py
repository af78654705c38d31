"""Measures the speeds that the documentation states, on this machine: `splatpilot headlines`.

Limits are requirements, or half of the documented speed. A part that fails does not end the others.
Parts for a GPU have not run on one yet.
"""

import os
import platform
import signal
import sys
import tempfile
import time
import timeit
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from dataclasses import asdict, dataclass, replace
from functools import cache, partial
from importlib import import_module, util
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator
from pydrake.systems.sensors import ImageDepth32F

import splatpilot as sp
from splatpilot import _native
from splatpilot.diagrams.flight.flight_diagram import DecisionInput
from splatpilot.diagrams.flight.policies import policy_named
from splatpilot.diagrams.flight.scenario import sample_initial_state
from splatpilot.diagrams.flight.sensors import make_onboard_camera
from splatpilot.diagrams.scenarios import scenario_file
from splatpilot.systems.common.config import load_config
from splatpilot.systems.common.extras import missing_extra
from splatpilot.systems.common.files import data_folder
from splatpilot.systems.common.processes import available_cores
from splatpilot.systems.common.readers import error_summary
from splatpilot.systems.policies.diffaero import DiffAero
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.splats.baked_scene import BatchRenderer
from splatpilot.systems.vehicle.state import pose_from_state

RATE = 10.0  # [Hz]
MAX_DEPTH = 12.0  # [m]


@dataclass(frozen=True)
class Headline:
    """A measured value and the range in which it passes."""

    what: str
    value: float
    unit: str
    min: float = -np.inf
    max: float = np.inf

    @property
    def passed(self) -> bool:
        return self.min <= self.value <= self.max

    def cells(self) -> tuple[str, ...]:
        """Returns the cells of its row: name, value, pass mark, and if it passed."""
        limits = ((">=", self.min), ("<=", self.max))
        marks = [f"{sign} {_format(limit)}" for sign, limit in limits if np.isfinite(limit)]
        passed = ("yes" if self.passed else "no") if marks else ""
        return self.what, f"{_format(self.value)} {self.unit}".strip(), " ".join(marks), passed


def _format(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


@dataclass(frozen=True)
class Effort:
    """Sizes of the measurements."""

    vehicles: int = 4096  # maximum number of environments
    views: int = 64  # environments with images
    worlds: int = 16
    rounds: int = 5
    steps: int = 30  # of one environment, in a round
    updates: int = 300  # of the student


_COLLECT = "import gc; gc.enable()"  # Users pay for Python's garbage, too.


def milliseconds(call: Callable[[], object], repeats: int = 30) -> float:
    """Returns the minimum CPU time of the process [ms] over `repeats` calls, after a first one. CPU
    time does not count the waiting on a busy machine."""
    call()
    return 1e3 * min(timeit.repeat(call, _COLLECT, time.process_time, repeats, number=1))


def wall_seconds(call: Callable[[], object], repeats: int = 1) -> float:
    """Returns the minimum wall time [s] over `repeats` calls."""
    return min(timeit.repeat(call, _COLLECT, repeat=repeats, number=1))


def machine() -> str:
    """Describes the machine and the software."""
    cpuinfo = Path("/proc/cpuinfo")  # not on macOS
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    models = [line.split(":")[1].strip() for line in lines if line.startswith("model name")]
    torch = import_module("torch") if util.find_spec("torch") else None
    with_torch = f", torch {torch.__version__}" if torch else ""
    if torch and torch.cuda.is_available():
        with_torch += f", {torch.cuda.get_device_name()}"
    return (
        f"{models[0] if models else platform.machine()}, {available_cores()} cores, "
        f"{platform.platform()}, SIMD levels {', '.join(_native.simd_levels())}, Python "
        f"{platform.python_version()}{with_torch}, load {os.getloadavg()[0]:.1f}"
    )


def environments(effort: Effort) -> Iterator[Headline]:
    """Measures Gymnasium environments in P02; they take turns with Drake's `DrakeGymEnv`."""
    from splatpilot.diagrams.gym.flight_env import FlightEnv
    from splatpilot.diagrams.gym.vector_env import VectorFlightEnv

    scenario, world = _forest()
    camera, states = OnboardCamera(max_depth=MAX_DEPTH), ("state", "goal")
    one = FlightEnv(scenario, world=world, observation="full_state", rate=RATE)
    calls: dict[str, Callable[[], np.ndarray]] = {
        "drake": partial(_step_time, _drake_env(scenario, world), effort.steps, 3.0),
        "drake depth": partial(_step_time, _drake_env(scenario, world, camera), effort.steps, 3.0),
        "one": partial(_step_time, one, effort.steps),
    }
    cases = {  # number of environments, images, and their size
        "state": (effort.vehicles, (), (64, 36)),
        "depth": (effort.views, ("depth",), (64, 36)),
        "RGB-D 64x48": (effort.views, ("depth", "rgb"), (64, 48)),
        "RGB-D 160x120": (effort.views, ("depth", "rgb"), (160, 120)),
    }
    envs: dict[str, VectorFlightEnv] = {}
    for name, (count, images, (width, height)) in cases.items():
        envs[name] = VectorFlightEnv(
            count,
            scenario,
            num_worlds=effort.worlds,
            observation=(*images, *states),
            camera=replace(camera, width=width, height=height, merged_spread=1.0),
            threads=available_cores(),
            rate=RATE,
            pool=envs["state"].pool if envs else None,
        )
        envs[name].reset(seed=0)
        calls[name] = partial(_step_time, envs[name], 4 if images else 8)
    times = [{name: call() for name, call in calls.items()} for _ in range(effort.rounds)]
    best, cpu = ({n: min(each[n][k] for each in times) for n in calls} for k in (0, 1))
    over = "over DrakeGymEnv"
    yield Headline(f"one environment by state, {over}", cpu["drake"] / cpu["one"], "x", 2)
    many = f"vector environment, N = {effort.vehicles}, by state"
    yield Headline(many, 1 / best["state"], "steps/s", 1e6)
    many = f"vector environment, N = {effort.views}"
    yield Headline(f"{many}, depth 64x36", 1 / best["depth"], "steps/s", 1200)
    yield Headline(f"the same, {over}", best["drake depth"] / best["depth"], "x", 12)
    for name, required in (("RGB-D 64x48", 3000), ("RGB-D 160x120", 900)):
        yield Headline(f"{many}, {name}, colors merged", 1 / best[name], "steps/s", required)
    mask = np.arange(effort.vehicles) == 0
    reset = partial(envs["state"].reset, options={"reset_mask": mask})
    yield Headline("reset of one environment", 1e3 * wall_seconds(reset, 20), "ms", max=2)


@cache
def _forest() -> tuple[Any, Any]:
    scenario = load_config(sp.Scenario(), scenario_file("P02"))
    return scenario, sp.make_world(scenario.world, scenario.seed)


def _step_time(env: Any, steps: int, scale: float = 1.0) -> np.ndarray:
    """Returns wall and CPU time [s] of a step of one environment, flying ahead."""
    generator, shape = np.random.default_rng(0), env.action_space.shape
    count = getattr(env, "num_envs", 1)
    low, high = [0.0, -0.3, -0.1], [0.6, 0.3, 0.1]
    actions = scale * generator.uniform(low, high, (8, *shape)).astype(np.float32)
    if count == 1:
        env.reset(seed=0)
    began = time.perf_counter(), time.process_time()
    for k in range(steps):
        env.step(actions[k % 8])
    spent = np.subtract((time.perf_counter(), time.process_time()), began)
    return spent / (steps * count)


def _drake_env(scenario: Any, world: Any, camera: Any = None) -> Any:
    """Makes Drake's environment of a flight: the state, and the distance as reward. A camera's
    depth image is rendered in each step."""
    from gymnasium.spaces import Box
    from pydrake.gym import DrakeGymEnv

    policy = DecisionInput("velocity", camera, RATE)
    diagram = sp.BuildFlightDiagram(scenario, world, policy=policy, camera=False)
    simulator = Simulator(diagram)
    ApplySimulatorConfig(scenario.simulator, simulator)

    def reward(diagram: Any, context: Any) -> float:
        if camera is not None:
            diagram.GetOutputPort("observation_depth_image_32f").Eval(context)
        return -np.linalg.norm(diagram.GetOutputPort("state").Eval(context)[:3] - world.p_WG)

    return DrakeGymEnv(
        simulator,
        1 / RATE,
        Box(-3.0, 3.0, (3,)),
        Box(-np.inf, np.inf, (13,)),
        reward,
        action_port_id="velocity",
        observation_port_id="observation_state",
        reset_handler=lambda *_: None,
    )


def images(effort: Effort) -> Iterator[Headline]:
    """Measures images of P02 on the CPU, on one thread unless in batches."""
    scenario, world = _forest()
    baked, near, repeats = world.baked, {"max_depth": MAX_DEPTH}, 6 * effort.rounds
    view, X_WCs = _views(scenario, world, 64, 36, effort.views)
    renderer = BatchRenderer(available_cores())

    def single(render: Callable[..., object], **options: float) -> None:
        for X_WC in X_WCs:
            render(*view, X_WC, **options)

    depth = partial(single, baked.render_depth, **near)
    together = partial(renderer.render_depth, [baked] * len(X_WCs), *view, X_WCs, **near)
    ratio = wall_seconds(depth, effort.rounds) / wall_seconds(together, effort.rounds)
    yield Headline("depth 64x36 in batches, over single images", ratio, "x", 1.5)
    mean = milliseconds(depth, effort.rounds) / len(X_WCs)
    yield Headline("depth 64x36 to 12 m, baked, along a path", mean, "ms", max=1.6)
    view, X_WCs = _views(scenario, world, 160, 120, effort.views)
    mean = milliseconds(partial(single, baked.render_color), effort.rounds) / len(X_WCs)
    yield Headline("RGB 160x120, baked, along a path", mean, "ms", max=6.4)

    camera = make_onboard_camera(OnboardCamera(readout=0.02), world)
    X_WB = _poses(scenario, world, 1)[0]
    X_WB_start = X_WB @ RigidTransform(RollPitchYaw(0, 0, 0.02), np.array([-0.04, 0, 0]))
    rolling = milliseconds(partial(camera.render, X_WB, X_WB_start=X_WB_start), repeats)
    ratio = rolling / milliseconds(partial(camera.render, X_WB), repeats)
    yield Headline("rolling shutter at 1 rad/s and 2 m/s, over none", ratio, "x", max=1.6)

    from splatpilot.systems.splats.rasterization import rasterize

    tensors: dict[str, Any] = scene_tensors(world.gaussians, view, X_WCs[:1])
    tensors["render_mode"] = "RGB+MD"
    ratio = milliseconds(partial(rasterize, **tensors), repeats) / milliseconds(
        partial(baked.render, *view, X_WCs[0]), repeats
    )
    yield Headline("RGB and depth 160x120, baked over rasterize", ratio, "x", 1.2)


def _poses(scenario: Any, world: Any, count: int) -> list[Any]:
    """Returns body poses X_WB on the line from the start to the goal, looking ahead."""
    X_WB = pose_from_state(sample_initial_state(scenario, world))
    start = X_WB.translation()
    steps = np.linspace(0, 1, count, endpoint=False)[:, None] * (world.p_WG - start)
    return [RigidTransform(X_WB.rotation(), start + step) for step in steps]


def _views(
    scenario: Any, world: Any, width: int, height: int, count: int
) -> tuple[tuple[np.ndarray, int, int], list[Any]]:
    """Returns K, width and height of the onboard camera, and poses X_WC."""
    camera = OnboardCamera(width=width, height=height)
    X_WCs = [X_WB @ camera.mount() for X_WB in _poses(scenario, world, count)]
    return (camera.camera_info().intrinsic_matrix(), width, height), X_WCs


def scene_tensors(
    scene: Any, view: tuple[np.ndarray, int, int], X_WCs: Sequence[Any], device: str = "cpu"
) -> dict[str, Any]:
    """Returns arguments of `rasterize`."""
    import torch

    K, width, height = view
    arrays = {name: getattr(scene, name) for name in ("means", "quats", "scales", "opacities")}
    arrays |= {"colors": scene.base_colors, "Ks": np.repeat(K[None], len(X_WCs), axis=0)}
    arrays["viewmats"] = np.stack([X_WC.inverse().GetAsMatrix4() for X_WC in X_WCs])
    tensors = {k: torch.tensor(v, dtype=torch.float32, device=device) for k, v in arrays.items()}
    return tensors | {"width": width, "height": height}


def flight(effort: Effort) -> Iterator[Headline]:
    """Measures a flight of P02 by DiffAero, and its decisions without rendering."""
    scenario, world = _forest()
    scenario = replace(scenario, policy=policy_named("diffaero"))
    flown = sp.fly(sp.BuildFlightDiagram(scenario, world)).summary()
    factor = float(flown["real_time_factor"])
    yield Headline("flight by diffaero, over real time", factor, "x", 1)
    policy = DiffAero(scenario.policy)
    context, camera = policy.CreateDefaultContext(), scenario.policy.camera
    image = ImageDepth32F(camera.width, camera.height)
    np.asarray(image.mutable_data)[:] = 5.0
    inputs = {"state": sample_initial_state(scenario, world), "goal": world.p_WG}
    for name, value in (inputs | {"depth_image_32f": image}).items():
        policy.GetInputPort(name).FixValue(context, value)

    def decide() -> None:
        context.SetTime(context.get_time() + 1 / policy.config.rate)  # else it is cached
        policy.EvalUniquePeriodicDiscreteUpdate(context)

    decision = milliseconds(decide, 10 * effort.rounds)
    yield Headline("decision of diffaero", decision, "ms", max=0.1e3 / policy.config.rate)


def training(effort: Effort) -> Iterator[Headline]:
    """Measures the training of DiffAero on one thread: rays of its depth images; and steps of
    vehicles, forward, backward and optimizer."""
    import torch

    from splatpilot.systems.common.processes import one_torch_thread
    from splatpilot.training.policies.rollouts import (
        DifferentiableRollout,
        RolloutConfig,
        render_depth,
    )
    from splatpilot.training.policies.train import step_optimizer
    from splatpilot.training.policies.train_diffaero import DiffAeroLearner, DiffAeroLoss
    from splatpilot.training.policies.training_worlds import WorldSelection, training_worlds

    kinds = {"forests": ("P02", "P03"), "walls": ("P06", "P09"), "rooms": ("P04", "P05")}
    required = {"forests": (3.6, 3800), "walls": (8, 4900), "rooms": (3.6, 2900)}
    for name, scenarios in kinds.items():
        selection = WorldSelection(kinds=list(scenarios), count=effort.worlds, voxel_size=0.4)
        worlds = training_worlds(selection, seed=0)
        learner = DiffAeroLearner(DiffAeroLoss())
        generator = torch.Generator().manual_seed(0)
        rollout = DifferentiableRollout(learner, worlds, RolloutConfig(), generator)
        optimizer = torch.optim.AdamW(learner.network.parameters())
        vehicles, rays, episodes = rollout.config.environments, learner.rays, rollout.episodes
        learn = partial(step_optimizer, rollout.losses, learner.network, optimizer, 1.0)
        render = partial(render_depth, episodes.vehicle, worlds.geometry, rays, episodes.world)
        with one_torch_thread():
            steps = 1e3 * vehicles * rollout.config.steps / milliseconds(learn, effort.rounds)
            cast = 1e-3 * vehicles * len(rays.directions_C) / milliseconds(render, 20)
        yield Headline(f"rays in {name}", cast, "M/s", required[name][0])
        yield Headline(f"training of DiffAero in {name}", steps, "steps/s", required[name][1])


def _forest_views(mode: str, width: int, height: int, count: int, device: str) -> dict[str, Any]:
    """Returns arguments of `rasterize` of views of P02 on a device."""
    scenario, world = _forest()
    views = _views(scenario, world, width, height, count)
    return scene_tensors(world.gaussians, *views, device) | {"render_mode": mode}


def gpu_images(effort: Effort) -> Iterator[Headline]:
    """Measures batches of images of P02 by gsplat, which has no median depth."""
    import torch

    from splatpilot.systems.splats.rasterization import rasterize

    kinds = {"depth 64x36": ("ED", 64, 36, 50_000), "RGB 160x120": ("RGB", 160, 120, 10_000)}
    counts = sorted({1, 16, 256, effort.vehicles})
    for name, (mode, width, height, required) in kinds.items():
        for count in counts:
            given = _forest_views(mode, width, height, count, "cuda")

            def render(given: Mapping[str, Any] = given) -> None:
                rasterize(**given)[1][0, 0, 0].cpu()  # waits for the device

            with torch.no_grad():
                render()
                rate = count / wall_seconds(render, effort.rounds)
            minimum = required if count == counts[-1] else -np.inf
            yield Headline(f"GPU, {name}, N = {count}", rate, "images/s", minimum)


def gpu_agreement(effort: Effort, device: str = "cuda") -> Iterator[Headline]:
    """Compares an image of P02 by gsplat's kernels with ours."""
    from splatpilot.systems.splats.rasterization import rasterize

    ours, theirs = (
        rasterize(**_forest_views("RGB+ED", 320, 240, 1, each))[0].cpu() for each in ("cpu", device)
    )
    error = (ours - theirs).abs()
    yield Headline("GPU and CPU, median difference", float(error.median()), "", max=1e-5)
    share = 100 * float((error > 1e-3).float().mean())
    yield Headline("GPU and CPU, values that differ by 1e-3", share, "%", max=0.1)


def gpu_reconstruct(effort: Effort) -> Iterator[Headline]:
    """Reconstructs and measures TartanAir's hospital."""
    from splatpilot.analysis.reconstruction.measure_scene import make_scene
    from splatpilot.training.reconstruction.config import ReconstructConfig

    data = data_folder()
    if data is None:
        raise ValueError("SPLATPILOT_DATA must be set to the folder of tartanair/hospital")
    config, capture = ReconstructConfig(device="cuda"), data / "tartanair" / "hospital"
    with tempfile.TemporaryDirectory() as folder:
        began = time.perf_counter()
        _, metrics = make_scene(capture=capture, out=Path(folder) / "scene", config=config)
        yield Headline("GPU, hospital reconstructed", time.perf_counter() - began, "s")
    yield Headline("GPU, PSNR of the hospital", metrics.mean("psnr_db") or np.nan, "dB")


def gpu_student(effort: Effort) -> Iterator[Headline]:
    """Trains a student of depth from scratch, on a small corpus."""
    import torch

    from splatpilot.training.corpus import collect
    from splatpilot.training.corpus.corpus import CorpusConfig
    from splatpilot.training.policies.train import step_optimizer
    from splatpilot.training.policies.train_student import StudentDepthTraining, StudentTrainer

    with tempfile.TemporaryDirectory() as folder:
        corpus = Path(folder) / "corpus"
        collect.run(out=corpus, worlds=2, config=CorpusConfig(flights=1))
        config = StudentDepthTraining(
            corpora=[str(corpus)], device="cuda", pretrained=False, frozen=0, batch=256
        )
        trainer = StudentTrainer(config)
        optimizer = torch.optim.AdamW(trainer.network.parameters())

        learn = partial(step_optimizer, trainer.losses, trainer.network, optimizer, 1.0)
        seconds = timeit.timeit(learn, _COLLECT, number=effort.updates)
    rate = effort.updates * config.batch / seconds
    yield Headline(f"GPU, {effort.updates} updates of a student", rate, "samples/s")


@contextmanager
def time_limit(seconds: float) -> Iterator[None]:
    """Raises TimeoutError in the block after some time; 0 for no limit."""

    def stop(*_: object) -> None:
        raise TimeoutError(f"not finished within {seconds:g} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


Part = Callable[[Effort], Iterator[Headline]]

CPU_PARTS: dict[str, tuple[Part, float]] = {
    part.__name__: (part, 0.0) for part in (environments, images, flight, training)
}
GPU_PARTS: dict[str, tuple[Part, float]] = {
    "GPU images": (gpu_images, 180.0),
    "GPU agreement": (gpu_agreement, 60.0),
    "GPU reconstruction": (gpu_reconstruct, 300.0),
    "GPU student": (gpu_student, 180.0),
}
"""Parts in order of importance, and their time limits [s]."""


def run(
    parts: Mapping[str, tuple[Part, float]] | None = None, effort: Effort | None = None
) -> dict[str, Any]:
    """Measures parts, by default all that this machine can, and prints a Markdown table. Returns
    `machine`, `rows`, reasons of `failures` by part, and the printed `table`."""
    failures: dict[str, str] = {}
    if parts is None:
        parts = dict(CPU_PARTS)
        if util.find_spec("torch") and import_module("torch").cuda.is_available():
            parts |= GPU_PARTS
        else:
            failures["GPU"] = "PyTorch finds no GPU"
    rows: list[Headline] = []
    lines: list[str] = []

    def write(*texts: str) -> None:
        lines.extend(texts)
        for text in texts:
            print(text, flush=True)

    write(machine(), "", "| measured | value | pass mark | passed |", "|---|---|---|---|")
    for name, (part, limit) in parts.items():
        count = len(rows)
        try:
            with redirect_stdout(sys.stderr), time_limit(limit):
                for headline in part(effort or Effort()):
                    rows.append(headline)
        except Exception as error:
            missing = missing_extra(error, name) if isinstance(error, ModuleNotFoundError) else ""
            failures[name] = missing or error_summary(error)
        write(*(f"| {' | '.join(headline.cells())} |" for headline in rows[count:]))
    write("", *(f"Not measured: {name}: {reason}." for name, reason in failures.items()))
    return {
        "machine": lines[0],
        "rows": [asdict(each) | {"passed": each.passed} for each in rows],
        "failures": failures,
        "table": "\n".join(lines) + "\n",
    }
