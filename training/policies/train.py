"""The training loop: any trainer, resumable, with a record next to the weights; and the trainers by
the names of their policies."""

import json
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from splatpilot.systems.common.files import claim_folder, locked_folder, write_csv, write_text
from splatpilot.systems.common.processes import (
    keep_freed_memory,
    one_torch_thread,
    require_device,
)
from splatpilot.systems.common.progress import CheckpointClock, Progress, resumable, say
from splatpilot.systems.common.provenance import revision
from splatpilot.systems.common.readers import error_summary
from splatpilot.systems.common.registry import Registry
from splatpilot.systems.common.validation import require, validate
from splatpilot.systems.policies.checkpoint import PolicyCheckpoint
from splatpilot.training.policies import train_agile_autonomy as agile
from splatpilot.training.policies import train_depthnav, train_diffaero, train_student
from splatpilot.training.policies import train_diffaero_rgb as rgb
from splatpilot.training.policies.rollouts import RolloutTrainer
from splatpilot.training.policies.trainer import Trainer, TrainingConfig
from splatpilot.training.reconstruction.checkpoint import event_log, load_tensors, save_tensors


@one_torch_thread()
def run[Config: TrainingConfig](
    *, config: Config, out: Path, make: Callable[[Config], Trainer]
) -> dict[str, Any]:
    """Trains a policy on one thread; resumes an interrupted run of the same configuration.

    Writes to `out`: `POLICY.npz`, the weights with the best success in held-out worlds, see
    `PolicyCheckpoint`; `config.yaml`; `curves.csv`, the terms of the loss and the success over the
    updates; `POLICY.md`, a model card; `summary.json`, which is returned; `checkpoint.pt`, for
    resuming. On a CPU `config` determines the weights bitwise, with interruptions too.
    """
    validate(config)
    require_device(config.device)
    keep_freed_memory()
    with locked_folder(out):
        return _Run(config, out, make).train()


@dataclass
class _Progress:
    update: int = 0
    cpu_seconds: float = 0.0
    best: dict[str, Any] = field(default_factory=dict)
    means: dict[str, float] = field(default_factory=dict)
    curves: list[dict[str, float]] = field(default_factory=list)


