"""Training runs: any policy, resumable, with all that was done written beside the weights."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import torch
from tqdm import tqdm

from splatpilot.systems.extras import import_extra
from splatpilot.systems.files import written_atomically
from splatpilot.training.policies.run_folder import RunFolder
from splatpilot.training.policies.through_dynamics import NotFiniteError


@dataclass
class Schedule:
    """How long training takes and what it leaves."""

    # [-] Steps of the optimiser.
    updates: int = 1400
    # [-] Updates between two measurements of the success on held-out courses; the weights of the
    # best are kept.
    validate_every: int = 200
    # [-] Updates between two checkpoints that training goes on from when it was interrupted.
    checkpoint_every: int = 100
    # [-] Step size of AdamW, which falls to nothing over the last part `decay` of the updates.
    learning_rate: float = 1e-3
    decay: float = 0.3
    weight_decay: float = 0.01
    # [-] Greatest norm of the gradient.
    clip: float = 1.0
    # Whether curves are also written for TensorBoard.
    tensorboard: bool = False

    def validate(self) -> None:
        """Raises ValueError on a value out of range, naming it, its limit and the remedy."""
        for name in ("updates", "validate_every", "checkpoint_every"):
            if getattr(self, name) < 1:
                raise ValueError(f"schedule.{name} is {getattr(self, name)}; it must be at least 1")
        for name in ("learning_rate", "clip"):
            if not 0.0 < getattr(self, name) < float("inf"):
                raise ValueError(f"schedule.{name} is {getattr(self, name)}; it must be positive")
        if not 0.0 <= self.decay <= 1.0:
            raise ValueError(f"schedule.decay is {self.decay}; it must be between 0 and 1")

    def factor(self, update: int) -> float:
        """What the step size is multiplied by at an update."""
        left = (self.updates - update) / max(self.decay * self.updates, 1e-9)
        return min(1.0, max(left, 0.02))


class TrainingConfig(Protocol):
    """What every policy's configuration has beside its own."""

    seed: int
    device: str
    schedule: Schedule

    def validate(self) -> None: ...


class Trainee(Protocol):
    """A policy in training, whatever it learns from."""

    policy: str
    spec: Any

    @property
    def network(self) -> torch.nn.Module: ...

    def begin(self, update: int) -> None:
        """Called before each update with its number."""
        ...

    def lesson(self) -> dict[str, torch.Tensor]:
        """The terms of the loss, differentiable by the network's weights."""
        ...

    def measured(self) -> dict[str, float]:
        """Success and more on held-out courses; `success` chooses among checkpoints."""
        ...

    def state(self) -> dict[str, Any]:
        """Everything but weights that the next lesson depends on."""
        ...

    def restore(self, state: dict[str, Any]) -> None:
        """The inverse of `state`."""
        ...


@dataclass
class _Progress:
    """Where a run is, as its checkpoint holds it."""

    update: int = 0
    cpu_seconds: float = 0.0
    best: dict[str, Any] = field(default_factory=dict)
    means: dict[str, float] = field(default_factory=dict)
    curves: list[dict[str, float]] = field(default_factory=list)


