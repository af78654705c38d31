"""The folder of a training run: what people read of it, and the weights that fly."""

import csv
import io
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch

from splatpilot.systems.files import written_atomically
from splatpilot.systems.output_folders import claim_folder
from splatpilot.systems.policies.policy_checkpoint import PolicyCheckpoint
from splatpilot.systems.provenance import revision

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