class _Run:
    def __init__(self, config: TrainingConfig, out: Path, make: Callable[[Any], Trainer]) -> None:
        self.config, self.out, self.schedule = config, out, config.schedule
        self.checkpoint = out / "checkpoint.pt"
        self.started, self.kept_update = time.process_time(), 0
        self.yaml, self.revision = claim_folder(out / "config.yaml", config), revision()
        torch.manual_seed(config.seed)
        try:
            with resumable(self._kept):
                self.trainer = trainer = make(config)
        except (ValueError, OSError):
            # Frees the folder, so that a configuration with the error corrected may use it.
            if [file.name for file in out.iterdir() if file.name[0] != "."] == ["config.yaml"]:
                (out / "config.yaml").unlink()
            raise
        weights, decay = trainer.network.parameters(), self.schedule.weight_decay
        self.optimizer = torch.optim.AdamW(weights, weight_decay=decay)
        self.progress, self.clock = _Progress(), CheckpointClock()
        if self.checkpoint.exists():
            self._resume()
        self.spent_before = self.progress.cpu_seconds

    def train(self) -> dict[str, Any]:
        progress, schedule, trainer = self.progress, self.schedule, self.trainer
        what = f"training {trainer.policy}, seed {self.config.seed}"
        bar = Progress(None, what, schedule.updates, initial=progress.update, unit="update")
        logs = str(self.out) if schedule.tensorboard else ""
        with event_log(logs) as log, resumable(self._kept), bar:
            while progress.update < schedule.updates:
                self._step()
                bar.update()
                bar.set_postfix_str(self._postfix(), refresh=False)
                keep, measure = schedule.due(progress.update)
                if keep or measure:
                    measured = trainer.evaluate() if measure else {}
                    row = {"update": float(progress.update), **progress.means, **measured}
                    progress.curves.append(row)
                    log(progress.update, row)
                    if measure and measured["success"] >= progress.best.get("success", -1.0):
                        progress.best = {"update": progress.update, **measured}
                        self._write_weights()
                if keep or measure or self.clock.is_due:
                    self._save()
        best, minutes = progress.best, progress.cpu_seconds / 60.0
        summary = {"policy": trainer.policy, "seed": self.config.seed, "updates": progress.update}
        summary |= {"cpu_minutes": round(minutes, 2), "best": best}
        write_text(self.out / "summary.json", json.dumps(summary, indent=2) + "\n")
        write_text(self.out / f"{trainer.policy}.md", self._model_card(summary))
        print(
            f"{trainer.policy}: success in {best['success']:.0%} of held-out {trainer.evaluated} "
            f"after {best['update']} of {progress.update} updates, {minutes:.1f} CPU minutes; "
            f"weights in {self.out / trainer.policy}.npz"
        )
        return summary

    def _step(self) -> None:
        progress, schedule, trainer = self.progress, self.schedule, self.trainer
        for group in self.optimizer.param_groups:
            group["lr"] = schedule.learning_rate * schedule.factor(progress.update)
        trainer.begin_update(progress.update)
        try:
            terms = step_optimizer(trainer.losses, trainer.network, self.optimizer, schedule.clip)
        except FloatingPointError as error:
            best = f"the best weights so far are kept in {self.out}; " if progress.best else ""
            raise ValueError(
                f"training stopped at update {progress.update}: {error}; {best}lower "
                "schedule.learning_rate"
            ) from None
        progress.update += 1
        means = progress.means
        for name, value in terms.items():
            means[name] = value if name not in means else 0.98 * means[name] + 0.02 * value

    def _postfix(self) -> str:
        progress = self.progress
        text = f"loss {progress.means['loss']:.3g}"
        if progress.best:
            last = next(row["success"] for row in reversed(progress.curves) if "success" in row)
            best = progress.best["success"]
            text += f", success {last:.0%} of held-out {self.trainer.evaluated}, best {best:.0%}"
        return text

    def _kept(self) -> str:
        if not self.checkpoint.exists():
            return f"no update is in {self.out} yet; the same command starts again"
        updates, kept = self.schedule.updates, self.kept_update
        update = f"update {kept} of {updates}" if kept else "the checkpoint"
        return f"{update} is in {self.out}; the same command resumes there"

    def _save(self) -> None:
        self.progress.cpu_seconds = self.spent_before + time.process_time() - self.started
        state = {
            "progress": vars(self.progress),
            "network": self.trainer.network.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "trainer": self.trainer.state_dict(),
            "learns_from": self.trainer.learns_from,
            "revision": self.revision,
        }
        with self.clock.writing():
            save_tensors(state, self.checkpoint)
            write_csv(self.out / "curves.csv", self.progress.curves)
        self.kept_update = self.progress.update

    def _resume(self) -> None:
        path, trainer = self.checkpoint, self.trainer
        remedy = f"delete {path} to start again"
        try:
            saved = load_tensors(path)
            learns_from, made_by = saved["learns_from"], saved.get("revision", "an older one")
            trainer.network.load_state_dict(saved["network"])
            self.optimizer.load_state_dict(saved["optimizer"])
            trainer.load_state_dict(saved["trainer"])
            self.progress = _Progress(**saved["progress"])
        except Exception as error:
            raise ValueError(
                f"{path} must be a checkpoint ({type(error).__name__}: {error_summary(error)}); "
                f"{remedy}"
            ) from None
        if learns_from != trainer.learns_from:
            raise ValueError(
                f"{path} is of a run that learned from other files: corpora, scenes, or the first "
                "weights have changed since; choose another --out, or restore them"
            )
        other = "choose another --out, or go back to that revision"
        valid = made_by == self.revision or self.progress.update == self.schedule.updates
        require(valid, f"revision of {path}", self.revision, made_by, other)
        weights = self.out / f"{trainer.policy}.npz"
        if self.progress.best and not weights.is_file():
            raise ValueError(f"No such file: {weights}, the best weights; restore it, or {remedy}")
        self.kept_update = self.progress.update
        say(f"resuming {self.out} at update {self.kept_update} of {self.schedule.updates}")
        write_csv(self.out / "curves.csv", self.progress.curves)

    def _write_weights(self) -> None:
        """Writes the weights as float32, or as the `weights_type` of their architecture."""
        trainer = self.trainer
        dtype = getattr(trainer.spec, "weights_type", np.float32)
        state = trainer.network.state_dict()
        weights = {name: w.detach().cpu().numpy().astype(dtype) for name, w in state.items()}
        provenance = {
            "command": f"splatpilot train {trainer.policy}",
            "config": self.yaml,
            "revision": self.revision,
            "torch": torch.__version__,
            "best": self.progress.best,
        }
        checkpoint = PolicyCheckpoint(trainer.policy, trainer.spec, weights, provenance)
        checkpoint.save(self.out / f"{trainer.policy}.npz")

    def _model_card(self, summary: dict[str, Any]) -> str:
        policy, best = summary["policy"], dict(summary["best"])
        update = best.pop("update")
        rows = "\n".join(f"| {name} | {value:.2f} |" for name, value in best.items())
        return f"""# {policy}

Made by `splatpilot train {policy} --out DIR --config CONFIG` with the configuration below at
revision {self.revision} of the source, in {summary["cpu_minutes"]:.1f} minutes of one core;
{summary["updates"]} updates. The weights after {update} did best on held-out worlds.

| on held-out worlds | |
|---|---|
{rows}

{self.trainer.metrics}

```yaml
{self.yaml}```
"""


