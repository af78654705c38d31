"""Training runs: any policy, resumable, with all that was done written beside the weights."""

import csv
import io
import json
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch

from splatpilot.systems.common.files import claim_folder, held_folder, written_atomically
from splatpilot.systems.common.progress import CheckpointClock, Progress, resumable, say
from splatpilot.systems.common.provenance import revision
from splatpilot.systems.common.readers import reason_of
from splatpilot.systems.common.torch_device import (
    keep_freed_memory,
    one_torch_thread,
    require_device,
)
from splatpilot.systems.policies.checkpoint import PolicyCheckpoint
from splatpilot.training.policies.torchrun import Processes, torchrun_processes
from splatpilot.training.policies.trainer import FLIGHTS, Trainer, TrainingConfig
from splatpilot.training.reconstruction.checkpoint import event_log, load_tensors, save_tensors

CONFIG = "config.yaml"


@dataclass(frozen=True)
class RunFolder:
    """A folder that is one run's own."""

    path: Path
    config: str
    """The run's configuration, as YAML."""
    revision: str
    """Of the program, as `revision()` says."""

    @classmethod
    def claim(cls, path: Path, config: Any) -> Self:
        """Makes `path` the folder of a run of `config`, which it may be already.

        Raises:
            ValueError: if it is of a run of another configuration.
            OSError: if it cannot be written.
        """
        return cls(path, claim_folder(path / CONFIG, config), revision())

    def give_up(self) -> None:
        """Makes the folder nobody's again, where there is nothing but a run's configuration."""
        if {file.name for file in self.path.iterdir()} == {CONFIG}:
            (self.path / CONFIG).unlink()

    def write_weights(
        self, policy: str, spec: Any, network: torch.nn.Module, best: dict[str, Any]
    ) -> None:
        """Writes `POLICY.npz`; `best` is what was measured of these weights.

        They are written in single precision, or in the type that the architecture names as its
        `weights_type`.
        """
        kept_as = getattr(spec, "weights_type", np.float32)
        weights = {
            name: w.detach().cpu().numpy().astype(kept_as)
            for name, w in network.state_dict().items()
        }
        provenance = {
            "command": f"splatpilot train {policy}",
            "config": self.config,
            "revision": self.revision,
            "torch": torch.__version__,
            "best": best,
        }
        PolicyCheckpoint(policy, spec, weights, provenance).save(self.path / f"{policy}.npz")

    def write_curves(self, rows: list[dict[str, float]]) -> None:
        """Writes `curves.csv`; a row may lack columns."""
        text = io.StringIO()
        names = list(dict.fromkeys(name for row in rows for name in row))
        table = csv.DictWriter(text, names, lineterminator="\n")
        table.writeheader()
        table.writerows(rows)
        self._write("curves.csv", text.getvalue())

    def write_summary(self, summary: dict[str, Any], measures: str) -> None:
        """Writes `summary.json` and the model card `POLICY.md`; `measures` says what was measured
        on held-out worlds."""
        self._write("summary.json", json.dumps(summary, indent=2) + "\n")
        self._write(f"{summary['policy']}.md", self._model_card(summary, measures))

    def _model_card(self, summary: dict[str, Any], measures: str) -> str:
        """What there is to know of trained weights, as Markdown."""
        policy, best, minutes = summary["policy"], summary["best"], summary["cpu_minutes"]
        rows = "\n".join(
            f"| {name} | {value:.2f} |" for name, value in best.items() if name != "update"
        )
        return f"""# {policy}

Made by `splatpilot train {policy} --out DIR --config CONFIG` with the configuration below at
revision {self.revision} of the source, in {minutes:.1f} minutes of one core; {summary["updates"]}
updates, of which the weights after {best["update"]} did best on held-out worlds.

| on held-out worlds | |
|---|---|
{rows}

{measures}

```yaml
{self.config}```
"""

    def _write(self, name: str, text: str) -> None:
        with written_atomically(self.path / name) as path:
            path.write_text(text)


@dataclass
class _Position:
    """Where a run is, as its checkpoint holds it."""

    update: int = 0
    cpu_seconds: float = 0.0
    best: dict[str, Any] = field(default_factory=dict)
    means: dict[str, float] = field(default_factory=dict)
    curves: list[dict[str, float]] = field(default_factory=list)


class NotFiniteError(ValueError):
    """A term of the loss, or the gradient, became infinite or not a number."""


