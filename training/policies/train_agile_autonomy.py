"""Training Agile Autonomy: trajectories imitated from an expert that samples and knows the world.

After "Learning High-Speed Flight in the Wild" (A. Loquercio et al., Science Robotics 2021). As
published: depth to 20 m and a state of 18 numbers give three trajectories of ten waypoints in one
second with a cost each; relaxed winner-takes-all with epsilon 0.05 on the expert's three best; the
cost head learns the collision cost of what was predicted; data is aggregated in rounds in which the
student flies while the expert says what it would have done; 15 Hz.

Chosen here: the expert is the lattice of `systems.policies.trajectory_lattice` instead of a
Metropolis-Hastings sampler, because it finds its three best distinct trajectories in 2 ms; a
convolutional encoder of 32x24 pixels, trained with the rest, instead of a frozen MobileNet at 224,
whose weights alone are 14 MB and whose forward pass takes 15 ms of a core; dense layers instead of
convolutions of length one; experts much worse than the best are not imitated; contact costs 2,
which the published cost has at 0.3 m, at the vehicle's own radius; a metre towards the goal is
worth 0.1 of cost when a hypothesis is chosen, without which the chosen one was often to stay.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from splatpilot.systems.common.progress import Progress
from splatpilot.systems.common.seeds import first_training_seed
from splatpilot.systems.policies.agile_autonomy import (
    AGILE_NETWORK,
    FOV_X,
    MAX_DEPTH,
    MIN_DEPTH,
    MODES,
    PROGRESS,
    RATE,
    state_observation,
)
from splatpilot.systems.policies.hypotheses import NUM_WAYPOINTS
from splatpilot.systems.policies.lattice import LatticeConfig, TrajectoryLattice
from splatpilot.systems.policies.observations import target_velocity
from splatpilot.systems.policies.planner import plan
from splatpilot.systems.sensing.noise import ObservationNoise
from splatpilot.systems.vehicle.flatness import FlatnessControllerConfig
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS
from splatpilot.systems.vehicle.state import QuadrotorState
from splatpilot.training.policies.evaluation import (
    FlightConditions,
    evaluate_agent,
    render_depth,
    validate_speeds,
)
from splatpilot.training.policies.image_noise import (
    noisy_depth,
    training_noise,
    validate_training_noise,
)
from splatpilot.training.policies.networks import TrajectoryModule
from splatpilot.training.policies.ray_casting import PixelRays
from splatpilot.training.policies.trainer import Schedule
from splatpilot.training.policies.training_worlds import (
    STARTS,
    WorldBatch,
    WorldSelection,
    training_worlds,
    validation_worlds,
)
from splatpilot.training.policies.vehicles import (
    BodyRate,
    Observation,
    choose_rows,
    delayed,
    draw_frames,
    frame_ages,
    reaching_acceleration,
    remember,
    remembered,
)

LOOKAHEAD = 3
"""The waypoint that is tracked: at 0.4 s, as the controller's lookahead."""


class AgileAutonomyAgent:
    """Flies by the cheapest hypothesis, as `HypothesisSelector` and `FlatnessController` do."""

    rate = RATE

    def __init__(self, network: TrajectoryModule, device: torch.device | str = "cpu") -> None:
        spec = network.spec
        self.network = network
        self.rays = PixelRays.of(spec.image_width, spec.image_height, FOV_X)
        self._device = device

    def initial_memory(self, count: int) -> Tensor:
        return torch.zeros(count, 0, device=self._device)

    def observe(self, seen: Observation) -> tuple[Tensor, Tensor]:
        """Images (N, 24, 32) and states (N, 18)."""
        spec, vehicle, R_WB = self.network.spec, seen.vehicle, seen.vehicle.attitude()
        image = 1.0 / seen.depth.clamp(MIN_DEPTH, MAX_DEPTH)
        rates = (
            QuadrotorState.of(vehicle.state).w_WB_B
            if isinstance(vehicle, BodyRate)
            else 0.0 * vehicle.v
        )
        v_target = target_velocity(vehicle.p, seen.p_WG, seen.speed)
        state = state_observation(R_WB, vehicle.v, rates, v_target)
        return image.reshape(-1, spec.image_height, spec.image_width), state

    def hypotheses(self, seen: Observation) -> tuple[Tensor, Tensor]:
        """Waypoints (N, 3, 10, 3) [m] in the body frame and costs (N, 3) less the progress made."""
        image, state = self.observe(seen)
        waypoints, costs = self.network(image, state)
        ahead_B = torch.nn.functional.normalize(state[:, -3:], dim=1)
        return waypoints, costs - PROGRESS * (waypoints[:, :, -1] * ahead_B[:, None]).sum(2)

    def decide(self, seen: Observation, memory: Tensor) -> tuple[Tensor, None, Tensor]:
        waypoints, costs = self.hypotheses(seen)
        best = waypoints[torch.arange(len(costs), device=costs.device), costs.argmin(1)]
        p_WR = seen.vehicle.p + (seen.vehicle.attitude() @ best[:, LOOKAHEAD, :, None])[:, :, 0]
        return reaching_acceleration(p_WR, seen.vehicle), None, memory