def run[Config: TrainingConfig](
    *, config: Config, out: Path, make: Callable[[Config], Trainee]
) -> dict[str, Any]:
    """
    Trains a policy, from where an interrupted run of the same configuration in `out` stopped.

    Leaves in `out`: `POLICY.npz`, the weights that did best on held-out courses, for
    `PolicyCheckpoint`; `config.yaml`; `curves.csv`, the terms of the loss and the success over the
    updates; `POLICY.md`, a model card; `summary.json`; `checkpoint.pt`, to go on from.

    Args:
        config: with its seed it decides the result: on a CPU the same weights, bit for bit,
            however often the run was interrupted.
        out: folder.
        make: builds what is trained from its configuration.

    Returns:
        What `summary.json` says.

    Raises:
        ValueError: on a config out of range; if `out` holds a run of another configuration or a
            damaged checkpoint; if a term of the loss is not finite, naming it: the best weights so
            far stay in `out`.
        OSError: if `out` cannot be written.
    """
    config.validate()
    folder = RunFolder.claimed(out, config)
    schedule = config.schedule
    torch.set_num_threads(1)  # Sums of several threads would depend on their number.
    started = time.process_time()
    torch.manual_seed(config.seed)
    trainee = make(config)
    network = trainee.network
    optimizer = torch.optim.AdamW(
        network.parameters(), lr=schedule.learning_rate, weight_decay=schedule.weight_decay
    )
    progress = _Progress()
    checkpoint = out / "checkpoint.pt"
    if checkpoint.exists():
        progress = _resumed(checkpoint, trainee, optimizer)
    spent_before = progress.cpu_seconds
    writer = None
    if schedule.tensorboard:
        writer = import_extra("torch.utils.tensorboard", "tensorboard").SummaryWriter(str(out))

    def save() -> None:
        progress.cpu_seconds = spent_before + time.process_time() - started
        with written_atomically(checkpoint) as path:
            torch.save(
                {
                    "progress": vars(progress),
                    "network": network.state_dict(),
                    "optimizer": optimizer.state_dict(),
                    "trainee": trainee.state(),
                },
                path,
            )
        folder.write_curves(progress.curves)

    bar = tqdm(
        total=schedule.updates, initial=progress.update, desc=trainee.policy, unit="update",
        disable=None,
    )  # fmt: skip
    with bar:
        while progress.update < schedule.updates:
            for group in optimizer.param_groups:
                group["lr"] = schedule.learning_rate * schedule.factor(progress.update)
            trainee.begin(progress.update)
            try:
                terms = descend(trainee.lesson, network, optimizer, schedule.clip)
            except NotFiniteError as error:
                raise ValueError(
                    f"training stopped at update {progress.update}: {error}; the best weights so "
                    f"far are kept in {out}; lower schedule.learning_rate"
                ) from None
            progress.update += 1
            bar.update()
            means = progress.means
            for name, value in terms.items():
                means[name] = value if name not in means else 0.98 * means[name] + 0.02 * value
            due = progress.update % schedule.validate_every == 0
            if due or progress.update == schedule.updates:
                measured = trainee.measured()
                row = {"update": float(progress.update), **means, **measured}
                progress.curves.append(row)
                bar.set_postfix(success=f"{measured['success']:.2f}")
                if writer is not None:
                    for name, value in row.items():
                        writer.add_scalar(name, value, progress.update)
                if measured["success"] >= progress.best.get("success", -1.0):
                    progress.best = {"update": progress.update, **measured}
                    folder.write_weights(trainee.policy, trainee.spec, network, progress.best)
            if due or progress.update % schedule.checkpoint_every == 0:
                save()
    save()
    summary = {
        "policy": trainee.policy,
        "seed": config.seed,
        "updates": progress.update,
        "cpu_minutes": round(progress.cpu_seconds / 60.0, 2),
        "best": progress.best,
    }
    folder.write_summary(summary)
    print(
        f"{trainee.policy}: success {progress.best['success']:.0%} on held-out courses after "
        f"{progress.best['update']} of {progress.update} updates, "
        f"{progress.cpu_seconds / 60.0:.1f} CPU minutes; weights in {out / trainee.policy}.npz"
    )
    return summary


def descend(
    lesson: Callable[[], dict[str, torch.Tensor]],
    network: torch.nn.Module,
    optimizer: torch.optim.Optimizer,
    clip: float,
) -> dict[str, float]:
    """One step down the sum of the terms that `lesson` returns; their values.

    Raises:
        NotFiniteError: naming the term, or the gradient; the weights are then as before.
    """
    terms = lesson()
    for name, term in terms.items():
        if not torch.isfinite(term):
            raise NotFiniteError(f"the term {name!r} of the loss became {term.item()}")
    optimizer.zero_grad(set_to_none=True)
    torch.stack(list(terms.values())).sum().backward()
    norm = torch.nn.utils.clip_grad_norm_(network.parameters(), clip)
    if not torch.isfinite(norm):
        raise NotFiniteError(f"the gradient of the loss became {norm.item()}")
    optimizer.step()
    return {name: float(term.detach()) for name, term in terms.items()}


def _resumed(path: Path, trainee: Trainee, optimizer: torch.optim.Optimizer) -> _Progress:
    try:
        saved = torch.load(path, weights_only=True)
        trainee.network.load_state_dict(saved["network"])
        optimizer.load_state_dict(saved["optimizer"])
        trainee.restore(saved["trainee"])
        return _Progress(**saved["progress"])
    except Exception as error:
        reason = str(error).partition("\n")[0]
        raise ValueError(
            f"{path} is no checkpoint to go on from ({reason}); delete it to begin anew"
        ) from None
