"""Trains Agile Autonomy: imitation of an expert that samples trajectories and knows the world.

After "Learning High-Speed Flight in the Wild" (A. Loquercio et al., Science Robotics 2021).
Different here: the expert is `systems.policies.lattice` instead of a Metropolis-Hastings sampler; a
trained encoder of 32x24 pixels instead of a frozen MobileNet; dense layers; the expert's much worse
trajectories are not imitated; contact costs 2 at the vehicle's own radius instead of 0.3 m; a meter
toward the goal reduces the cost by 0.1 when a hypothesis is chosen.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from splatpilot.systems.common.progress import Progress
from splatpilot.systems.common.validation import bounded, require_field
from splatpilot.systems.policies import agile_autonomy
from splatpilot.systems.policies.base import target_velocity
from splatpilot.systems.policies.hypotheses import NUM_WAYPOINTS
from splatpilot.systems.policies.lattice import LatticeConfig, TrajectoryLattice
from splatpilot.systems.policies.planner import plan
from splatpilot.systems.sensing.noise import ObservationNoise
from splatpilot.systems.vehicle.flatness import FlatnessControllerConfig, reaching_acceleration
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS
from splatpilot.systems.vehicle.state import QuadrotorState
from splatpilot.training.policies import vehicles
from splatpilot.training.policies.augmentation import check_noise, depth_noise, noisy_depth
from splatpilot.training.policies.networks import TrajectoryModule
from splatpilot.training.policies.ray_casting import PixelRays
from splatpilot.training.policies.rollouts import (
    FlightConditions,
    FlightTrainer,
    FlightTraining,
    render_depth,
)
from splatpilot.training.policies.train_student import hypothesis_errors
from splatpilot.training.policies.trainer import Schedule
from splatpilot.training.policies.training_worlds import STARTS

LOOKAHEAD = 3  # index of the tracked waypoint, at 0.4 s, the controller's lookahead


class AgileAutonomyAgent:
    """Flies by the cheapest hypothesis, as `HypothesisSelector` and `FlatnessController` do."""

    rate = agile_autonomy.RATE

    def __init__(self, network: TrajectoryModule, device: torch.device | str = "cpu") -> None:
        spec = network.spec
        self.network = network
        self.rays = PixelRays.of(spec.image_width, spec.image_height, agile_autonomy.FOV_X)
        self._device = device

    def initial_memory(self, count: int) -> Tensor:
        return torch.zeros(count, 0, device=self._device)

    def observe(self, seen: vehicles.Observation) -> tuple[Tensor, Tensor]:
        """Computes images (N, 24, 32) and states (N, 18)."""
        vehicle, R_WB = seen.vehicle, seen.vehicle.attitude()
        rates = 0.0 * vehicle.v
        if isinstance(vehicle, vehicles.BodyRate):
            rates = QuadrotorState.of(vehicle.state).w_WB_B
        v_target = target_velocity(vehicle.p, seen.p_WG, seen.speed)
        state = agile_autonomy.state_observation(R_WB, vehicle.v, rates, v_target)
        return self.encode_depth(seen.depth), state

    def encode_depth(self, depth: Tensor) -> Tensor:
        """Computes images (N, 24, 32) of depth (N, R) [m]."""
        image = 1.0 / depth.clamp(agile_autonomy.MIN_DEPTH, agile_autonomy.MAX_DEPTH)
        return image.reshape(-1, *self.network.spec.image_size()[1:])

    def hypotheses(self, seen: vehicles.Observation) -> tuple[Tensor, Tensor]:
        """Computes waypoints (N, 3, 10, 3) [m] in the body frame and costs (N, 3) less progress."""
        image, state = self.observe(seen)
        waypoints, costs = self.network(image, state)
        ahead_B = torch.nn.functional.normalize(state[:, -3:], dim=1)
        progress = (waypoints[:, :, -1] * ahead_B[:, None]).sum(2)
        return waypoints, costs - agile_autonomy.PROGRESS * progress

    def decide(self, seen: vehicles.Observation, memory: Tensor) -> tuple[Tensor, None, Tensor]:
        waypoints, costs = self.hypotheses(seen)
        best = waypoints[torch.arange(len(costs), device=costs.device), costs.argmin(1)]
        p_WR = seen.vehicle.p + (seen.vehicle.attitude() @ best[:, LOOKAHEAD, :, None])[:, :, 0]
        return _reach(p_WR, seen.vehicle), None, memory


def _reach(p_WR: Tensor, vehicle: vehicles.Vehicle) -> Tensor:
    return reaching_acceleration(p_WR, vehicle.p, vehicle.v, FlatnessControllerConfig.lookahead)


EPSILON = 0.05  # fraction of an expert's pull on the hypotheses that are not the closest to it
_MAX_EXCESS = 1.5  # [s] of cost over the expert's best, of trajectories that are imitated


@dataclass
class AgileAutonomyTraining(FlightTraining):
    """A training run of Agile Autonomy."""

    schedule: Schedule = field(
        default_factory=lambda: Schedule(updates=14_000, validate_every=1000, checkpoint_every=1000)
    )
    # [-] Rounds of data: in the first the expert flies, then the student more and more.
    rounds: int = bounded(8, "[1, inf)")
    # [-] Updates between rounds.
    round_updates: int = bounded(1000, "[1, inf)")
    # [-] Vehicles in flight at once, each in another world.
    environments: int = bounded(90, "[1, inf)")
    # [-] Steps of 1/15 s in a round.
    steps: int = bounded(450, "[1, inf)")
    # [-] Steps between two labels of the expert.
    ask_every: int = bounded(4, "[1, inf)")
    # [m/s] Nominal speeds.
    speeds: list[float] = bounded(lambda: [1.5, 2.0, 3.0, 4.0], "[0.1, 10] m/s")
    # [-] Samples per step of the optimizer.
    batch: int = bounded(128, "[1, inf)")
    # [-] Weight of the costs' error.
    cost_weight: float = 0.1
    # Noise and delay of images.
    noise: ObservationNoise = field(default_factory=depth_noise)
    # Conditions of the flights that select among checkpoints.
    validation: FlightConditions = field(default_factory=lambda: FlightConditions(body_rate=True))

    def check(self) -> None:
        super().check()
        check_noise(self.noise, depth=True, time=True)
        require_field(self, "speeds", self.speeds, "one speed or more")


class AgileAutonomyTrainer(FlightTrainer):
    """Trains Agile Autonomy."""

    policy = "agile_autonomy"

    def __init__(self, config: AgileAutonomyTraining) -> None:
        network = TrajectoryModule(agile_autonomy.AGILE_NETWORK).to(config.device)
        super().__init__(config, AgileAutonomyAgent(network, config.device), config.noise)
        self._config = config
        self._lattices = [TrajectoryLattice(LatticeConfig(speed=s)) for s in config.speeds]
        self._data: dict[str, Tensor] = {}

    def begin_update(self, update: int) -> None:
        config = self._config
        number, within = divmod(update, config.round_updates)
        if within == 0 and number < config.rounds:
            student = number / config.rounds  # fraction of vehicles that the student flies
            what = f"collecting round {number + 1} of {config.rounds}"
            steps = Progress(range(config.steps), what, unit="step", leave=False)
            new = self._collect(student, number * config.environments, steps)
            if self._data:
                new = {name: torch.cat([self._data[name], new[name]]) for name in new}
            self._data = new

    def losses(self) -> dict[str, Tensor]:
        config, data = self._config, self._data
        chosen = torch.randint(
            len(data["state"]), (config.batch,), generator=self.generator, device=config.device
        )
        sample = {name: values[chosen] for name, values in data.items()}
        depth = noisy_depth(sample["depth"].float(), config.noise, self.generator)
        waypoints, costs = self.network(self.agent.encode_depth(depth), sample["state"])
        errors = hypothesis_errors(sample["experts"], waypoints[:, None])  # (N, K, M)
        pull = torch.full_like(errors, EPSILON / (agile_autonomy.MODES - 1))
        pull.scatter_(2, errors.argmin(2, keepdim=True), 1.0 - EPSILON)
        imitated = (pull * errors).sum(2) * sample["imitated"]
        target = self._collision_costs(waypoints.detach(), sample)
        return {
            "imitation": imitated.sum(1).mean(),
            "cost": config.cost_weight * (costs - target).square().sum(1).mean(),
        }

    def state_dict(self) -> dict[str, Any]:
        return super().state_dict() | {"data": self._data}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self._data = state["data"]
        super().load_state_dict(state)

    @torch.no_grad()
    def _collision_costs(self, waypoints_B: Tensor, sample: dict[str, Tensor]) -> Tensor:
        """Computes mean collision costs (N, M) of trajectories (N, M, 10, 3) [m] in B, with
        d = clearance + 0.3 m: 4 - 2 d² / 0.09 below 0.3 m, from there linearly to 0 at 0.8 m."""
        N, M = waypoints_B.shape[:2]
        points = waypoints_B.flatten(1, 2) @ sample["R_WB"].mT + sample["p_WB"][:, None]
        world = sample["world"].repeat_interleave(points.shape[1])
        clearance = self.worlds.distance(points.flatten(0, 1), world) - VEHICLE_RADIUS
        d = clearance + 0.3
        inner, outer = 4.0 - 2.0 * d.clamp(min=0.0).square() / 0.09, 2.0 * (0.8 - d) / 0.5
        return torch.where(d < 0.3, inner, outer.clamp(min=0.0)).reshape(N, M, -1).mean(2)

    @torch.no_grad()
    def _collect(self, student: float, first_world: int, steps: Iterable[int]) -> dict[str, Tensor]:
        """Collects labels in worlds from `first_world`; the student flies a fraction of them."""
        config, worlds = self._config, self.worlds
        N, device = config.environments, config.device
        world = (first_world + torch.arange(N, device=device)) % len(worlds)
        p_WG = worlds.p_WG[world]
        which = torch.randint(len(config.speeds), (N,), generator=self.generator, device=device)
        speed = torch.tensor(config.speeds, device=device)[which]
        vehicle, by_student = self._start(world, student)
        history = vehicles.History.start(vehicle, config.noise, agile_autonomy.RATE, self.generator)
        tracked = vehicle.p[:, None].repeat(1, NUM_WAYPOINTS + config.ask_every, 1)
        rows: list[dict[str, Tensor]] = []
        for step in steps:
            ended = worlds.ended(vehicle.p, world)
            if ended.any():
                new, flown = self._start(world, student)
                vehicle = vehicles.choose_rows(ended, new, vehicle)
                start = vehicles.History.start(new, config.noise, self.agent.rate, self.generator)
                past = vehicles.choose_rows(ended, start.past, history.past)
                history = history._replace(past=past)
                by_student = torch.where(ended, flown, by_student)
                tracked = torch.where(ended[:, None, None], vehicle.p[:, None], tracked)
            history, R_WB = history.push(vehicle), vehicle.attitude()
            now = torch.full((N,), step / agile_autonomy.RATE, device=device)
            seen_from = history.seen(config.noise, agile_autonomy.RATE, now)
            depth = render_depth(seen_from, worlds.geometry, self.agent.rays, world)
            seen = vehicles.Observation(depth, vehicle, p_WG, speed)
            if step % config.ask_every == 0:
                valid, experts, costs = self._ask(vehicle, world, which)
                best = experts[:, 0] @ R_WB.mT + vehicle.p[:, None]
                hold = best[:, -1:].expand(-1, config.ask_every, -1)
                tracked = torch.where(valid[:, None, None], torch.cat([best, hold], 1), tracked)
                _, state = self.agent.observe(seen)
                excess = costs - costs[:, :1]
                sample = {
                    "depth": depth.half(),
                    "state": state,
                    "experts": experts,
                    "imitated": (excess < _MAX_EXCESS).float(),
                    "world": world,
                    "R_WB": R_WB,
                    "p_WB": vehicle.p,
                }
                rows.append({name: values[valid] for name, values in sample.items()})
            # The time since the plan, in waypoints of 0.1 s; 1/15 s are two thirds of one.
            along = LOOKAHEAD + (step % config.ask_every) * 2.0 / 3.0
            i, part = int(along), along - int(along)
            p_WR = (1.0 - part) * tracked[:, i] + part * tracked[:, i + 1]
            noisy = seen._replace(depth=noisy_depth(depth, config.noise, self.generator))
            a_student, _, _ = self.agent.decide(noisy, self.agent.initial_memory(N))
            a_expert = _reach(p_WR, vehicle)
            a_cmd = torch.where(by_student[:, None], a_student, a_expert)
            vehicle = vehicle.step(a_cmd.clamp(-12.0, 12.0), 1.0 / agile_autonomy.RATE)
        return {name: torch.cat([row[name] for row in rows]) for name in rows[0]}

    def _start(self, world: Tensor, student: float) -> tuple[vehicles.BodyRate, Tensor]:
        """Places vehicles at rest in their worlds; draws which of them the student flies."""
        draws = torch.rand(len(world), 3, generator=self.generator, device=world.device)
        p = self.worlds.starts_W[world, (draws[:, 0] * STARTS).long().clamp(max=STARTS - 1)]
        direction = self.worlds.direction(p, world)
        yaw = torch.atan2(direction[:, 1], direction[:, 0]) + 1.5 * (draws[:, 1] - 0.5)
        return vehicles.BodyRate.hovering(p, yaw), draws[:, 2] < student

    def _ask(
        self, vehicle: vehicles.BodyRate, world: Tensor, which: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Computes the expert's best: valid (N,), points (N, 3, 10, 3) [m] in B, costs (N, 3)."""
        N, device = len(world), world.device
        valid = torch.zeros(N, dtype=torch.bool)
        experts, costs = torch.zeros(N, 3, NUM_WAYPOINTS, 3), torch.zeros(N, 3)
        for n, state in enumerate(vehicle.state.double().cpu().numpy()):
            esdf, toa = self.worlds.maps[int(world[n])]
            try:
                best = plan(0.0, state, esdf, toa, self._lattices[int(which[n])])
            except ValueError:  # no path leads on from here
                continue
            valid[n] = True
            experts[n] = torch.tensor(best.waypoints_B)
            costs[n] = torch.tensor(best.costs)
        return valid.to(device), experts.to(device), costs.to(device)