def step_optimizer(
    losses: Callable[[], dict[str, torch.Tensor]],
    network: torch.nn.Module,
    optimizer: torch.optim.Optimizer,
    clip: float,
) -> dict[str, float]:
    """Takes a step down the sum of the terms from `losses` that have a gradient; returns the terms
    and that sum, `loss`. Raises FloatingPointError before the step if one is not finite."""
    terms = losses()
    for name, term in terms.items():
        if not torch.isfinite(term):
            raise FloatingPointError(f"the term {name!r} of the loss became {term.item()}")
    optimizer.zero_grad(set_to_none=True)
    loss = torch.stack([term for term in terms.values() if term.requires_grad]).sum()
    loss.backward()
    norm = torch.nn.utils.clip_grad_norm_(network.parameters(), clip)
    if not torch.isfinite(norm):
        raise FloatingPointError(f"the gradient of the loss became {norm.item()}")
    optimizer.step()
    return {name: float(term.detach()) for name, term in (terms | {"loss": loss}).items()}


class TrainerEntry(NamedTuple):
    """A registered trainer."""

    config: type  # of its configurations, a dataclass with the fields of `TrainingConfig`
    make: Callable[[Any], Trainer]  # makes the trainer of a configuration


TRAINERS = Registry("trainer", "splatpilot.trainers", TrainerEntry)


def register_trainer(name: str, config: type, make: Callable[[Any], Trainer]) -> None:
    """Registers a trainer for `splatpilot train`: its configuration and what makes a `Trainer`."""
    TRAINERS.add(name, TrainerEntry(config, make))


def _rollout_trainer(name: str, learner: Any, config: Any) -> Trainer:
    return RolloutTrainer(name, learner(config.loss, config.device), config)


for _name, _config, _learner in (
    ("diffaero", train_diffaero.DiffAeroTraining, train_diffaero.DiffAeroLearner),
    ("depthnav", train_depthnav.DepthNavTraining, train_depthnav.DepthNavLearner),
    ("diffaero_tof", train_diffaero.DiffAeroTofTraining, train_diffaero.DiffAeroTofLearner),
):
    register_trainer(_name, _config, partial(_rollout_trainer, _name, _learner))
for _name, _config, _trainer in (
    ("agile_autonomy", agile.AgileAutonomyTraining, agile.AgileAutonomyTrainer),
    ("diffaero_rgb", rgb.DiffAeroRgbTraining, rgb.DiffAeroRgbTrainer),
    ("distilled_rgb", rgb.DistilledRgbTraining, rgb.DistilledRgbTrainer),
    ("student_rgb", train_student.StudentRgbTraining, train_student.StudentTrainer),
    ("student_depth", train_student.StudentDepthTraining, train_student.StudentTrainer),
):
    register_trainer(_name, _config, _trainer)