EPSILON = 0.05
"""Part of an expert's pull on the hypotheses that are not the closest to it."""

_WORSE = 1.5  # [s] of cost by which an expert's trajectory may be worse than its best


@dataclass
class AgileAutonomyTraining:
    """A training run."""

    # Seed of everything random, 0 to 999.
    seed: int = 0
    # Where the tensors live: cpu, or cuda.
    device: str = "cpu"
    schedule: Schedule = field(
        default_factory=lambda: Schedule(updates=14_000, validate_every=1000, checkpoint_every=1000)
    )
    worlds: WorldSelection = field(default_factory=WorldSelection)
    # [-] Rounds of data: in the first the expert flies, then the student more and more.
    rounds: int = 8
    # [-] Updates between rounds.
    round_updates: int = 1000
    # [-] Vehicles in flight at once, each in a world of its own.
    environments: int = 90
    # [-] Steps of 1/15 s that they fly in a round.
    steps: int = 450
    # [-] Steps between two questions to the expert.
    ask_every: int = 4
    # [m/s] Speeds that are asked for.
    speeds: list[float] = field(default_factory=lambda: [1.5, 2.0, 3.0, 4.0])
    # [-] Samples a step of the optimiser.
    batch: int = 128
    # [-] Weight of the cost head's error.
    cost_weight: float = 0.1
    # What the images are disturbed by, and how late they are.
    noise: ObservationNoise = field(default_factory=training_noise)
    # How the flights are that choose among checkpoints.
    validation: FlightConditions = field(default_factory=lambda: FlightConditions(body_rate=True))

    def validate(self) -> None:
        """Raises ValueError on a value out of range, naming it, its limit and the remedy."""
        first_training_seed(self.seed)
        self.schedule.validate()
        self.worlds.validate()
        for name in ("rounds", "round_updates", "environments", "steps", "ask_every", "batch"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be at least 1")
        validate_training_noise(self.noise, "noise", of_depth=True, of_colors=False, of_time=True)
        self.validation.validate()
        validate_speeds(self.speeds, "speeds")


class AgileAutonomyTrainer:
    """See `splatpilot.training.policies.trainer.Trainer`."""

    policy = "agile_autonomy"

    def __init__(self, config: AgileAutonomyTraining) -> None:
        self._config = config
        self.spec = AGILE_NETWORK
        self.network = TrajectoryModule(self.spec).to(config.device)
        self._agent = AgileAutonomyAgent(self.network, config.device)
        self._generator = torch.Generator(config.device).manual_seed(config.seed)
        self._worlds = training_worlds(config.worlds, config.seed, config.device)
        self._validation = validation_worlds(config.worlds, config.device)
        self._lattices = [TrajectoryLattice(LatticeConfig(speed=s)) for s in config.speeds]
        self._data: dict[str, Tensor] = {}

    def begin_update(self, update: int) -> None:
        config = self._config
        number, within = divmod(update, config.round_updates)
        if within == 0 and number < config.rounds:
            student = number / config.rounds  # part of the vehicles that the student flies
            what = f"collecting round {number + 1} of {config.rounds}"
            steps = Progress(range(config.steps), what, unit="step", leave=False)
            new = self._collect(student, number * config.environments, steps)
            if self._data:
                new = {name: torch.cat([self._data[name], new[name]]) for name in new}
            self._data = new

    def losses(self) -> dict[str, Tensor]:
        config, data = self._config, self._data
        chosen = torch.randint(
            len(data["state"]), (config.batch,), generator=self._generator, device=config.device
        )
        sample = {name: values[chosen] for name, values in data.items()}
        spec = self.spec
        depth = noisy_depth(sample["depth"].float(), config.noise, self._generator)
        image = (1.0 / depth.clamp(MIN_DEPTH, MAX_DEPTH)).reshape(
            -1, spec.image_height, spec.image_width
        )
        waypoints, costs = self.network(image, sample["state"])
        errors = (10.0 / (3 * NUM_WAYPOINTS)) * (
            sample["experts"][:, :, None] - waypoints[:, None]
        ).square().sum((3, 4))  # (N, K, M)
        pull = torch.full_like(errors, EPSILON / (MODES - 1))
        pull.scatter_(2, errors.argmin(2, keepdim=True), 1.0 - EPSILON)
        imitated = (pull * errors).sum(2) * sample["imitated"]
        target = self._collision_costs(waypoints.detach(), sample)
        return {
            "imitation": imitated.sum(1).mean(),
            "cost": config.cost_weight * (costs - target).square().sum(1).mean(),
        }

    def evaluate(self) -> dict[str, float]:
        config = self._config
        return evaluate_agent(
            self._agent, self._validation, config.validation, config.noise
        ).measures(config.worlds.turns)

    def state_dict(self) -> dict[str, Any]:
        return {"data": self._data, "generator": self._generator.get_state()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self._data = state["data"]
        self._generator.set_state(state["generator"])

    @torch.no_grad()
    def _collision_costs(self, waypoints_B: Tensor, sample: dict[str, Tensor]) -> Tensor:
        """The mean collision cost (N, M) of trajectories (N, M, 10, 3) [m] in the body frame."""
        N, M = waypoints_B.shape[:2]
        points = waypoints_B.flatten(1, 2) @ sample["R_WB"].mT + sample["p_WB"][:, None]
        world = sample["world"].repeat_interleave(points.shape[1])
        clearance = self._worlds.distance(points.flatten(0, 1), world) - VEHICLE_RADIUS
        return collision_cost(clearance).reshape(N, M, -1).mean(2)

    @torch.no_grad()
    def _collect(self, student: float, first_world: int, steps: Iterable[int]) -> dict[str, Tensor]:
        """Observations, and what the expert would do, while both fly."""
        config, worlds = self._config, self._worlds
        N, device = config.environments, config.device
        world = (first_world + torch.arange(N, device=device)) % len(worlds)
        p_WG = worlds.p_WG[world]
        which = torch.randint(len(config.speeds), (N,), generator=self._generator, device=device)
        speed = torch.tensor(config.speeds, device=device)[which]
        control = FlatnessControllerConfig()
        vehicle, by_student = self._start(worlds, world, student)
        past = remembered(vehicle, config.noise, RATE)
        frames = draw_frames(config.noise, N, self._generator)
        tracked = vehicle.p[:, None].repeat(1, NUM_WAYPOINTS + config.ask_every, 1)
        rows: list[dict[str, Tensor]] = []
        for step in steps:
            distances, _ = worlds.geometry.nearest(vehicle.p, world, 1)
            ended = (distances[:, 0] < VEHICLE_RADIUS) | ((vehicle.p - p_WG).norm(dim=1) < 0.5)
            inside = (vehicle.p > worlds.lower_W[world]) & (vehicle.p < worlds.upper_W[world])
            ended |= ~inside.all(1)
            if ended.any():
                fresh, flown = self._start(worlds, world, student)
                vehicle = choose_rows(ended, fresh, vehicle)
                past = choose_rows(ended, remembered(fresh, config.noise, RATE), past)
                by_student = torch.where(ended, flown, by_student)
                tracked = torch.where(ended[:, None, None], vehicle.p[:, None], tracked)
            past, R_WB = remember(past, vehicle), vehicle.attitude()
            now = torch.full((N,), step / RATE, device=device)
            then = delayed(past, frame_ages(frames, config.noise, now), RATE)
            depth = render_depth(then, worlds.geometry, self._agent.rays, world)
            seen = Observation(depth, vehicle, p_WG, speed)
            asked = step % config.ask_every == 0
            if asked:
                valid, experts, costs = self._ask(vehicle, world, which)
                best = experts[:, 0] @ R_WB.mT + vehicle.p[:, None]
                hold = best[:, -1:].expand(-1, config.ask_every, -1)
                tracked = torch.where(valid[:, None, None], torch.cat([best, hold], 1), tracked)
                _, state = self._agent.observe(seen)
                worse = costs - costs[:, :1]
                sample = {
                    "depth": depth.half(),
                    "state": state,
                    "experts": experts,
                    "imitated": (worse < _WORSE).float(),
                    "world": world,
                    "R_WB": R_WB,
                    "p_WB": vehicle.p,
                }
                rows.append({name: values[valid] for name, values in sample.items()})
            # The time since the plan, in waypoints of 0.1 s; 1/15 s are two thirds of one.
            along = LOOKAHEAD + (step % config.ask_every) * 2.0 / 3.0
            i, part = int(along), along - int(along)
            p_WR = (1.0 - part) * tracked[:, i] + part * tracked[:, i + 1]
            noisy = seen._replace(depth=noisy_depth(depth, config.noise, self._generator))
            of_student, _, _ = self._agent.decide(noisy, self._agent.initial_memory(N))
            a_cmd = torch.where(
                by_student[:, None], of_student, reaching_acceleration(p_WR, vehicle)
            )
            vehicle = vehicle.step(a_cmd.clamp(-12.0, 12.0), 1.0 / RATE, control)
        return {name: torch.cat([row[name] for row in rows]) for name in rows[0]}

    def _start(self, worlds: WorldBatch, world: Tensor, student: float) -> tuple[BodyRate, Tensor]:
        """Vehicles at rest anywhere in their worlds, and which of them the student flies."""
        N, device = len(world), world.device
        draws = torch.rand(N, 3, generator=self._generator, device=device)
        p = worlds.starts_W[world, (draws[:, 0] * STARTS).long().clamp(max=STARTS - 1)]
        way = worlds.way(p, world)
        yaw = torch.atan2(way[:, 1], way[:, 0]) + 1.5 * (draws[:, 1] - 0.5)
        return BodyRate.hovering(p, yaw), draws[:, 2] < student

    def _ask(
        self, vehicle: BodyRate, world: Tensor, which: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The expert's three best: whether it has any (N,), waypoints (N, 3, 10, 3) [m] in the
        body frame, and costs (N, 3)."""
        N, device = len(world), world.device
        valid = torch.zeros(N, dtype=torch.bool)
        experts, costs = torch.zeros(N, 3, NUM_WAYPOINTS, 3), torch.zeros(N, 3)
        for n, state in enumerate(vehicle.state.double().cpu().numpy()):
            esdf, toa = self._worlds.maps[int(world[n])]
            try:
                best = plan(0.0, state, esdf, toa, self._lattices[int(which[n])])
            except ValueError:  # no way leads on from here
                continue
            valid[n] = True
            experts[n] = torch.tensor(best.waypoints_B)
            costs[n] = torch.tensor(best.costs)
        return valid.to(device), experts.to(device), costs.to(device)


def collision_cost(clearance: Tensor) -> Tensor:
    """The cost [-] of being at a clearance (...,) [m]: 4 - 2 d² / 0.09 below d = 0.3 m and from
    there linearly from 2 to 0 at d = 0.8 m, with d = clearance + 0.3 m."""
    d = clearance + 0.3
    inner = 4.0 - 2.0 * d.clamp(min=0.0).square() / 0.09
    outer = 2.0 * (0.8 - d) / 0.5
    return torch.where(d < 0.3, inner, outer.clamp(min=0.0))