@one_torch_thread()
def run[Config: TrainingConfig](
    *, config: Config, out: Path, make: Callable[[Config], Trainer], bar_line: int = 0
) -> dict[str, Any]:
    """
    Trains a policy on one thread, from where an interrupted run of the same configuration in `out`
    stopped. Of several processes that torchrun started the first writes; each learns from a part of
    every batch, so that they learn what one would, up to rounding and noise.

    Leaves in `out`: `POLICY.npz`, the weights that did best on held-out worlds, for
    `PolicyCheckpoint`; `config.yaml`; `curves.csv`, the terms of the loss and the success over the
    updates; `POLICY.md`, a model card; `summary.json`; `checkpoint.pt`, to go on from.

    Args:
        config: with its seed it decides the result: on a CPU the same weights, bit for bit,
            however often the run was interrupted.
        out: folder.
        make: the trainer of that configuration.
        bar_line: line of the terminal, from the cursor down, for the progress bar.

    Returns:
        What `summary.json` says.

    Raises:
        ValueError: on a config out of range; if `out` holds a run of another configuration, one
            that learned from other files, or a damaged checkpoint; if torchrun started several and
            the trainer's batches have no parts; if a term of the loss is not finite, naming it: the
            best weights so far stay in `out`.
        OSError: if `out` cannot be written.
    """
    config.validate()
    require_device(config.device)
    keep_freed_memory()
    with torchrun_processes(config.device) as processes:
        with held_folder(out) if processes.first else nullcontext():
            return _run(config, out, make, bar_line, processes)


def _run[Config: TrainingConfig](
    config: Config,
    out: Path,
    make: Callable[[Config], Trainer],
    bar_line: int,
    processes: Processes,
) -> dict[str, Any]:
    """See `run`."""
    if not processes.first:
        processes.wait()  # until what all of them read is written
    folder = RunFolder.claim(out, config)
    schedule = config.schedule
    checkpoint = out / "checkpoint.pt"
    started, kept_update = time.process_time(), 0

    def kept() -> str:
        if not checkpoint.exists():
            return f"no update is in {out} yet; the same command starts again"
        update = f"update {kept_update} of {schedule.updates}" if kept_update else "the checkpoint"
        return f"{update} is in {out}; the same command resumes there"

    torch.manual_seed(config.seed)
    try:
        with resumable(kept):
            trainer = make(config)
    except (ValueError, OSError):  # of what it names, which can be put right in the same folder
        folder.give_up()
        raise
    if processes.first:
        processes.wait()
    processes.share_batches(trainer)
    network = trainer.network
    optimizer = torch.optim.AdamW(
        network.parameters(), lr=schedule.learning_rate, weight_decay=schedule.weight_decay
    )
    progress = _Position()
    if checkpoint.exists():
        progress = _resume(checkpoint, trainer, optimizer)
        kept_update = progress.update
        if processes.first:
            say(f"resuming {out} at update {progress.update} of {schedule.updates}")
            folder.write_curves(progress.curves)  # which a kill may have left a row behind
    spent_before = progress.cpu_seconds

    def save() -> None:
        nonlocal kept_update
        progress.cpu_seconds = spent_before + time.process_time() - started
        state = {
            "progress": vars(progress),
            "network": network.state_dict(),
            "optimizer": optimizer.state_dict(),
            "trainer": trainer.state_dict(),
            "learns_from": _learns_from(trainer),
        }
        with clock.writing():
            save_tensors(state, checkpoint)
            folder.write_curves(progress.curves)
        kept_update = progress.update

    clock = CheckpointClock()
    bar = Progress(
        total=schedule.updates, initial=progress.update, unit="update",
        disable=not processes.first,
        desc=f"training {trainer.policy}, seed {config.seed}", position=bar_line,
    )  # fmt: skip
    logs = schedule.tensorboard and processes.first
    with event_log(str(out) if logs else "") as log, resumable(kept), bar:
        while progress.update < schedule.updates:
            for group in optimizer.param_groups:
                group["lr"] = schedule.learning_rate * schedule.factor(progress.update)
            trainer.begin_update(progress.update)
            try:
                terms = step_optimizer(trainer.losses, network, optimizer, schedule.clip, processes)
            except NotFiniteError as error:
                best = f"the best weights so far are kept in {out}; " if progress.best else ""
                raise ValueError(
                    f"training stopped at update {progress.update}: {error}; {best}lower "
                    "schedule.learning_rate"
                ) from None
            progress.update += 1
            bar.update()
            means = progress.means
            for name, value in terms.items():
                means[name] = value if name not in means else 0.98 * means[name] + 0.02 * value
            bar.set_postfix_str(_shown(progress, trainer), refresh=False)
            keep, measure = schedule.due(progress.update)
            if processes.first and (keep or measure):
                measured = trainer.evaluate() if measure else {}
                row = {"update": float(progress.update), **means, **measured}
                progress.curves.append(row)
                log(progress.update, row)
                if measure and measured["success"] >= progress.best.get("success", -1.0):
                    progress.best = {"update": progress.update, **measured}
                    folder.write_weights(trainer.policy, trainer.spec, network, progress.best)
                save()
            elif processes.first and clock.is_due:
                save()
    progress.best = processes.of_first(progress.best)
    summary = {
        "policy": trainer.policy,
        "seed": config.seed,
        "updates": progress.update,
        "cpu_minutes": round(progress.cpu_seconds / 60.0, 2),
        "best": progress.best,
    }
    if not processes.first:
        return summary
    folder.write_summary(summary, getattr(trainer, "measures", FLIGHTS))
    print(
        f"{trainer.policy}: success in {progress.best['success']:.0%} of {_evaluated(trainer)} "
        f"after {progress.best['update']} of {progress.update} updates, "
        f"{progress.cpu_seconds / 60.0:.1f} CPU minutes; weights in {out / trainer.policy}.npz"
    )
    return summary


def _shown(progress: _Position, trainer: Trainer) -> str:
    """Formats the loss, and the success measured last and best."""
    shown = f"loss {progress.means['loss']:.3g}"
    if progress.best:
        last = next(row["success"] for row in reversed(progress.curves) if "success" in row)
        best = progress.best["success"]
        shown += f", success {last:.0%} of {_evaluated(trainer)}, best {best:.0%}"
    return shown


def _evaluated(trainer: Trainer) -> str:
    return f"held-out {getattr(trainer, 'evaluated', 'flights')}"


def step_optimizer(
    losses: Callable[[], dict[str, torch.Tensor]],
    network: torch.nn.Module,
    optimizer: torch.optim.Optimizer,
    clip: float,
    processes: Processes = Processes(),  # noqa: B008 (it is frozen)
) -> dict[str, float]:
    """One step down the sum of the terms that `losses` returns; their values and that of the sum,
    `loss`. What has no gradient is no part of it. Terms and gradients are the means over processes.

    Raises:
        NotFiniteError: naming the term, or the gradient; the weights are then as before.
    """
    terms = losses()
    for name, term in terms.items():
        if not torch.isfinite(term):
            raise NotFiniteError(f"the term {name!r} of the loss became {term.item()}")
    optimizer.zero_grad(set_to_none=True)
    loss = torch.stack([term for term in terms.values() if term.requires_grad]).sum()
    loss.backward()
    terms = {name: term.detach().clone() for name, term in (terms | {"loss": loss}).items()}
    gradients = [weight.grad for weight in network.parameters() if weight.grad is not None]
    processes.average([*gradients, *terms.values()])
    norm = torch.nn.utils.clip_grad_norm_(network.parameters(), clip)
    if not torch.isfinite(norm):
        raise NotFiniteError(f"the gradient of the loss became {norm.item()}")
    optimizer.step()
    return {name: float(term) for name, term in terms.items()}


def _resume(path: Path, trainer: Trainer, optimizer: torch.optim.Optimizer) -> _Position:
    try:
        saved = load_tensors(path)
        learns_from = saved["learns_from"]
        trainer.network.load_state_dict(saved["network"])
        optimizer.load_state_dict(saved["optimizer"])
        trainer.load_state_dict(saved["trainer"])
        progress = _Position(**saved["progress"])
    except Exception as error:
        raise ValueError(
            f"{path} is no checkpoint to go on from ({type(error).__name__}: {reason_of(error)}); "
            "delete it to begin anew"
        ) from None
    if learns_from != _learns_from(trainer):
        raise ValueError(
            f"{path} is of a run that learned from other files: corpora, or the weights that it "
            "began with, have changed since; choose another --out, or bring them back to go on"
        )
    weights = path.parent / f"{trainer.policy}.npz"
    if progress.best and not weights.is_file():
        raise ValueError(
            f"{weights} is missing, which the run kept as its best; bring it back, or delete "
            f"{path} to begin anew"
        )
    return progress


def _learns_from(trainer: Trainer) -> str:
    return getattr(trainer, "learns_from", "")
